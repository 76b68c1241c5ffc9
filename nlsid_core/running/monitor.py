"""`Monitor`: where is the running robot relative to its funnel, and is the assumption still kept?

One sample in, one `Reading` out, for funnels of every kind; replay and the live node call the same
code on the same numbers, so their margins are equal bit for bit. A positive margin is good.
Missing, stale or NaN state reads as unknown, never as inside, and no number that is not finite
passes for inside: a size that is not shown to be at most 1 is outside.
"""

import math
import sys
from collections.abc import Sequence
from typing import Any

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels import ContinuousFunnel, TubeFunnel
from nlsid_core.running.comparison import (
    Centre,
    Compared,
    Comparison,
    ContinuousComparison,
    PlanComparison,
    SampledComparison,
)
from nlsid_core.running.forecast import Forecast
from nlsid_core.running.grid import TOLERANCE, Grid
from nlsid_core.running.reading import Level, Reading, Status, Trend
from nlsid_core.running.stage import Stage
from nlsid_core.running.tubes import TubeRun

OVER = "the proof covers"  # how the reason of every reading after the end begins


class Monitor:
    """Holds samples (t, y, u) of one run against a funnel; `update` once per sample, in order.

    stages: what belongs together; several of a composition of continuous funnels, one after
    another, and readings say which: none has a hold there, for what is held into the next stage is
    covered by no proof. u: the input applied from t on (the latest command with a stamp not after
    t); it may be None at the last sample. centre: of a tube with a policy.

    Tubes around a model's simulation are held for ever: see `TubeRun`. Around a plan, a run starts
    with the first sample, or at the stamp given to `restart`. It ends at the first sample that is
    missing, not finite or off the grid of the start, and where the proof ends; after that every
    reading is unknown until `restart`.

    Raises CertificateMismatch if the parts do not belong together, DataError if the funnel cannot
    be monitored in float64.
    """

    def __init__(self, stages: Sequence[Stage], *, centre: Centre = Centre.COMMAND) -> None:
        for stage in stages:
            stage.refuse_mismatch()
        model, policy, funnel, held = stages[0]
        self.funnels = tuple(stage.funnel for stage in stages)
        # Whether a sample that is missing is only that, and no end of the run.
        followed = centre is Centre.PROFILE and policy is not None
        self.goes_on = isinstance(funnel, TubeFunnel) and not followed
        if isinstance(funnel, TubeFunnel) and self.goes_on:
            simulated: Any = model
            self._tubes = TubeRun(simulated, funnel)
            self.lags = self._tubes.lags
            return
        self._comparison = _comparison(stages)
        self.lags = self._comparison.lags  # samples before an announced start
        self._grid = Grid(
            self._comparison.period,
            first=-self.lags,
            tolerance=held.tolerance if held else TOLERANCE,
        )
        self.restart()

    def restart(self, start: float | None = None) -> None:
        """Begin a new run, and forget why the last one ended.

        start: s, the stamp of sample 0 if it is known; otherwise the run starts with the first
        sample, and a sample that was lost before it cannot be noticed.
        """
        if self.goes_on:
            self._tubes.restart()
            return
        self._grid.begin(start)
        self._comparison.restart()
        self._ended = self._violated = ""
        self._trend = Trend()

    def waiting(self, t: float, y: Any, reason: str) -> Reading:
        """The reading at t (s) of a sample y before the run's start."""
        return Reading(t, Status.UNKNOWN, measured=_numbers(y), reason=reason)

    def missing(self, t: float, reason: str, *, doubted: bool = False) -> Reading:
        """End the run because the state is missing or stale at time t (s): unknown from here on.

        Tubes around a simulation go on with the next sample, or, if the last one is `doubted` to be
        the robot's, start a new run.
        """
        if self.goes_on:
            return self._tubes.missing(t, reason, doubted=doubted)
        self._ended = self._ended or reason
        return Reading(t, Status.UNKNOWN, reason=self._ended)

    def unmeasured(self, t: float, u: Any, reason: str) -> Reading:
        """The reading at t (s) of a sample whose state nobody measured, under the input u.

        It is unknown. Tubes around a simulation go on with it; every other run ends.
        """
        return self._tubes.unmeasured(t, u, reason) if self.goes_on else self.missing(t, reason)

    def forecast(self, u: FloatArray) -> Forecast:
        """What the outputs can be at the next samples, under the inputs u (h, n_u) there.

        DataError of funnels that are not around a model's simulation.
        """
        if not self.goes_on:
            raise DataError(
                "a forecast is made from a tube around the model's simulation; around a plan, the "
                "plan and its funnel say what comes"
            )
        return self._tubes.forecast(u)

    def update(self, t: float, y: Any, u: Any) -> Reading:
        """The reading at stamp t (s) for the output or state y and the input u."""
        if self.goes_on:
            return self._tubes.update(t, y, u)
        comparison, grid, last = self._comparison, self._grid, self._comparison.last
        k, since = grid.k, t - grid.start
        y, u, fault = comparison.read(t, y, u, needs_input=not comparison.when(k, since) >= last)
        self._ended = self._ended or fault or grid.take(t)
        if self._ended:
            return self.waiting(t, y, self._ended)
        when = comparison.when(k, t - grid.start)
        if isinstance(comparison, PlanComparison) and k < 0:
            self._violated = comparison.collect(y, u)
            return self.waiting(t, y, f"waiting for the first {self.lags} samples")
        if when > last:
            return self.waiting(t, y, f"{OVER} {comparison.over}; they are over")
        try:
            compared = comparison.compare(when, t, y, u)
        except SolverError as error:
            self._ended = f"the model has no next state at t = {t:g} s: {error}"
            return self.waiting(t, y, self._ended)
        return self._judge(t, y, compared)

    def _judge(self, t: float, y: Any, compared: Compared) -> Reading:
        size, used, worst, broken, nominal, deviation, level = compared
        margin = 1.0 - size if size < math.inf else -math.inf
        self._violated = violated = self._violated or broken
        status = Status.ASSUMPTION_VIOLATED if violated else Status.INSIDE
        if not size <= 1.0:
            status = Status.OUTSIDE
            kept = " although the assumption was kept: what runs is not what was proved"
            violated = f"outside the tube; {violated}" if violated else f"outside{kept}"
        if not size <= sys.float_info.max:
            self._ended = f"the deviation from the nominal is not finite at t = {t:g} s"
        level = level or (Level.TUBE if size <= 1.0 else Level.NONE)
        return Reading(
            t,
            status,
            margin,
            used,
            self._trend.exit_after(t, margin),
            worst,
            nominal,
            _numbers(y),
            level,
            violated,
            self._comparison.assuming,
            deviation,
        )


def _comparison(stages: Sequence[Stage]) -> Comparison:
    """The arithmetic for funnels of this kind."""
    model, policy, funnel, _ = stages[0]
    parts: tuple[Any, Any, Any] = model, policy, funnel
    if isinstance(funnel, TubeFunnel):
        return PlanComparison(*parts)
    if isinstance(funnel, ContinuousFunnel):
        return ContinuousComparison(stages)
    return SampledComparison(*parts)


def _numbers(y: Any) -> tuple[float, ...]:
    """A measured number or vector as a tuple."""
    return (float(y),) if isinstance(y, int | float) else tuple(float(value) for value in y)
