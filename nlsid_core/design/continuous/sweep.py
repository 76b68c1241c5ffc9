"""ρ(t) by one backward sweep: the largest piecewise-linear ρ that the L-steps allow.

With s = log ρ the condition is ṡ ≥ margin - φ(t, ρ) at both ends of every interval, so each ρ_k
follows from ρ_{k+1}: no alternation, no objective.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import Diagnosis, NoFunnel, diagnosed
from nlsid_core.design.continuous.lstep import LSteps, Section
from nlsid_core.sos.sphere import SphereSolution

ACCEPT = 0.5  # of the margin asked for: closer is not worth another program
MAX_TRIES = 12
NEAR = 1.01  # of a feasible ρ: closer to the largest is not worth another program
CLOSE = 1e-6  # of ρ: how near a bound's root is found
LOWEST = 1e-9  # of ρ at the right end: below, there is no funnel worth the name


@dataclass(frozen=True, eq=False)
class Wanted:
    """What ρ(t) keeps to.

    margins: (K-1,) what (ρ̇ - Ẇ)/ρ keeps above zero on each interval, in 1/s. caps: (K,) that ρ
    keeps below, and what it is at the end. expected: whether ρ is likely to be at its caps, and
    tried there first.
    """

    margins: FloatArray
    caps: FloatArray
    expected: bool = False


@dataclass(frozen=True, eq=False)
class Ends:
    """One interval's L-steps: solutions at its start and end per vertex; margins include ρ̇/ρ."""

    start: list[SphereSolution]
    end: list[SphereSolution]


class Again(NamedTuple):
    """ρ (K,) and L-steps of a sweep that is made again from interval `last` backward."""

    rho: FloatArray
    ends: list[Ends]
    last: int


def largest_before(
    steps: LSteps,
    instants: Sequence[Section],
    after: float,
    cap: float,
    wanted: Wanted,
    duals: list[SphereSolution] | None,
) -> tuple[float, Ends]:
    """The largest ρ ≤ cap at the start of an interval that ends with ρ = `after`, and its L-steps.

    duals: solutions nearby.
    """
    start, *between, end = instants
    h = end.t - start.t
    steps.bound_pushes(end, after)
    first = _Instant(steps, start, 0.0, after, h, wanted)

    # The end's program is solved until it allows as much as the start may.
    near = None
    if duals is not None and not wanted.expected and not len(steps.limits):
        near = duals
        cap = estimated_before(steps, instants, after, cap, wanted, duals)
    at_end = steps.solve(end, after, duals, enough=(cap / after - 1) / h + first.margin)
    phi = min(s.m for s in at_end)
    cap = min(cap, first.allowed(phi))
    if cap <= LOWEST * after:  # ρ̇ cannot be large enough for this end
        why = partial(diagnosed, steps.as_it_is(), [end], [after], after / h)
        raise NoFunnel(end.t, why, phi - first.margin)

    for section in between:
        inner = _Instant(steps, section, (section.t - start.t) / h, after, h, wanted)
        cap, _ = inner.largest(cap, at_end)
    rho, at_start = first.largest(cap, near or at_end)
    return rho, Ends(at_start, at_end)


def estimated_before(
    steps: LSteps,
    instants: Sequence[Section],
    after: float,
    cap: float,
    wanted: Wanted,
    duals: list[SphereSolution],
) -> float:
    """The ρ ≤ cap that `largest_before` may find, by bounds of these dual solutions alone."""
    start, end = instants[0], instants[-1]
    steps.bound_pushes(end, after)
    first = _Instant(steps, start, 0.0, after, end.t - start.t, wanted)
    cap = min(cap, first.allowed(steps.predicted(end, after, duals)))
    return first.bound(duals, cap)


@dataclass(frozen=True, eq=False)
class _Instant:
    """An instant at s = share of an interval of h s, on which ρ is linear from ρ_k to `after`."""

    steps: LSteps
    section: Section
    share: float
    after: float
    h: float
    wanted: Wanted

    @property
    def margin(self) -> float:
        """What the interval asks for, in 1/s."""
        return float(self.wanted.margins[self.section.interval])

    def here(self, rho: float) -> float:
        """ρ at the instant, for ρ_k = rho."""
        return (1 - self.share) * rho + self.share * self.after

    def slack(self, rho: float, phi: float) -> float:
        """What is left of the margin, in 1/s, for ρ_k = rho and φ at the instant."""
        growth = (self.after - rho) / self.here(rho) / self.h
        return phi + growth - self.margin

    def allowed(self, phi: float) -> float:
        """The largest ρ_k that φ at the interval's end leaves the margin for."""
        return self.after * (1 + self.h * (phi - self.margin))

    def bound(self, duals: list[SphereSolution], cap: float) -> float:
        """The largest ρ_k ≤ cap, nearly, at which the bound by dual solutions leaves the margin."""

        def left(rho: float) -> float:
            return self.slack(rho, self.steps.predicted(self.section, self.here(rho), duals))

        return cap if cap <= LOWEST * self.after else _root(left, LOWEST * self.after, cap)

    def largest(
        self, cap: float, duals: list[SphereSolution]
    ) -> tuple[float, list[SphereSolution]]:
        """The largest ρ_k ≤ cap with which the L-step leaves the margin, and that L-step."""
        steps, at_cap = self.steps, self.wanted.expected
        feasible, infeasible = 0.0, np.inf
        best: list[SphereSolution] | None = None
        for _ in range(MAX_TRIES + steps.cases):  # one that fails is solved for one case
            if cap <= LOWEST * self.after:
                break
            rho = cap if at_cap else self.bound(duals, min(cap, infeasible))
            if best is not None and rho <= feasible:
                break
            needed = -self.slack(rho, 0.0)
            least = needed - ACCEPT * self.margin
            found = steps.solve(self.section, self.here(rho), duals, least=least, enough=needed)
            left = self.slack(rho, min(s.m for s in found))
            if left >= -ACCEPT * self.margin:
                if not len(steps.limits) or rho >= cap:  # else `predicted` may be too low
                    return rho, found
                done = rho <= NEAR * feasible
                feasible, best = rho, found
                if done:
                    break
            else:
                infeasible, at_cap = min(infeasible, rho), False
            duals = found
        if best is None:
            raise NoFunnel(self.section.t, partial(self.why, steps.as_it_is(), duals))
        return feasible, best

    def why(self, kept: LSteps, duals: list[SphereSolution]) -> Diagnosis:
        """What takes the margin away, at the ρ where least is missing; kept: the L-steps then."""
        levels = (self.after * np.geomspace(1e-3, 1.0, 12)).tolist()
        values = [self.slack(r, kept.predicted(self.section, self.here(r), duals)) for r in levels]
        rho = levels[int(np.argmax(values))]
        growth = (self.after - rho) / self.h
        return diagnosed(kept, [self.section], [self.here(rho)], growth)


def _root(slack: Callable[[float], float], low: float, high: float) -> float:
    """The largest r in [low, high] with slack(r) ≥ 0, nearly, after a coarse look from above."""
    slack = cache(slack)  # a search between two values asks for them again
    if slack(high) >= 0:
        return high
    step, inside = 0.99, high
    while inside > low and slack(inside) < 0:
        high, inside = inside, inside * step
        step *= step
    return low if inside <= low else float(brentq(slack, inside, high, xtol=CLOSE * high))
