"""One sample against the sets of one kind: the arithmetic of a monitor, without stamps or verdicts.

A sample in, sizes out: how far out of its set the state is, 1 on the boundary, rounded up so that a
size of at most 1 is inside in exact arithmetic.
"""

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateMismatch, DataError, ShapeError, apart
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.factor import UNIT, refuse_coarse, refuse_unmonitorable
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.policies.tube import TubePolicy
from nlsid_core.running.assumption import meter_of
from nlsid_core.running.held import Held
from nlsid_core.running.observer import StateObserver
from nlsid_core.running.reading import Level, unsaid
from nlsid_core.running.tubes import ROUNDING, assuming

COMMAND_TOLERANCE = 1e-9  # relative: rounding between computing a policy's input and recording it


class Centre(Enum):
    """What a tube is around: the model driven by the received commands, or the policy's plan.

    MOTION is COMMAND for a robot that may be in motion when a run begins: not from the measured
    start, but from one that the range of the inputs bounds, once that has faded.
    """

    COMMAND = "command"
    MOTION = "motion"
    PROFILE = "profile"


class Compared(NamedTuple):
    """One sample against m funnels: a list entry for each.

    used: of the assumption, 1 = all. worst: names of axes. broken: how the assumption is broken,
    empty if it is not. levels: None where being in the set is all there is to say.
    """

    sizes: list[float]
    used: list[float]
    worst: list[str]
    broken: list[str]
    nominal: list[tuple[float, ...]]
    deviation: list[list[float]]
    levels: list[Level] | None = None


class Comparison(Protocol):
    """A kind's arithmetic for one run; `when`: as its funnels count, samples or s.

    lags: samples before sample 0 that it needs. last: of each funnel, the last `when` it covers.
    assuming: of each funnel, its assumption in words.
    """

    period: float
    lags: int
    last: list[float]
    assuming: list[str]
    over: list[str]

    def restart(self) -> None:
        """A new run."""

    def read(self, y: Any, u: Any) -> tuple[Any, Any, tuple[float, ...]]:
        """The sample as this kind takes it, and what is measured; ShapeError if it does not fit."""

    def fault(self, t: float, y: Any, u: Any, *, needs_input: bool) -> str:
        """Why this sample cannot be judged, empty if it can."""

    def when(self, k: int, t: float) -> float:
        """Sample k at t s after the start, as the funnels count."""

    def collect(self, y: Any, u: Any) -> list[str] | None:
        """Take a sample before sample 0: how each assumption is broken if it was the last."""

    def compare(self, when: float, t: float, y: Any, u: Any) -> Compared:
        """The next sample against the sets; SolverError if the model has no next state."""


class PlanComparison:
    """A linear model's output beside the plans of m policies, each with its funnel of tubes.

    A policy has one observer x̂, and so have the tubes beside it. Each funnel's numbers are the same
    bit for bit alone or with others.
    """

    def __init__(
        self,
        model: DifferenceEquation,
        policies: Sequence[TubePolicy],
        funnels: Sequence[TubeFunnel],
    ) -> None:
        if any(policy.period != model.period for policy in policies):
            raise CertificateMismatch("the policy has another sample time than the model")
        if any(tube.follows is not None for funnel in funnels for tube in funnel.tubes):
            raise CertificateMismatch("around a plan no level follows the commands")
        for funnel in funnels:
            refuse_unmonitorable(funnel)
        self.model, self._funnels = model, tuple(funnels)
        self.period, self.lags = model.period, len(model)
        self._plans = [policy.plan(model) for policy in policies]
        self._hidden: list[list[float]] = []  # of each plan's tubes, what rounding can hide
        for plan, funnel in zip(self._plans, funnels, strict=True):
            most_x, most_y = np.abs(plan.x).max(axis=0), np.abs(plan.y).max(keepdims=True)
            hidden = [tube.hidden(most_x, most_y) for tube in funnel.tubes]
            for tube, part in zip(funnel.tubes, hidden, strict=True):
                refuse_coarse(part, tube.half_widths, "the plan")
            self._hidden.append([float(part[0]) for part in hidden])
        self.last = [
            min(plan.last, funnel.last) for plan, funnel in zip(self._plans, funnels, strict=True)
        ]
        self._step = np.vstack([model.A.T, model.B.T, model.offset])  # of a row [x̂, u, 1]
        self._D, self._c = model.D, model.c
        self.assuming = [assuming(funnel.tubes) for funnel in funnels]
        self.over = [f"{last + 1:g} samples" for last in self.last]
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._y_lags: list[float] = []
        self._u_lags: list[float] = []
        self._spent = [[0.0] * len(funnel.tubes) for funnel in self._funnels]

    def read(self, y: Any, u: Any) -> tuple[Any, Any, tuple[float, ...]]:
        """Numbers as they are."""
        return y, u, (y,)

    def fault(self, t: float, y: float, u: float, *, needs_input: bool) -> str:  # noqa: ARG002
        """Why this sample cannot be judged, empty if it can."""
        if abs(y) < np.inf and abs(u) < np.inf:
            return ""
        if not abs(y) < np.inf:
            return f"{self.model.y.name} is {y} at t = {t:g} s"
        return f"no {self.model.u.name} at t = {t:g} s ({unsaid(u)})"

    def when(self, k: int, _t: float) -> float:
        """The sample's number."""
        return k

    def collect(self, y: float, u: float) -> list[str] | None:
        """Gather the first n samples, which give the observers their exact state."""
        self._y_lags.append(y)
        self._u_lags.append(u)
        if len(self._y_lags) < len(self.model):
            return None
        x = self.model.state_after(self._y_lags, self._u_lags)
        self._x = [x] * len(self._funnels)
        broken = []
        for plan, funnel in zip(self._plans, self._funnels, strict=True):
            size = funnel.start_size(x - plan.x[0])
            far = f"started outside the inlet: {size:.3g} times as far out as its boundary"
            broken.append("" if size <= 1.0 else far)
        return broken

    def compare(self, when: float, t: float, y: float, u: float) -> Compared:
        """Sample k = `when` against the tubes, then every x̂ one sample on."""
        k, known = int(when), np.array([u, 1.0])
        found = Compared([], [], [], [], [], [])
        for i, plan in enumerate(self._plans):
            x = self._x[i]
            e = y - (float(x[0]) + self._D * u + self._c)
            planned = float(plan.y[min(k, len(plan) - 1)])
            size, used, most = self._held(i, k, y - planned, e)
            found.sizes.append(size)
            found.used.append(used)
            found.worst.append(self.model.y.name)
            found.broken.append(self._broken(k, t, u, i, used, most) if k <= plan.last else "")
            found.nominal.append((planned,))
            found.deviation.append([y - planned, e])
            self._x[i] = np.append(x, known) @ self._step + plan.policy.L * e
        return found

    def _held(self, i: int, k: int, away: float, e: float) -> tuple[float, float, int]:
        """|o| in half-widths, the part of a level used and whose: the most of funnel i's tubes."""
        size, used, most, spent = 0.0, 0.0, 0, self._spent[i]
        for j, tube in enumerate(self._funnels[i].tubes):
            spent[j] = (tube.rho * spent[j] + tube.R[0, 0] * e * e) * (1.0 + 8.0 * UNIT)
            if tube.samples is not None and k >= tube.samples:
                continue
            size = max(
                size, (abs(away) + self._hidden[i][j]) / (tube.half_widths[0] * (1.0 - ROUNDING))
            )
            part = spent[j] / (tube.level * (1.0 - ROUNDING))
            if not part <= used:
                used, most = part, j
        return size, used, most

    def _broken(self, k: int, t: float, u: float, i: int, used: float, most: int) -> str:
        """How funnel i's assumption is broken at this sample; most: the tube of which `used` is."""
        plan, (lowest, highest) = self._plans[i], self.model.u_range
        planned, meant = float(plan.planned[k]), plan(k, self._x[i])
        low, high = min(planned, meant), max(planned, meant)
        room = COMMAND_TOLERANCE * (1.0 + abs(meant))
        if not used <= 1.0:
            tube, spent = self._funnels[i].tubes[most], self._spent[i][most]
            unit = tube.energy_unit([self.model.y])
            return (
                f"innovation energy {spent:.4g}{unit} above the level {tube.level:.4g}{unit} "
                f"at t = {t:g} s"
            )
        if not lowest <= u <= highest:
            told = apart(u, lowest, highest)
            fitted = f"[{told[1]}, {told[2]}] {self.model.u.unit}".rstrip()
            return f"{self.model.u.name} {told[0]} outside the fitted range {fitted}"
        if not low - room <= u <= high + room:
            wanted = f"{meant:.6g} {self.model.u.unit}".rstrip()
            return f"{self.model.u.name} {u:.6g} is not the policy's {wanted}, at t = {t:g} s"
        return ""


class SampledComparison:
    """The estimate of a measured state against its tube around a motion."""

    lags = 0

    def __init__(self, model: MeasuredState, policy: SampledPolicy, funnel: SampledFunnel) -> None:
        self.model, self._policy, self._funnel = model, policy, funnel
        refuse_unmonitorable(funnel)
        refuse_coarse(np.spacing(np.abs(policy.x)), funnel.half_widths, "the motion")
        self.period, self.last = model.period, [funnel.last]
        a = funnel.assumption
        self.assuming = [f"the disturbance's {a.form} ≤ {a.bound:.4g}"]
        self.over = [f"{len(policy) * model.period:g} s"]
        self._meter = meter_of(funnel)
        self._up = 1.0 + float(np.max(funnel.rounding))  # no size is below its exact value
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._observer = StateObserver(self.model, self._policy.L)
        self._meter.restart()
        self._u_before: FloatArray | None = None

    def read(self, y: Any, u: Any) -> tuple[Any, Any, tuple[float, ...]]:
        """The state (n,) and the input (p,), None if there is none."""
        return read_vectors(y, u, len(self.model))

    def fault(self, t: float, y: FloatArray, u: FloatArray | None, *, needs_input: bool) -> str:
        """Why this sample cannot be judged, empty if it can."""
        return vectors_fault(t, y, u, len(self.model.u) if needs_input else 0)

    def when(self, k: int, _t: float) -> float:
        """The sample's number."""
        return k

    def collect(self, _y: FloatArray, _u: FloatArray | None) -> list[str] | None:
        """There is nothing before sample 0."""
        raise DataError("a sampled funnel takes no samples before its start")

    def compare(self, when: float, t: float, y: FloatArray, u: FloatArray | None) -> Compared:
        """Sample k = `when` against the tube."""
        k, funnel = int(when), self._funnel
        x = self._observer.update(y, self._u_before)
        self._u_before = u
        nominal = self._policy.x[k]
        x_bar = x - nominal
        disturbance = self._meter.update(k, self._observer.d) * self._up if k else 0.0
        bound = funnel.assumption.bound
        size = funnel.size(k, x_bar)
        return Compared(
            [size],
            [disturbance / bound if bound else np.inf * bool(disturbance)],
            [self.model.x[int(np.argmax(np.abs(x_bar) / funnel.widths(k)))].name],
            [self._broken(k, t, x, x_bar, u, disturbance)],
            [tuple(nominal.tolist())],
            [x_bar.tolist()],
            [self._level(k, size, x_bar)],
        )

    def _broken(
        self,
        k: int,
        t: float,
        x: FloatArray,
        x_bar: FloatArray,
        u: FloatArray | None,
        disturbance: float,
    ) -> str:
        """How what the proof assumes is broken at this sample."""
        a = self._funnel.assumption
        if k == 0 and not (start := self._funnel.start_size(x_bar)) <= 1.0:
            return f"started outside: {start:.4g} times as far out as the boundary of the start"
        if self._farther_than_roots(k):
            return f"the model's step ended at a root beyond the proved ones at t = {t:g} s"
        if not disturbance <= a.bound:
            return (
                f"disturbance {a.form} {disturbance:.4g} above the assumed {a.bound:.4g} "
                f"at t = {t:g} s"
            )
        if u is None or k > self._policy.last:
            return ""
        return not_the_policys(t, u, self._policy(k, x), [signal.name for signal in self.model.u])

    def _farther_than_roots(self, k: int) -> bool:
        """Whether an implicit step's next rates are farther from the nominal than was proved."""
        predicted, roots = self._observer.predicted, self._funnel.roots
        if roots is None or predicted is None:
            return False
        d = len(predicted) // 2
        away = (predicted - self._policy.x[k])[d:]
        size = float(np.linalg.norm(self._funnel.S[k][d:, d:] @ away)) * self._up
        return not size <= float(roots[k])

    def _level(self, k: int, size: float, x_bar: FloatArray) -> Level:
        norm, inlet = self._funnel.norm(k, x_bar), float(self._funnel.inlet[k])
        if k == self._funnel.last and norm <= inlet + self._funnel.margin:
            return Level.GOAL
        if size <= 1.0:
            return Level.TUBE
        return Level.INLET if norm <= inlet else Level.NONE


class ContinuousComparison:
    """A measured state against the funnels of a motion in continuous time, one stage after another.

    The input is held from one sample to the next, `period` s later; unless the proof covers that,
    it is about a policy that is applied continuously. The sets are the proved ones either way. How
    old inputs become is measured against the hold; other assumptions are said in words. The state
    is inside if all that it may be, measured so, is.
    """

    lags = 0

    def __init__(
        self,
        fields: Sequence[VectorField],
        policies: Sequence[ContinuousPolicy],
        funnels: Sequence[ContinuousFunnel],
        period: float | None,
        held: Sequence[Held],
    ) -> None:
        if period is None or not period > 0.0:
            raise DataError(
                "a continuous funnel names no time between samples: `period` should be s "
                f"above 0, is {period}"
            )
        for each in held:
            each.refuse(period)
        self._held = tuple(held)
        for before, after in pairwise(funnels):
            if before.tf != after.t0 or before.n != after.n:
                raise CertificateMismatch("the stages do not follow each other")
        for funnel in funnels:
            refuse_unmonitorable(funnel)
        self._policies, self._funnels = tuple(policies), tuple(funnels)
        self.period, self.n, self.m = period, fields[0].n, fields[0].m
        self.last = [funnels[-1].tf]
        pushed = [len(field.uncertain) > 0 for field in fields]
        self._said = [
            (f"stage {i} of {len(held)}: " if len(held) > 1 else "")
            + each.assuming(period)
            + (", and w stays in its box" if more else "")
            for i, (each, more) in enumerate(zip(held, pushed, strict=True), start=1)
        ]
        self._measures = not pushed[0] and held[0].hold > 0.0
        self.over = [f"{funnels[-1].tf - funnels[0].t0:g} s"]
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._before, self._proved = np.nan, False
        self.assuming = self._said[:1]

    def read(self, y: Any, u: Any) -> tuple[Any, Any, tuple[float, ...]]:
        """The state (n,) and the input (m,), None if there is none."""
        return read_vectors(y, u, self.n)

    def fault(self, t: float, y: FloatArray, u: FloatArray | None, *, needs_input: bool) -> str:
        """Why this sample cannot be judged, empty if it can."""
        return vectors_fault(t, y, u, self.m if needs_input else 0)

    def when(self, _k: int, t: float) -> float:
        """The time in s on the funnel's own clock."""
        return max(self._funnels[0].t0 + t, self._funnels[0].t0)

    def collect(self, _y: FloatArray, _u: FloatArray | None) -> list[str] | None:
        """There is nothing before sample 0."""
        raise DataError("a continuous funnel takes no samples before its start")

    def compare(self, when: float, t: float, y: FloatArray, u: FloatArray | None) -> Compared:
        """The state at `when` s against the set of the stage that is on."""
        stage = sum(when >= funnel.tf for funnel in self._funnels[:-1])
        funnel, policy, held = self._funnels[stage], self._policies[stage], self._held[stage]
        self.assuming = [self._said[stage]]
        nominal = funnel.nominal(when)
        x_bar = y - nominal
        worst = int(np.argmax(np.abs(x_bar) / funnel.widths(when)))
        broken = ""
        if u is not None and when < self.last[0]:
            broken = not_the_policys(t, u, policy(when, y), [f"u{i}" for i in range(self.m)])
        starts = bool(np.isnan(self._before))
        age, hold = 0.0 if starts else t - self._before, held.hold
        self._before = t
        size = funnel.size(when, x_bar) + held.reach(funnel.shape(when))
        # With a hold the proof is about starts inside: what came in later has inputs from outside.
        self._proved = self._proved or (size <= 1.0 and (starts or not hold))
        if not self._proved:
            broken = "the run did not start in the funnel: nothing is proved of it"
        broken = held.overdue(age, t) or broken
        return Compared(
            [size],
            [age / hold if self._measures else np.nan],
            [f"x{worst}"],
            [broken],
            [tuple(nominal.tolist())],
            [x_bar.tolist()],
        )


def read_vectors(y: Any, u: Any, n: int) -> tuple[Any, Any, tuple[float, ...]]:
    """State (n,) and input as arrays, and what is measured; ShapeError if it is no state."""
    state = np.asarray(y, dtype=np.float64)
    if state.shape != (n,):
        raise ShapeError(f"the state should have shape ({n},): {state.shape}")
    applied = None if u is None else np.atleast_1d(np.asarray(u, dtype=np.float64))
    return state, applied, tuple(state.tolist())


def vectors_fault(t: float, y: FloatArray, u: FloatArray | None, inputs: int) -> str:
    """Why a sample cannot be judged, empty if it can; `inputs`: how many it needs."""
    if not np.isfinite(y).all():
        return f"state {y} at t = {t:g} s"
    if inputs and (u is None or u.shape != (inputs,) or not np.isfinite(u).all()):
        return f"no input at t = {t:g} s (it is {u})"
    return ""


def not_the_policys(t: float, u: FloatArray, wanted: FloatArray, names: Sequence[str]) -> str:
    """Which input is not what the policy wants, empty if all are."""
    apart = np.abs(u - wanted)
    if (apart <= COMMAND_TOLERANCE * (1.0 + np.abs(wanted))).all():
        return ""
    i = int(np.argmax(apart))
    return f"{names[i]} {u[i]:.6g} is not the policy's {wanted[i]:.6g} at t = {t:g} s"
