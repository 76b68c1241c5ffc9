"""`Controller`: runs a policy on samples as they come, as the proof assumes.

Of a tube input k+1 depends on the samples up to k only, so it is known a period before it
acts. Of the other kinds input k answers sample k and has the period to get there.
"""

import math
from collections import deque
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels.factor import refuse_unmonitorable
from nlsid_core.models import DifferenceEquation
from nlsid_core.policies.tube import TubePolicy
from nlsid_core.running.grid import TOLERANCE, Grid
from nlsid_core.running.observer import (
    MeasuredStateObserver,
    PredictingObserver,
    StateObserver,
)
from nlsid_core.running.stage import Stage

Input = TypeVar("Input", float, FloatArray)


@dataclass(frozen=True, eq=False)
class Limits:
    """lowest, highest: of the input, in its unit; stop_rate: its fastest change while stopping, in
    unit/s; stop_at: the input of a robot at rest. Each is one number, or one for each input (m,).

    Raises DataError unless lowest <= stop_at <= highest and stop_rate > 0.
    """

    lowest: float | FloatArray
    highest: float | FloatArray
    stop_rate: float | FloatArray
    stop_at: float | FloatArray = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            given = np.asarray(getattr(self, field.name), dtype=np.float64)
            object.__setattr__(self, field.name, given if given.ndim else float(given))
        if len({np.shape(value) for value in self._each()} - {()}) > 1:
            raise DataError("limits: give one number, or as many of each as there are inputs")
        inside = np.logical_and(self.lowest <= self.stop_at, self.stop_at <= self.highest)
        if not (np.all(inside) and np.isfinite(self.stop_at).all() and np.all(self.stop_rate > 0)):
            raise DataError(
                f"limits: {self.stop_at} should be in [{self.lowest}, {self.highest}], "
                f"stop_rate {self.stop_rate} positive"
            )

    def refuse(self, inputs: int) -> None:
        """DataError unless they are for so many inputs."""
        for value in self._each():
            if np.shape(value) not in ((), (inputs,)):
                raise DataError(f"limits for {np.size(value)} inputs; the design has {inputs}")

    def _each(self) -> list[float | FloatArray]:
        return [getattr(self, field.name) for field in fields(self)]

    def clip(self, u: Input) -> Input:
        """The nearest input that is allowed; of several, each."""
        allowed: Input = np.clip(u, self.lowest, self.highest)
        return allowed

    def towards_stop(self, u: Input, dt: float) -> Input:
        """The input dt s later on the way to `stop_at`."""
        step = self.stop_rate * dt
        nearer: Any = u + np.clip(self.stop_at - u, -step, step)
        allowed: Input = self.clip(nearer)
        return allowed

    def at_rest(self, u: Input) -> bool:
        """Whether every input is where a robot at rest has it."""
        return bool(np.all(u == self.stop_at))


class Controller:
    """u = policy(k, x̂), x̂ the estimate of the policy's own observer, within what is proved.

    Before sample 0 the plan's first input is held until the state is where the funnel may start, at
    most for `settling` s. `k` is the number of the next sample, negative before. `ended` says why
    it is over, empty while it runs: the sample is missing, not finite, off the grid of the start or
    later than an input may be held, the input would not be finite or not one that the proof covers,
    or the proof ends. Where a hold is proved samples may come at any time within it. Stopping is
    the caller's then. `lead`: s from a sample to the stamp of its
    input, not quite a period where the input is that of the next sample, so that a sample off the
    grid still finds it in force.

    stage: what belongs together. Without a funnel nothing is proved of the policy: it runs from any
    state, to be commissioned. Raises CertificateMismatch if the parts do not belong together,
    DataError if the limits cut off an input of the plan.
    """

    def __init__(self, stage: Stage, limits: Limits, settling: float = 0.0) -> None:
        stage.refuse_mismatch()
        parts: tuple[Any, Any, Any] = stage[:3]
        model, policy, funnel = parts
        if isinstance(policy, TubePolicy):
            policy = policy.plan(model)
        if funnel is not None:
            refuse_unmonitorable(funnel)  # here, as its exact factors take longer than a sample
        self._model, self._policy, self._funnel = model, policy, funnel
        self.limits, self._settling = limits, settling
        self._continuous = isinstance(model, VectorField)
        self._held = stage.applied if self._continuous else None
        if self._held is not None:
            self.period, self._origin = self._held.period, float(policy.t[0])
            held_so_long = self._held.hold or (1.0 - TOLERANCE) * self.period  # each input
            self._end = policy.last - held_so_long
        else:
            self.period, self._origin = float(model.period), 0.0
            self._end = policy.last if funnel is None else min(policy.last, funnel.last)
        self._observer = _observer(model, policy)
        self.lead = (1.0 - TOLERANCE) * self.period * self._observer.ahead
        limits.refuse(np.size(policy.planned[0]))
        self._refuse_cut(policy.planned)
        self.ended = ""
        self.k = -1
        self.u: Any = limits.clip(policy.planned[0])  # the input in force at the next sample
        if self._observer.ahead:
            self.u = float(self.u)
        self._grid = Grid(self.period, tolerance=self._held.tolerance if self._held else TOLERANCE)
        self._recent: deque[tuple[Any, Any]] = deque(maxlen=max(1, self._observer.lags))
        self._first_t = self._answered = math.nan  # s, of the first sample and the newest

    def update(self, t: float, y: Any) -> Any:
        """Take the sample y at t (s); the input in force from the next sample on, or from this one.

        Once `ended`, the input stays where it was.
        """
        if self.ended:
            return self.u
        self.ended = self._fault(t, y) or self._grid.take(t) or self._overdue(t)
        if self.ended:
            return self.u
        if self.k <= 0:  # sample 0 is not behind: it is where the grid starts
            self._grid.begin(t, at=1)
        if self.k < 0:
            self._settle(t, y)
            return self.u
        try:
            x = self._observer.update(y, self.u)
        except SolverError as error:
            self.ended = f"the model has no next state at t = {t:g} s: {error}"
            return self.u
        self.k += 1
        self._answer(self._when(t), x)
        return self.u

    def _when(self, t: float) -> float:
        """The moment of the next input, as the funnels count."""
        if self._continuous:
            return max(self._origin, self._origin + t - self._grid.start)
        return self.k - 1 + int(self._observer.ahead)

    def _settle(self, t: float, y: Any) -> None:
        """Wait for a state from which the funnel may start."""
        if math.isnan(self._first_t):
            self._first_t = t
        self._recent.append((y, self.u))
        if len(self._recent) < self._observer.lags:
            return
        x = self._observer.begin([y for y, _ in self._recent], [u for _, u in self._recent])
        size, funnel = 0.0, self._funnel
        if funnel is not None:
            nominal = funnel.nominal(self._origin) if self._continuous else self._policy.x[0]
            size = funnel.start_size(x - nominal)
            if self._held is not None:
                size += self._held.reach(funnel.shape(self._origin))
        if size <= 1.0:
            self.k = 1 - self._observer.ahead
            self._answer(self._origin, x)
        elif not t - self._first_t <= self._settling:
            self.ended = (
                f"not at the start of the plan after {self._settling:g} s: {size:.3g} times as far "
                "out as where it may start"
            )

    def _answer(self, when: float, x: FloatArray) -> None:
        """Set the input for the state x at `when`, if it is one that the proof covers."""
        if when > self._end:
            self.ended = "the plan is over" if when > self._policy.last else "the proof is over"
            return
        wanted = self._policy(when if self._continuous else int(when), x)
        lowest, highest = _range(self._model, when)
        u = self.limits.clip(np.clip(wanted, lowest, highest))
        low, high = self._policy.covers(when, x)
        if not (np.isfinite(wanted).all() and (low <= u).all() and (u <= high).all()):
            self.ended = (
                f"the policy's input {wanted} at sample {self._grid.k} is not proved: it is beyond "
                f"[{np.maximum(lowest, self.limits.lowest)}, "
                f"{np.minimum(highest, self.limits.highest)}]"
            )
            return
        self.u = float(u) if self._observer.ahead else u

    def _fault(self, t: float, y: Any) -> str:
        if np.isfinite(y).all():
            return ""
        name = getattr(getattr(self._model, "y", None), "name", "the state")
        return f"{name} is {y} at t = {t:g} s"

    def _overdue(self, t: float) -> str:
        """Whether the input before this sample was held for longer than is proved."""
        age, self._answered = t - self._answered, t
        return "" if self._held is None or self.k < 1 else self._held.overdue(age, t)

    def _refuse_cut(self, planned: FloatArray) -> None:
        cut = planned[self.limits.clip(planned) != planned]
        if len(cut):
            raise DataError(
                f"the plan's input {float(cut[0]):g} is beyond the limits "
                f"{_interval(self.limits)}: what they cut off is not what was proved"
            )


def _interval(limits: Limits) -> str:
    ends = np.broadcast_arrays(np.atleast_1d(limits.lowest), limits.highest)
    return ", ".join(f"[{low:g}, {high:g}]" for low, high in zip(*ends, strict=True))


def _observer(model: Any, policy: Any) -> Any:
    """The observer that the policy answers."""
    if isinstance(model, DifferenceEquation):
        return PredictingObserver(model, policy.policy.L)
    return (
        MeasuredStateObserver()
        if isinstance(model, VectorField)
        else StateObserver(model, policy.L)
    )


def _range(model: Any, when: float) -> tuple[Any, Any]:
    """The least and greatest input at which the model, or the vector field, is one of the robot."""
    if isinstance(model, DifferenceEquation):
        return model.u_range
    if not isinstance(model, VectorField):
        return model.u_range[:, 0], model.u_range[:, 1]
    lowest, highest = np.full(model.m, -np.inf), np.full(model.m, np.inf)
    for j, low, high in model.validity(model.span(when)):
        if j >= model.n:
            lowest[j - model.n] = max(lowest[j - model.n], low)
            highest[j - model.n] = min(highest[j - model.n], high)
    return lowest, highest
