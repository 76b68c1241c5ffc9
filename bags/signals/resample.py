"""Put a recorded signal on given times, held or on lines, and say how far that may be off."""

from dataclasses import dataclass

import numpy as np

from bags.signals.reader import Samples, stamp_text
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import DataError, apart


@dataclass(frozen=True, eq=False)
class Resampled:
    """values: (M,) on the times asked for. error: what each is off by at most.

    A command that is held is off by no more than its largest step between two samples. On lines
    the bound holds for a signal that stays in its recorded range, or whose second derivative is
    nowhere larger than the samples' largest divided difference of that order.
    """

    values: FloatArray
    error: float


def resample(samples: Samples, at_ns: IntArray, *, hold: bool, max_gap: float) -> Resampled:
    """Put a signal on the times `at_ns` (M,), increasing, from samples at most `max_gap` s apart.

    hold: the latest sample at or before (commands); else the line between two samples. Raises
    DataError, saying where, for a time outside the recording or inside a longer gap, and for stamps
    that repeat.

    Source of the bound: C. de Boor, A Practical Guide to Splines (1978): h²/8·max|f''|.
    """
    stamp_ns, values = samples.stamp_ns, samples.values
    if len(same := np.flatnonzero(np.diff(stamp_ns) <= 0)):
        where = stamp_text(int(stamp_ns[same[0]]))
        raise DataError(f"{samples.path}: stamps repeat at {where} ({len(same)} times)")
    before = np.searchsorted(stamp_ns, at_ns, side="right") - 1
    _refuse_missing(samples, at_ns, before, max_gap, hold=hold)
    rises = np.diff(values)
    if hold:
        return Resampled(values[before], float(np.abs(rises).max(initial=0.0)))
    t, at = (stamp_ns - stamp_ns[0]) / 1e9, (at_ns - stamp_ns[0]) / 1e9
    slopes, steps = rises / np.diff(t), t[2:] - t[:-2]
    bend = float(np.abs(2.0 * np.diff(slopes) / steps).max(initial=0.0))
    h = min(float(np.diff(t).max(initial=0.0)), max_gap)
    error = min(h**2 / 8 * bend, float(np.ptp(values)))
    return Resampled(np.interp(at, t, values), error)


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
