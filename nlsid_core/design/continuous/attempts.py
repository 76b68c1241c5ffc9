"""Which settings a funnel is looked for with: a list, made once and tried in order.

Each attempt makes a setting of what was tried before, or none where it would be no help; what every
one gave is told. No limit of time decides which are tried.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.finer import NEARBY, coarse, halved, most_knots, refusal_time
from nlsid_core.design.continuous.problem import ContinuousTracking
from nlsid_core.design.continuous.reachable import FLOOR, reached
from nlsid_core.design.continuous.search import Found, expected, search
from nlsid_core.design.continuous.setting import (
    MOST_KNOTS,
    Setting,
    final_level,
    limits_of,
    prepare,
    valid_rows,
)
from nlsid_core.design.continuous.validity import validity_caps
from nlsid_core.dynamics import Nominal
from nlsid_core.dynamics.vector_field import FEW_STATES
from nlsid_core.errors import Infeasible
from nlsid_core.progress import Progress

HALVINGS = 6  # of intervals where P is far from linear
AROUND = "around what pushes reach"
PUSHING = ("disturbance", "hold")  # what a reach counts
FINER = ("knots", "remainder", "hold")  # what is less where knots are closer
MOST_LIMITED = 2  # inputs that may saturate together: 9 modes, each with programs of its own
AT_LIMIT = 0.99  # of ρ's cap: an input reaches its limit
NARROW = 0.5  # of half-widths without limits: with less, few limited inputs may saturate


@dataclass(frozen=True, eq=False)
class Tried:
    """A setting that was tried, as what, and why it has no funnel."""

    name: str
    setting: Setting
    refusal: Infeasible

    @property
    def cause(self) -> str:
        """The term that takes most; "knots" where it lies between them."""
        return "knots" if self.found is None else self.found.diagnosis.dominant

    @property
    def found(self) -> NoFunnel | None:
        """What was refused, also where a hold is named; None if it lies between knots."""
        found = self.refusal if isinstance(self.refusal, NoFunnel) else self.refusal.__cause__
        return found if isinstance(found, NoFunnel) else None

    @property
    def t(self) -> float:
        """When in the motion it was refused, in s; -inf if it says nothing about that."""
        t = refusal_time(self.refusal)
        return -np.inf if t is None else t

    def __str__(self) -> str:
        if self.found is None:
            return f"{self.name}: none ({self.refusal})"
        return f"{self.name}: none at {self.found.t:.3g} s, because of {self.found.diagnosis.cause}"


Attempt: TypeAlias = tuple[str, Callable[[list[Tried]], Setting | None]]


def with_knots(problem: ContinuousTracking) -> Setting:
    """The setting of a problem, with more knots where P(t) is far from linear, as near the goal."""
    setting = prepare(problem)
    most = most_knots(len(setting.policy.t))
    for _ in range(HALVINGS if problem.policy is None else 0):
        chosen = coarse(setting, most)
        if not chosen.any():
            break
        setting = prepare(replace(problem, nominal=motion_of(setting).halved(chosen)))
    return setting


def attempts(problem: ContinuousTracking, setting: Setting) -> list[Attempt]:
    """As it is; with more knots where that stopped it; around what pushes reach.

    A given policy keeps its knots.
    """
    listed: list[Attempt] = [("as it is", lambda _: setting)]
    if problem.policy is None:
        listed += HALVINGS * [("with more knots", partial(_finer, problem))]
    listed.append((AROUND, partial(_pushed, problem, 0.0, False)))
    if problem.policy is None:
        listed.append((f"{AROUND}, with quicker feedback", partial(_pushed, problem, FLOOR, True)))
    return [*listed, (AROUND, partial(_pushed, problem, FLOOR, False))]


def first_found(listed: Sequence[Attempt], progress: Progress) -> tuple[Found, str]:
    """The funnel of the first attempt that has one, and in words what was tried before.

    Raises Infeasible with the reason of the attempt that came farthest, and what each other gave.
    """
    tried: list[Tried] = []
    for name, change in listed:
        try:
            setting = change(tried)
        except Infeasible as refusal:
            tried.append(Tried(name, tried[-1].setting, refusal))
            continue
        if setting is None:
            continue
        try:
            found = search(setting, progress)
        except Infeasible as refusal:
            tried.append(Tried(name, setting, refusal))
        else:
            return found, "; ".join((f"found {name}", *map(str, tried))) if tried else ""
    farthest = min(reversed(tried), key=lambda one: one.t)
    others = "; ".join(str(one) for one in tried if one is not farthest)
    said = f". Tried as well: {others}" if others else ""
    raise Infeasible(f"{farthest.refusal}{said}") from farthest.refusal


def widened(problem: ContinuousTracking, found: Found, progress: Progress) -> Found:
    """The funnel in which inputs saturate, if few may and it is much wider at the start."""
    setting, funnel, limits = found.setting, found.funnel, _limits(problem)
    field = setting.steps.field
    few = len(limits) <= (MOST_LIMITED if field.n <= FEW_STATES else 1)
    if problem.policy is not None or not len(limits) or not few or len(setting.policy.limits):
        return found
    bounded = replace(field, valid=valid_rows(limits, field.n))
    caps = validity_caps(bounded, setting.policy, setting.P)
    if problem.hold is None and (funnel.rho < AT_LIMIT * caps).all():  # a hold takes of the room
        return found
    again = replace(problem, nominal=motion_of(setting), R=setting.weights[1])
    try:
        free = expected(prepare(replace(again, limits=None)), progress)
        if funnel.rho[0] >= NARROW**2 * free.rho[0]:
            return found
        wider = search(prepare(again, saturated=True), progress)
    except Infeasible:
        return found
    return wider if wider.funnel.volume(funnel.t0) > funnel.volume(funnel.t0) else found


def motion_of(setting: Setting) -> Nominal:
    """The motion of a setting's policy."""
    return Nominal(setting.policy.x, setting.policy.u)


def _limits(problem: ContinuousTracking) -> FloatArray:
    return limits_of(problem.limits, problem.nominal.u.control.shape[2])


def _finer(problem: ContinuousTracking, tried: list[Tried]) -> Setting | None:
    """With more knots than the last, near where that was refused; see `halved`."""
    last, before, nearby = tried[-1], np.inf, NEARBY
    for one in tried:
        nearby = 2 * nearby if one.t >= before else NEARBY
        before = min(one.t, before)
    chosen = halved(last.setting, last.refusal, nearby) if last.cause in FINER else None
    if chosen is None:
        return None
    return prepare(replace(problem, nominal=motion_of(last.setting).halved(chosen)))


def _pushed(
    problem: ContinuousTracking, floor: float, settled: bool, tried: list[Tried]
) -> Setting | None:
    """P(t) of a pushed linear loop's reach, if that stopped any; None if it misses the goal.

    Where P turns fast on some intervals, there are more knots. settled: see `prepare`.
    """
    pushed = [one.setting for one in tried if one.cause in PUSHING]
    if not pushed:
        return None
    setting = pushed[-1]
    if settled:
        setting = prepare(replace(problem, nominal=motion_of(setting)), settled=True)
    for _ in range(HALVINGS):
        found = reached(setting, floor, stay=settled)
        if found is None:
            return None
        if found.size < 1:
            setting.steps.tightness = found.tightness
            rho = final_level(setting.policy, found.P, setting.goal, setting.expansion)
            return replace(setting, P=found.P, rho_final=rho)
        more = int(found.coarse.sum())
        if problem.policy is not None or not more or len(setting.policy.t) + more > MOST_KNOTS:
            return None
        finer = motion_of(setting).halved(found.coarse)
        setting = prepare(replace(problem, nominal=finer), settled=settled)
    return None
