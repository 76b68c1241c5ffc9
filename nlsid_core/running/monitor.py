"""`Monitor`: where is the running robot relative to its funnel, and is the assumption still kept?

One sample in, one `Reading` out, for funnels of every kind; replay and the live node call the same
code on the same numbers, so their margins are equal bit for bit. A positive margin is good.
Missing, stale or NaN state reads as unknown, never as inside, and no number that is not finite
passes for inside: a size that is not shown to be at most 1 is outside.
"""

import math
import sys
from collections import deque
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateMismatch, DataError, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.protocol import AnyFunnel
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.models import StableModel
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.policies.protocol import AnyPolicy
from nlsid_core.running.comparison import (
    Centre,
    Comparison,
    ContinuousComparison,
    PlanComparison,
    SampledComparison,
)
from nlsid_core.running.forecast import Forecast
from nlsid_core.running.grid import Grid
from nlsid_core.running.held import Held
from nlsid_core.running.reading import Level, Reading, Status
from nlsid_core.running.tubes import Ahead, TubeRun

OVER = "the proof covers"  # how the reason of every reading after the end begins
INSIDE, TUBE = Status.INSIDE, Level.TUBE
TREND = 10  # samples over which the margin's fall is taken

Dynamics: TypeAlias = StableModel | MeasuredState | VectorField


class Monitor:
    """Holds samples (t, y, u) of one run against a funnel; `update` once per sample, in order.

    model: the model, or the vector field, that the policy and the funnel were made for. u: the
    input applied from t on (the latest command with a stamp not after t); it may be None at the
    last sample. centre: of a tube with a policy. Of a continuous funnel only, period: s between
    samples, held: how its proof lets the policy be applied, `Held.of_claim` of its claim.

    Tubes around a model's simulation are held for ever: see `TubeRun`. Around a plan, a run starts
    with the first sample, or at the stamp given to `restart`. It ends at the first sample that is
    missing, not finite or off the grid of the start, and where the proof ends; after that every
    reading is unknown until `restart`.

    Raises CertificateMismatch if the parts do not belong together, DataError if the funnel cannot
    be monitored in float64.
    """

    def __init__(
        self,
        model: Dynamics,
        policy: AnyPolicy | None,
        funnel: AnyFunnel,
        *,
        centre: Centre = Centre.COMMAND,
        period: float | None = None,
        held: Held | None = None,
    ) -> None:
        self._hold([model], [policy], [funnel], centre, period, [held])

    @classmethod
    def of_several(
        cls,
        model: StableModel,
        pairs: Sequence[tuple[AnyPolicy | None, AnyFunnel]],
        *,
        centre: Centre = Centre.COMMAND,
    ) -> "Monitor":
        """One robot against several funnels of tubes of its model at once; see `readings`.

        Ten cost little more than one. In motion (`Centre.MOTION`) they begin together, once the
        start that fades most slowly has faded.
        """
        if not pairs:
            raise DataError("no funnel to hold the state against")
        monitor = cls.__new__(cls)
        policies, funnels = [policy for policy, _ in pairs], [funnel for _, funnel in pairs]
        monitor._hold([model] * len(pairs), policies, funnels, centre, None)
        return monitor

    @classmethod
    def of_stages(
        cls,
        stages: Sequence[tuple[VectorField, AnyPolicy, AnyFunnel]],
        *,
        period: float,
        held: Sequence[Held],
    ) -> "Monitor":
        """The continuous funnels of a composition, one stage after another; readings say which.

        held: of each stage, its errors. None has a hold: what is held into the next stage is
        covered by no proof.
        """
        if not stages:
            raise DataError("no stage to hold the state against")
        monitor = cls.__new__(cls)
        fields: list[Dynamics] = [field for field, _, _ in stages]
        policies: list[AnyPolicy | None] = [policy for _, policy, _ in stages]
        funnels = [funnel for _, _, funnel in stages]
        monitor._hold(fields, policies, funnels, Centre.PROFILE, period, list(held))
        return monitor

    def _hold(
        self,
        models: list[Dynamics],
        policies: list[AnyPolicy | None],
        funnels: list[AnyFunnel],
        centre: Centre,
        period: float | None,
        held: Sequence[Held | None] = (),
    ) -> None:
        for parts in zip(models, policies, funnels, strict=True):
            refuse_mismatch(*parts)
        self.funnels = tuple(funnels)
        tubes = [funnel for funnel in funnels if isinstance(funnel, TubeFunnel)]
        # Whether a sample that is missing is only that, and no end of the run.
        followed = centre is Centre.PROFILE and None not in policies
        self.goes_on = len(tubes) == len(funnels) and not followed
        if self.goes_on:
            model: Any = models[0]
            self._tubes = TubeRun(model, tubes, in_motion=centre is Centre.MOTION)
            self.lags = self._tubes.lags
            return
        self._comparison = _comparison(models, policies, funnels, period, held)
        comparison = self._comparison
        self.lags = comparison.lags  # samples before an announced start that the observer needs
        self._count = len(comparison.last)
        self._first_over, self._last = min(comparison.last), max(comparison.last)
        self._grid = Grid(comparison.period, first=-comparison.lags)
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
        self._ended = ""
        self._violated = [""] * self._count
        self._fall: deque[tuple[float, list[float]]] = deque(maxlen=TREND)

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

    def ahead(self) -> Ahead:
        """What the outputs can be at the next samples, from here; of tubes around a simulation.

        DataError of other funnels.
        """
        if not self.goes_on:
            raise DataError(
                "a forecast is made from a tube around the model's simulation; around a plan, the "
                "plan and its funnel say what comes"
            )
        return self._tubes.ahead()

    def forecast(self, u: FloatArray) -> Forecast:
        """`ahead` under the inputs u (h, n_u) of the next h samples."""
        ahead, found = self.ahead(), []
        for now in u:
            bounds = ahead.step(now)
            if bounds is None:
                break
            found.append(bounds)
        period = self._tubes.period
        bounds_of = np.reshape(found, (len(found), 2, -1)) if found else np.zeros((0, 2, 0))
        t = period * np.arange(1, len(found) + 1)
        return Forecast(t, bounds_of[:, 0], bounds_of[:, 1], ahead.ended)

    def update(self, t: float, y: Any, u: Any) -> Reading:
        """The reading at stamp t (s) for the output or state y and the input u."""
        return self.readings(t, y, u)[0]

    def readings(self, t: float, y: Any, u: Any) -> list[Reading]:
        """`update` for every funnel."""
        if self.goes_on:
            return self._tubes.readings(t, y, u)
        comparison, grid = self._comparison, self._grid
        y, u, measured = comparison.read(y, u)
        if self._ended:
            return self._unknown(t, measured, self._ended)
        k = grid.k
        needs_input = not comparison.when(k, t - grid.start) >= self._last
        self._ended = comparison.fault(t, y, u, needs_input=needs_input) or grid.take(t)
        if self._ended:
            return self._unknown(t, measured, self._ended)
        when = comparison.when(k, t - grid.start)
        if k < 0:
            return self._collect(t, y, u, measured)
        if when > self._last:
            return [self._over(i, t, measured) for i in range(self._count)]
        return self._judge(when, t, y, u, measured)

    def _unknown(self, t: float, measured: tuple[float, ...], reason: str) -> list[Reading]:
        return [Reading(t, Status.UNKNOWN, measured=measured, reason=reason)] * self._count

    def _over(self, i: int, t: float, measured: tuple[float, ...]) -> Reading:
        reason = f"{OVER} {self._comparison.over[i]}; they are over"
        return Reading(t, Status.UNKNOWN, measured=measured, reason=reason)

    def _collect(self, t: float, y: Any, u: Any, measured: tuple[float, ...]) -> list[Reading]:
        """Give the observer its state."""
        broken = self._comparison.collect(y, u)
        if broken is not None:
            self._violated = broken
        return self._unknown(t, measured, f"waiting for the first {self.lags} samples")

    def _judge(
        self, when: float, t: float, y: Any, u: Any, measured: tuple[float, ...]
    ) -> list[Reading]:
        comparison, violated = self._comparison, self._violated
        try:
            compared = comparison.compare(when, t, y, u)
        except SolverError as error:
            self._ended = f"the model has no next state at t = {t:g} s: {error}"
            return self._unknown(t, measured, self._ended)
        sizes, used, worst, broken, nominal, deviation, levels = compared
        margins = [1.0 - size if size < math.inf else -math.inf for size in sizes]
        earlier, before = self._fall[0] if self._fall else (t, margins)
        self._fall.append((t, margins))
        past, assuming = t - earlier, comparison.assuming
        exits = [
            0.0 if not m > 0.0 else m * past / (b - m) if b > m else math.inf
            for m, b in zip(margins, before, strict=True)
        ]
        columns = zip(margins, used, exits, worst, nominal, assuming, deviation, strict=True)
        said = [
            Reading(t, INSIDE, m, a, out, axis, x, measured, TUBE, "", words, away)
            for m, a, out, axis, x, words, away in columns
        ]
        kept = not any(broken) and not any(violated)
        if kept and when <= self._first_over and levels is None and _all_at_most(sizes, 1.0):
            return said
        for i, reading in enumerate(said):
            if when > comparison.last[i]:
                said[i] = self._over(i, t, measured)
                continue
            violated[i] = violated[i] or broken[i]
            inside = sizes[i] <= 1.0
            level = levels[i] if levels is not None else TUBE if inside else Level.NONE
            if not inside:
                status, reason = Status.OUTSIDE, _outside(violated[i])
            else:
                status, reason = Status.ASSUMPTION_VIOLATED if violated[i] else INSIDE, violated[i]
            said[i] = reading._replace(status=status, level=level, reason=reason)
        if not _all_at_most(sizes, sys.float_info.max):
            self._ended = f"the deviation from the nominal is not finite at t = {t:g} s"
        return said


def refuse_mismatch(model: Dynamics, policy: AnyPolicy | None, funnel: AnyFunnel | None) -> None:
    """CertificateMismatch if the funnel was not made for this policy, or either for this model."""
    digest = files.digest(model.document())
    if policy is not None and policy.made_for != digest:
        raise CertificateMismatch("the policy was made for another model")
    if funnel is None:
        return
    made_for, its_policy = funnel.made_for
    if made_for != digest:
        raise CertificateMismatch("the funnel was made for another model")
    if its_policy is not None and policy is None:
        raise CertificateMismatch("the funnel is about a policy")
    if policy is not None and its_policy != files.digest(policy.document()):
        raise CertificateMismatch("the funnel was made for another policy")


def _comparison(
    models: list[Any],
    policies: list[Any],
    funnels: list[Any],
    period: float | None,
    held: Sequence[Held | None],
) -> Comparison:
    """The arithmetic for funnels of this kind."""
    kinds = {type(funnel) for funnel in funnels}
    if kinds == {TubeFunnel}:
        return PlanComparison(models[0], policies, funnels)
    if kinds == {SampledFunnel} and len(funnels) == 1:
        return SampledComparison(models[0], policies[0], funnels[0])
    if kinds == {ContinuousFunnel}:
        given = [Held.given(each) for each in held]
        return ContinuousComparison(models, policies, funnels, period, given)
    raise DataError("several funnels at once are held against tubes of one model only")


def _all_at_most(sizes: list[float], bound: float) -> bool:
    """Whether every size is shown to be; NaN is not."""
    return all(size <= bound for size in sizes)


def _outside(violated: str) -> str:
    if violated:
        return f"outside the tube; {violated}"
    return "outside although the assumption was kept: what runs is not what was proved"


def _numbers(y: Any) -> tuple[float, ...]:
    """A measured number or vector as a tuple."""
    return (float(y),) if isinstance(y, int | float) else tuple(float(value) for value in y)
