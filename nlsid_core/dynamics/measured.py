"""What equations leave out of recordings: the push on dx/dt that a funnel is then proved for."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.dynamics.taylor import Rates
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import DataError, DocumentError

FORMAT = "nlsid/measured_push"
STEPS = 4  # of Runge-Kutta in a sample


@dataclass(frozen=True, eq=False)
class MeasuredPush:
    """How much dx/dt differs from f(x, u) in recordings, on average over `seconds`.

    largest: (trials, n) per state and s, one row for each distinct trial. measured_on: their
    (name, digest). Source: docs/theory-funnels.md, "A push that is measured".
    """

    largest: FloatArray
    measured_on: tuple[tuple[str, str], ...]
    seconds: float
    safety_factor: float

    @property
    def box(self) -> FloatArray:
        """(n, 2) low and high of w in dx/dt = f(x, u) + w."""
        half = self.safety_factor * self.largest.max(axis=0)
        return np.column_stack([-half, half])

    @property
    def exceeded(self) -> float:
        """The most that the probability is, that a further trial like these exceeds the largest.

        At most 1/(trials + 1) for a state, if trials can be exchanged; so much for each state.
        """
        trials, n = self.largest.shape
        return float(min(n / (trials + 1), 1.0))

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "seconds": self.seconds,
            "safety_factor": self.safety_factor,
            "largest": self.largest.tolist(),
            "measured_on": [{"name": name, "digest": d} for name, d in self.measured_on],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "push") -> "MeasuredPush":
        """Raises DocumentError if the document is not one."""
        files.header(document, FORMAT, source=source)
        trials = files.member(document, "measured_on", list, source=source)
        largest = files.array(document, "largest", (len(trials), None), source=source)
        found = cls(
            largest,
            tuple(files.named_digests(trials, source=source)),
            files.number(document, "seconds", source=source),
            files.number(document, "safety_factor", source=source),
        )
        sound = len(trials) and largest.min(initial=0.0) >= 0
        if not (sound and found.seconds > 0 and found.safety_factor >= 1):
            raise DocumentError(
                f"{source}: needs a trial, largest pushes of 0 or more, seconds above 0 and a "
                "safety_factor of 1 or more"
            )
        return found

    def __str__(self) -> str:
        return (
            f"|dx/dt - f| on average over {self.seconds:g} s at most "
            f"{np.array2string(self.box[:, 1], precision=3)} per s (largest of {len(self.largest)} "
            f"distinct trials, safety factor {self.safety_factor:g}; a further trial exceeds the "
            f"largest with probability {self.exceeded:.2g} at most)"
        )


def measured_push(
    dynamics: VectorField | Callable[..., Any],
    trials: Dataset,
    *,
    seconds: float | None = None,
    safety_factor: float = 1.5,
) -> MeasuredPush:
    """The push that trials show: x(t + seconds) less what f makes of x(t) and the inputs since.

    dynamics: f of x and u. trials: y the measured states, u the inputs, held between samples.
    seconds: over which the push is averaged (None: one sample). Noise e of a state counts as
    2e/seconds; a push that changes sign faster is not seen.

    Raises DataError if f depends on time or on w, or if trials do not fit or are too short.
    """
    if safety_factor < 1:
        raise DataError(f"safety_factor should be 1 or more, is {safety_factor:g}")
    first = next(iter(trials))
    n, m = first.y.shape[1], first.u.shape[1]
    field = dynamics if isinstance(dynamics, VectorField) else Rates.of(dynamics, n, m)
    if field.depends_on_time:
        raise DataError("recordings have no time of a motion: give dynamics of x and u")
    if (field.n, field.m) != (n, m):
        raise DataError(
            f"the trials have {n} states (as y) and {m} inputs, the dynamics {field.n} and "
            f"{field.m}"
        )
    samples = 1 if seconds is None else round(seconds / trials.period)
    if samples < 1:
        raise DataError(f"seconds should be a sample, {trials.period:g} s, or more: {seconds}")
    distinct = {trial.digest or trial.name or str(i): trial for i, trial in enumerate(trials)}
    rows = [_largest(field, trial, trials.period, samples) for trial in distinct.values()]
    return MeasuredPush(
        np.array(rows),
        tuple((trial.name, trial.digest) for trial in distinct.values()),
        samples * trials.period,
        safety_factor,
    )


def _largest(
    field: VectorField | Rates, trial: Trajectory, period: float, samples: int
) -> FloatArray:
    """(n,) the largest mean push of one trial."""
    count = len(trial) - samples
    if count < 1:
        raise DataError(f"{trial.name or 'a trial'}: {len(trial)} samples, {samples + 1} needed")
    X, h = trial.y[:count], period / STEPS
    for k in range(samples):
        U = trial.u[k : k + count]
        for _ in range(STEPS):
            a = field(0.0, X, U)
            b = field(0.0, X + h / 2 * a, U)
            c = field(0.0, X + h / 2 * b, U)
            d = field(0.0, X + h * c, U)
            X = X + h / 6 * (a + 2 * b + 2 * c + d)
    push = np.abs(trial.y[samples:] - X).max(axis=0) / (samples * period)
    if not np.isfinite(push).all():
        raise DataError(f"{trial.name or 'a trial'}: the dynamics diverge from its states")
    return np.asarray(push)
