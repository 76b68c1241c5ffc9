"""ρ(t) by one backward sweep: the largest piecewise-linear ρ that the L-steps allow.

With s = log ρ the condition is ṡ ≥ margin - φ(t, ρ) at both ends of every interval, so each ρ_k
follows from ρ_{k+1}: no alternation, no objective. The box on which a Taylor model is bounded has
to hold the funnel, and what the model leaves out makes the funnel smaller: so where dynamics are
expanded, ρ and the box of every interval are chosen together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import Diagnosis, NoFunnel, diagnosed
from nlsid_core.design.continuous.expansion import BACK, LOWEST, NoExpansion
from nlsid_core.design.continuous.lstep import Ends, LSteps, Section, section_at
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.validity import validity_caps
from nlsid_core.dynamics.taylor import field_of
from nlsid_core.errors import Infeasible
from nlsid_core.progress import Progress, silent
from nlsid_core.sos.sphere import SphereSolution

ACCEPT = 0.5  # of the margin asked for: closer is not worth another program
MAX_TRIES = 12
NEAR = 1.01  # of a feasible ρ: closer to the largest is not worth another program
CLOSE = 1e-6  # of ρ: how near a bound's root is found
LOOKS, TRIES = 2, 3  # boxes in which ρ is estimated by the L-steps of the interval after; found
LARGER = 1.5  # of the box before: the largest in which ρ is estimated, and the first one else
BOX, FULL = 1.02, 0.95  # of ρ, the box in which it is found; of that box, what is no smaller
SMALLEST = 1e-3  # of ρ at an interval's end: it does not fall farther on one interval
MAX_BACK = 40  # how often ρ is lowered for the interval before


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


class Swept(NamedTuple):
    """ρ (K,), the L-steps at the ends of intervals, and the setting of their field.

    last: the interval from which backward the sweep is to be made again, if it is.
    """

    setting: Setting
    rho: FloatArray
    ends: list[Ends]
    last: int = -1


def wanted_of(
    setting: Setting, below: FloatArray | None = None, widths: FloatArray | None = None
) -> Wanted:
    """What ρ keeps to: below (K,), and where the dynamics are valid; with the first margin.

    widths: (K-1, m) that the applied input is off.
    """
    caps = validity_caps(setting.steps.field, setting.policy, setting.P, widths)
    caps = caps if below is None else np.minimum(caps, below)
    caps[-1] = min(setting.rho_final, caps[-1])
    return Wanted(np.full(len(caps) - 1, setting.margin(float(caps[-1]))), caps)


def swept(
    setting: Setting,
    wanted: Wanted,
    progress: Progress = silent,
    *,
    shares: Sequence[float] = (0.0, 1.0),
    most_back: int = MAX_BACK,
    again: Swept | None = None,
) -> Swept:
    """The largest ρ(t) backward from the end, and what it was found with.

    Where the dynamics are expanded, they are on each interval around what it gives; the setting
    that is returned has their field.

    shares: the instants of every interval where ρ has to hold, of dynamics that are not expanded.
    most_back: how often ρ at an interval's end is lowered for its start, where they are. Raises
    Infeasible naming the earliest time that was reached, and why it was not passed where least was
    missing.
    """
    steps, policy, P, expansion = setting.steps, setting.policy, setting.P, setting.expansion
    K = len(P)
    caps, k, back = wanted.caps.copy(), K - 2, 0
    rho = np.full(K, caps[-1])
    ends: dict[int, Ends] = {}
    if again is not None:
        rho, ends, k = again.rho.copy(), dict(enumerate(again.ends)), again.last
    farthest, refusal, left = K, Infeasible(""), -np.inf
    while k >= 0:
        after, cap = float(rho[k + 1]), float(caps[k])
        duals = ends[k + 1].start if k + 2 < K else None
        try:
            if expansion is None:
                instants = [section_at(steps, P, k, s) for s in shares]
                rho[k], ends[k] = largest_before(steps, instants, after, cap, wanted, duals)
            else:
                guess = after * rho[k + 1] / rho[k + 2] if k + 2 < K else after
                levels = (min(guess, cap), after, cap)
                rho[k], ends[k] = _expanded(setting, k, levels, wanted, duals)
            progress(f"rho at {policy.t[k]:.3g} s", 1 - k / (K - 1))
            k -= 1
            continue
        except NoExpansion as found:
            share = found.expansion.room(policy, P, k, after)
        except NoFunnel as found:
            if k < farthest or (k == farthest and found.left > left):
                farthest, refusal, left = k, found, found.left
            share = BACK
        back += 1
        if back > most_back or expansion is None:
            raise refusal from None
        # What ρ_{k+1} leaves at the end of this interval is too much for its box or its feedback.
        caps[k + 1] = share * after
        if k == K - 2:
            rho[-1] = caps[-1]
        else:
            k += 1
    made = replace(setting, steps=steps.as_it_is()) if expansion is None else with_field(setting)
    return Swept(made, rho, [ends[k] for k in range(K - 1)])


def _expanded(
    setting: Setting,
    k: int,
    levels: tuple[float, float, float],
    wanted: Wanted,
    duals: list[SphereSolution] | None,
) -> tuple[float, Ends]:
    """The largest ρ, nearly, at the start of interval k, and its L-steps, for cubics around it.

    levels: a guess of it, ρ at the interval's end, and what it is below. duals: of the interval
    after. They estimate ρ in boxes that come closer to it; it is then found in the last.
    """
    steps, policy, P, expansion = setting.steps, setting.policy, setting.P, setting.expansion
    assert expansion is not None  # as in `swept`
    guess, after, cap = levels
    held = None if steps.widths is None else steps.widths[k]
    # Of a held input the middle counts too: else few knots do, for a narrow funnel.
    shares = (0.0, 1.0) if held is None else (0.0, 0.5, 1.0)
    # Of modes there is no estimate that is near enough.
    known = duals is not None and not len(steps.limits)
    box, looks, tries = (guess, LOOKS, TRIES) if known else (min(LARGER * guess, cap), 0, 2)
    while True:
        try:
            steps.local[k] = expansion.around(policy, P, k, (box, after), held)
            instants = [section_at(steps, P, k, s) for s in shares]
            if looks and duals is not None:
                most = min(LARGER * box, cap)
                rho = estimated_before(steps, instants, after, most, wanted, duals)
                rho = max(rho, box / 4)  # an estimate: whether there is none is found below
                looks -= 1
                box = float(np.sqrt(box * rho)) if looks else min(BOX * rho, cap)
                continue
            rho, found = largest_before(steps, instants, after, min(box, cap), wanted, duals)
        except (NoExpansion, NoFunnel):
            if box <= SMALLEST * after:
                raise
            box, cap = box / 2, box / 2
            continue
        tries -= 1
        if FULL * box <= rho < box or rho >= cap or not tries:
            return rho, found
        box, duals = min(BOX * rho if rho < box else LARGER * box, cap), found.start


def with_field(setting: Setting) -> Setting:
    """The setting with the field of the cubics that its L-steps hold."""
    steps, policy = setting.steps, setting.policy
    field = field_of([steps.local[k] for k in range(len(policy.t) - 1)], policy.t)
    policy = replace(policy, vector_field=files.digest(field.document()))
    proving = steps.like(field, policy)
    proving.kappa = None if steps.kappa is None else steps.kappa.copy()
    return replace(setting, steps=proving)


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
