"""Put a recorded signal on given times: hold, linear or cubic, with a bound on the error."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from bags.signals.reader import Samples, stamp_text
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import DataError, apart

Method = Literal["hold", "linear", "cubic"]
METHODS: Final[tuple[Method, ...]] = ("hold", "linear", "cubic")


@dataclass(frozen=True, eq=False)
class Resampled:
    """values: (M,) on the times asked for. error: what each is off by at most.

    The bound holds for a signal whose derivative of order 1 (hold), 2 (linear) or 4 (cubic) is
    nowhere larger than the samples' largest divided difference of that order.
    """

    values: FloatArray
    error: float


def resample(samples: Samples, at_ns: IntArray, *, method: Method, max_gap: float) -> Resampled:
    """The signal at the times `at_ns` (M,), increasing, from samples at most `max_gap` s apart.

    hold: the latest sample at or before (commands). linear, cubic (not-a-knot spline): states.
    Raises DataError, saying where, for a time outside the recording or inside a longer gap, for
    stamps that repeat, and for fewer samples than the method needs (1, 2, 4).

    Source of the bounds: C. de Boor, A Practical Guide to Splines (1978): linear h²/8·max|f''|;
    cubic 5/384·h⁴·max|f⁗| (of the complete spline; the not-a-knot spline has the same order).
    """
    stamp_ns, values = samples.stamp_ns, samples.values
    needed = {"hold": 1, "linear": 2, "cubic": 4}[method]
    if len(stamp_ns) < needed:
        raise DataError(f"{samples.path}: {len(stamp_ns)} samples, {method} needs {needed}")
    if len(same := np.flatnonzero(np.diff(stamp_ns) <= 0)):
        where = stamp_text(int(stamp_ns[same[0]]))
        raise DataError(f"{samples.path}: stamps repeat at {where} ({len(same)} times)")
    before = np.searchsorted(stamp_ns, at_ns, side="right") - 1
    _refuse_missing(samples, at_ns, before, max_gap, hold=method == "hold")
    t, at = (stamp_ns - stamp_ns[0]) / 1e9, (at_ns - stamp_ns[0]) / 1e9
    if method == "hold":
        return Resampled(values[before], _largest(values, t, 1) * max(_widest(t), max_gap))
    h = min(_widest(t), max_gap)
    if method == "linear":
        return Resampled(np.interp(at, t, values), h**2 / 8 * _largest(values, t, 2))
    found: FloatArray = CubicSpline(t, values)(at)
    return Resampled(found, 5 / 384 * h**4 * _largest(values, t, 4))


def _refuse_missing(
    samples: Samples, at_ns: IntArray, before: IntArray, max_gap: float, *, hold: bool
) -> None:
    stamp_ns = samples.stamp_ns
    last = len(stamp_ns) - 1
    outside = (before < 0) | ((at_ns > stamp_ns[-1]) & (not hold))
    if outside.any():
        raise DataError(
            f"{samples.path}: nothing recorded at {stamp_text(int(at_ns[np.argmax(outside)]))}; "
            f"it has {stamp_text(int(stamp_ns[0]))} to {stamp_text(int(stamp_ns[-1]))}"
        )
    on_sample = stamp_ns[before] == at_ns
    after = stamp_ns[np.minimum(before + 1, last)]
    gap = np.where(on_sample, 0, (at_ns if hold else after) - stamp_ns[before])
    worst = int(np.argmax(gap)) if len(gap) else 0
    if len(gap) and gap[worst] > max_gap * 1e9:
        found, most = apart(float(gap[worst]) / 1e9, max_gap)
        raise DataError(
            f"{samples.path}: a gap of {found} s after "
            f"{stamp_text(int(stamp_ns[before[worst]]))}; at most {most} s was asked for"
        )


def _widest(t: FloatArray) -> float:
    return float(np.max(np.diff(t))) if len(t) > 1 else 0.0


def _largest(values: FloatArray, t: FloatArray, order: int) -> float:
    """The largest derivative of that order that divided differences of the samples show."""
    differences = values
    for k in range(1, order + 1):
        if len(differences) < 2:
            return 0.0
        differences = k * np.diff(differences) / (t[k:] - t[:-k])
    return float(np.abs(differences).max(initial=0.0))
