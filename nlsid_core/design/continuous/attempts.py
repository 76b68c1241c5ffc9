"""Which settings a funnel is looked for with: a list, made once and tried in order.

Each attempt makes a setting of what was tried before, or none where it would be no help; what every
one gave is told. No limit of time decides which are tried.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.finer import NEARBY, coarse, halved, most_knots, refusal_time
from nlsid_core.design.continuous.reachable import reached
from nlsid_core.design.continuous.search import Found, search
from nlsid_core.design.continuous.setting import MOST_KNOTS, Setting, final_level
from nlsid_core.dynamics import Nominal
from nlsid_core.errors import Infeasible
from nlsid_core.progress import Progress

HALVINGS = 6  # of intervals where P is far from linear
FINER = ("knots", "remainder")  # what is less where knots are closer
FASTER, SLOWER = 0.25, 4.0  # of the default R

Again: TypeAlias = Callable[..., Setting]  # the same problem around another motion, with another R


@dataclass(frozen=True, eq=False)
class Tried:
    """A setting that was tried, as what, and why it has no funnel."""

    name: str
    setting: Setting
    refusal: Infeasible

    @property
    def cause(self) -> str:
        """The term that takes most; "knots" where it lies between them."""
        return self.refusal.diagnosis.dominant if isinstance(self.refusal, NoFunnel) else "knots"

    @property
    def t(self) -> float:
        """When in the motion it was refused, in s; -inf if it says nothing about that."""
        t = refusal_time(self.refusal)
        return -np.inf if t is None else t

    def __str__(self) -> str:
        found = self.refusal if isinstance(self.refusal, NoFunnel) else self.refusal.__cause__
        if not isinstance(found, NoFunnel):
            return f"{self.name}: none ({self.refusal})"
        return f"{self.name}: none at {found.t:.3g} s, because of {found.diagnosis.cause}"


Attempt: TypeAlias = tuple[str, Callable[[list[Tried]], Setting | None]]


def attempts(setting: Setting, again: Again | None, *, other_weights: bool) -> list[Attempt]:
    """As it is; with more knots where that stopped it; around what w reaches; with another R.

    again: None for a given policy, whose motion keeps its knots. other_weights: whether R is free.
    """
    listed: list[Attempt] = [("as it is", lambda _: setting)]
    if again is not None:
        listed += HALVINGS * [("with more knots", partial(_finer, again))]
    listed.append(("around what w reaches", partial(_pushed, again)))
    if again is not None and other_weights:
        listed += [
            ("with a quarter of R", partial(_weighed, again, FASTER)),
            ("with four times R", partial(_weighed, again, SLOWER)),
        ]
    return listed


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


def _finer(again: Again, tried: list[Tried]) -> Setting | None:
    """With more knots than the last, near where that was refused; see `halved`."""
    last, before, nearby = tried[-1], np.inf, NEARBY
    for one in tried:
        nearby = 2 * nearby if one.t >= before else NEARBY
        before = min(one.t, before)
    chosen = halved(last.setting, last.refusal, nearby) if last.cause in FINER else None
    if chosen is None:
        return None
    policy = last.setting.policy
    return again(Nominal(policy.x, policy.u).halved(chosen))


def _pushed(again: Again | None, tried: list[Tried]) -> Setting | None:
    """P(t) of what a pushed linear loop reaches, if w stopped the last."""
    return _reached(tried[-1].setting, again) if tried[-1].cause == "disturbance" else None


def _weighed(again: Again, factor: float, tried: list[Tried]) -> Setting:
    """R times this, around the motion as it was given."""
    first = tried[0].setting
    return again(Nominal(first.policy.x, first.policy.u), R=factor * first.weights[1])


def _reached(setting: Setting, again: Again | None) -> Setting | None:
    """The setting with P(t) of what a pushed linear loop reaches; None if that misses the goal.

    again: the same problem around a motion with more knots, if it can have more.
    """
    for _ in range(HALVINGS):
        found, policy, steps = reached(setting), setting.policy, setting.steps
        if found is None:
            return None
        if found.size < 1:
            steps.tightness = found.tightness
            rho = final_level(policy, found.P, setting.goal, setting.expansion)
            return replace(setting, P=found.P, rho_final=rho)
        more = int(found.coarse.sum())
        if again is None or not more or len(policy.t) + more > MOST_KNOTS:
            return None
        setting = again(Nominal(policy.x, policy.u).halved(found.coarse))
    return None


def with_knots(setting: Setting, again: Again) -> Setting:
    """The setting with more knots where P(t) is far from linear, such as near the goal."""
    most = most_knots(len(setting.policy.t))
    for _ in range(HALVINGS):
        chosen = coarse(setting, most)
        if not chosen.any():
            break
        setting = again(Nominal(setting.policy.x, setting.policy.u).halved(chosen))
    return setting
