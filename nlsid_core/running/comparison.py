"""One sample against the sets of one kind: the arithmetic of a monitor, without stamps or verdicts.

A sample in, sizes out: how far out of its set the state is, 1 on the boundary, rounded up so that a
size of at most 1 is inside in exact arithmetic.

Each kind has: lags, samples before sample 0 that it needs; last, the last `when` it covers, as its
funnels count: samples or s; assuming and over, what it assumes and how much it covers, in words.
`read` gives the sample as the kind takes it, and why it cannot be judged, or raises ShapeError;
`compare` raises SolverError if the model has no next state.
"""

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import CertificateMismatch, ShapeError, apart
from nlsid_core.funnels import ContinuousFunnel, SampledFunnel, TubeFunnel
from nlsid_core.funnels.factor import UNIT, refuse_coarse, refuse_unmonitorable
from nlsid_core.models import DifferenceEquation, StateModel
from nlsid_core.policies import SampledPolicy, TubePolicy
from nlsid_core.running.assumption import DisturbanceMeter
from nlsid_core.running.observer import StateObserver
from nlsid_core.running.reading import Level, unsaid
from nlsid_core.running.stage import Stage
from nlsid_core.running.tubes import ROUNDING, assuming

COMMAND_TOLERANCE = 1e-9  # relative: rounding between computing a policy's input and recording it


class Centre(Enum):
    """What a tube is around: the model driven by the received commands, or the policy's plan."""

    COMMAND = "command"
    PROFILE = "profile"


class Compared(NamedTuple):
    """One sample against a funnel.

    used: of the assumption, 1 = all. worst: the name of an axis. broken: how the assumption is
    broken, empty if it is not. level: None where being in the set is all there is to say.
    """

    size: float
    used: float
    worst: str
    broken: str
    nominal: tuple[float, ...]
    deviation: list[float]
    level: Level | None = None


class PlanComparison:
    """A linear model's output beside the plan of a policy, which has one observer x̂."""

    def __init__(self, model: DifferenceEquation, policy: TubePolicy, funnel: TubeFunnel) -> None:
        if policy.period != model.period:
            raise CertificateMismatch("the policy has another sample time than the model")
        if any(tube.follows is not None for tube in funnel.tubes):
            raise CertificateMismatch("around a plan no level follows the commands")
        refuse_unmonitorable(funnel)
        self.model, self._funnel = model, funnel
        self.period, self.lags = model.period, len(model)
        self._plan = plan = policy.plan(model)
        most_x, most_y = np.abs(plan.x).max(axis=0), np.abs(plan.y).max(keepdims=True)
        self._hidden: list[float] = []  # of each tube, what rounding can hide
        for tube in funnel.tubes:
            hidden = tube.hidden(most_x, most_y)
            refuse_coarse(hidden, tube.half_widths, "the plan")
            self._hidden.append(float(hidden[0]))
        self.last = min(plan.last, funnel.last)
        self._step = np.vstack([model.A.T, model.B.T, model.offset])  # of a row [x̂, u, 1]
        self._D, self._c = model.D, model.c
        self.assuming = assuming(funnel.tubes)
        self.over = f"{self.last + 1:g} samples"
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._lags: list[tuple[float, float]] = []
        self._spent = [0.0] * len(self._funnel.tubes)

    def read(
        self,
        t: float,
        y: float,
        u: Any,
        *,
        needs_input: bool,  # noqa: ARG002
    ) -> tuple[float, Any, str]:
        """Numbers as they are, and why they cannot be judged; u is None if no input came."""
        fault = ""
        if not abs(y) < np.inf:
            fault = f"{self.model.y.name} is {y} at t = {t:g} s"
        elif u is None or not abs(u) < np.inf:
            fault = f"no {self.model.u.name} at t = {t:g} s ({unsaid(u)})"
        return y, u, fault

    def when(self, k: int, _t: float) -> float:
        """The sample's number."""
        return k

    def collect(self, y: float, u: float) -> str:
        """Gather the first n samples, which give the observer its exact state."""
        self._lags.append((y, u))
        if len(self._lags) < len(self.model):
            return ""
        ys, us = zip(*self._lags, strict=True)
        self._x = self.model.state_after(ys, us)
        size = self._funnel.start_size(self._x - self._plan.x[0])
        if size <= 1.0:
            return ""
        return f"started outside the inlet: {size:.3g} times as far out as its boundary"

    def compare(self, when: float, t: float, y: float, u: float) -> Compared:
        """Sample k = `when` against the tubes, then x̂ one sample on."""
        k = int(when)
        e = y - (float(self._x[0]) + self._D * u + self._c)
        planned = float(self._plan.y[k])
        away = y - planned
        size, used, most, spent = 0.0, 0.0, 0, self._spent
        for j, tube in enumerate(self._funnel.tubes):
            spent[j] = (tube.rho * spent[j] + tube.R[0, 0] * e * e) * (1.0 + 8.0 * UNIT)
            if tube.samples is not None and k >= tube.samples:
                continue
            width = tube.half_widths[0] * (1.0 - ROUNDING)
            size = max(size, (abs(away) + self._hidden[j]) / width)
            part = spent[j] / (tube.level * (1.0 - ROUNDING))
            if not part <= used:
                used, most = part, j
        broken = self._exceeded(t, most) if not used <= 1.0 else self._other_input(k, t, u)
        self._x = np.append(self._x, [u, 1.0]) @ self._step + self._plan.policy.L * e
        return Compared(size, used, self.model.y.name, broken, (planned,), [away, e])

    def _exceeded(self, t: float, most: int) -> str:
        """What is said where a tube's level is exceeded."""
        tube, spent = self._funnel.tubes[most], self._spent[most]
        unit = tube.energy_unit([self.model.y])
        return (
            f"innovation energy {spent:.4g}{unit} above the level {tube.level:.4g}{unit} "
            f"at t = {t:g} s"
        )

    def _other_input(self, k: int, t: float, u: float) -> str:
        """How the input is not one that the proof covers."""
        lowest, highest = self.model.u_range
        meant = self._plan(k, self._x)
        low, high = self._plan.covers(k, self._x)
        room = COMMAND_TOLERANCE * (1.0 + abs(meant))
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

    def __init__(self, model: StateModel, policy: SampledPolicy, funnel: SampledFunnel) -> None:
        self.model, self._policy, self._funnel = model, policy, funnel
        refuse_unmonitorable(funnel)
        refuse_coarse(np.spacing(np.abs(policy.x)), funnel.half_widths, "the motion")
        self.period, self.last = model.period, funnel.last
        self.assuming = f"the disturbance's response ≤ {funnel.assumption.bound:.4g}"
        self.over = f"{len(policy) * model.period:g} s"
        self._meter = DisturbanceMeter(funnel.S, funnel.A)
        self._up = 1.0 + float(np.max(funnel.rounding))  # no size is below its exact value
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._observer = StateObserver(self.model, self._policy.L)
        self._meter.restart()
        self._u_before: FloatArray | None = None

    def read(self, t: float, y: Any, u: Any, *, needs_input: bool) -> tuple[Any, Any, str]:
        """The state (n,) and the input (p,), None if there is none."""
        return read_vectors(t, y, u, len(self.model), len(self.model.u) if needs_input else 0)

    def when(self, k: int, _t: float) -> float:
        """The sample's number."""
        return k

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
            size,
            disturbance / bound if bound else np.inf * bool(disturbance),
            self.model.x[int(np.argmax(np.abs(x_bar) / funnel.widths(k)))].name,
            self._broken(k, t, x, u, disturbance),
            tuple(nominal.tolist()),
            x_bar.tolist(),
            self._level(k, size, x_bar),
        )

    def _broken(
        self, k: int, t: float, x: FloatArray, u: FloatArray | None, disturbance: float
    ) -> str:
        """How what the proof assumes is broken at this sample."""
        a, start = self._funnel.assumption, self._funnel.start_size(x - self._policy.x[k])
        if k == 0 and not start <= 1.0:
            return f"started outside: {start:.4g} times as far out as the boundary of the start"
        if not disturbance <= a.bound:
            return (
                f"disturbance response {disturbance:.4g} above the assumed {a.bound:.4g} "
                f"at t = {t:g} s"
            )
        if u is None or k > self._policy.last:
            return ""
        return not_the_policys(t, u, self._policy(k, x), [signal.name for signal in self.model.u])

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

    def __init__(self, stages: Sequence[Stage]) -> None:
        parts: list[Any] = [stage[:3] for stage in stages]
        self._stages = [(*each, at.applied) for each, at in zip(parts, stages, strict=True)]
        funnels: list[ContinuousFunnel] = [funnel for _, _, funnel, _ in self._stages]
        for before, after in pairwise(funnels):
            if before.tf != after.t0 or before.n != after.n:
                raise CertificateMismatch("the stages do not follow each other")
        self._said = []
        for i, (field, _, funnel, held) in enumerate(self._stages, start=1):
            refuse_unmonitorable(funnel)
            which = f"stage {i} of {len(stages)}: " if len(stages) > 1 else ""
            pushed = ", and w stays in its box" if len(field.uncertain) else ""
            self._said.append(f"{which}{held.assuming}{pushed}")
        field, _, _, held = self._stages[0]
        self.period, self.n, self.m = held.period, field.n, field.m
        self._t0, self.last = funnels[0].t0, funnels[-1].tf
        self._measures = not len(field.uncertain) and held.hold > 0.0
        self.over = f"{self.last - self._t0:g} s"
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._before, self._proved = np.nan, False
        self.assuming = self._said[0]

    def read(self, t: float, y: Any, u: Any, *, needs_input: bool) -> tuple[Any, Any, str]:
        """The state (n,) and the input (m,), None if there is none."""
        return read_vectors(t, y, u, self.n, self.m if needs_input else 0)

    def when(self, _k: int, t: float) -> float:
        """The time in s on the funnel's own clock."""
        return max(self._t0 + t, self._t0)

    def compare(self, when: float, t: float, y: FloatArray, u: FloatArray | None) -> Compared:
        """The state at `when` s against the set of the stage that is on."""
        on = sum(when >= funnel.tf for _, _, funnel, _ in self._stages[:-1])
        _, policy, funnel, held = self._stages[on]
        self.assuming = self._said[on]
        nominal = funnel.nominal(when)
        x_bar = y - nominal
        worst = int(np.argmax(np.abs(x_bar) / funnel.widths(when)))
        broken = ""
        if u is not None and when < self.last:
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
            size,
            age / hold if self._measures else np.nan,
            f"x{worst}",
            broken,
            tuple(nominal.tolist()),
            x_bar.tolist(),
        )


Comparison: TypeAlias = PlanComparison | SampledComparison | ContinuousComparison


def read_vectors(t: float, y: Any, u: Any, n: int, inputs: int) -> tuple[Any, Any, str]:
    """State (n,) and input as arrays, and why they cannot be judged; ShapeError if it is no state.

    inputs: how many it needs.
    """
    state = np.asarray(y, dtype=np.float64)
    if state.shape != (n,):
        raise ShapeError(f"the state should have shape ({n},): {state.shape}")
    applied = None if u is None else np.atleast_1d(np.asarray(u, dtype=np.float64))
    fault = ""
    if not np.isfinite(state).all():
        fault = f"state {state} at t = {t:g} s"
    elif inputs and (
        applied is None or applied.shape != (inputs,) or not np.isfinite(applied).all()
    ):
        fault = f"no input at t = {t:g} s (it is {applied})"
    return state, applied, fault


def not_the_policys(t: float, u: FloatArray, wanted: FloatArray, names: Sequence[str]) -> str:
    """Which input is not what the policy wants, empty if all are."""
    apart = np.abs(u - wanted)
    if (apart <= COMMAND_TOLERANCE * (1.0 + np.abs(wanted))).all():
        return ""
    i = int(np.argmax(apart))
    return f"{names[i]} {u[i]:.6g} is not the policy's {wanted[i]:.6g} at t = {t:g} s"
