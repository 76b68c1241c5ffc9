"""The search for P(t): L-steps find multipliers, V-steps enlarge the set at every knot.

It starts from a funnel that holds at its knots and stops when the volume hardly grows.
What holds at knots alone proves nothing: the last funnel that can be proved for every t is taken.
Source: thesis (6.8).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nlsid_core.design.continuous.lstep import Ends, LSteps, section_at
from nlsid_core.design.continuous.pieces import Proved, prove_pieces, unsolved
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.validity import validity_caps
from nlsid_core.design.continuous.vstep import improved
from nlsid_core.errors import Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.progress import Progress, silent

STOP = 0.06  # growth of the volume from where the next V-step gains less than 1 %
MAX_ITERATIONS = 30
TRUST, SMALLEST = 0.7, 0.1  # of P, relative: from 0.35 to 0.7 the satellite takes one step less
SHAPE_MARGIN = 16.0  # times the sweep's margin: with P(t) free there is volume to pay it with
LEFT = 0.25  # of the margin: what L-steps leave of it is enough
INSIDE = 0.95  # of what validity allows, at the start: a V-step begins strictly inside
SHRINKS = 6  # one is usual
ROOM = 10.0  # times the margin, at the start, so that the first V-step has somewhere to go


def enlarge_shape(
    setting: Setting, funnel: ContinuousFunnel, margin: float, progress: Progress = silent
) -> tuple[ContinuousFunnel, Proved, list[tuple[str, float]]]:
    """Enlarge P(t), keeping the end, and prove the last funnel of the alternation that can be.

    The funnel stays where the dynamics are valid. margin: of the sweep, in 1/s. Raises Infeasible
    if none could be proved.
    """
    steps = setting.steps.as_it_is()
    margin *= SHAPE_MARGIN
    found, trust = [_start(steps, funnel, ROOM * margin)], TRUST
    for iteration in range(MAX_ITERATIONS):
        present, ends = found[-1]
        try:
            moved = replace(present, P=improved(steps, present, ends, margin, trust))
            larger = shrunk(steps, moved, margin, ends)
            growth = larger[0].volume_integral() / present.volume_integral()
        except (Infeasible, SolverError):
            growth = 0.0
        progress(f"P(t): {growth:.4g} times the volume", min(0.95, (iteration + 1) / 10))
        if growth > 1:
            found.append(larger)
        if abs(growth - 1) < STOP or trust < SMALLEST:
            break
        if growth < 1:
            trust /= 2
    history = [(f"P {i}", kept.volume_integral()) for i, (kept, _) in enumerate(found)]
    refusal = "no V-step made the funnel larger"
    for last, ends in reversed(found):
        if last.volume_integral() <= funnel.volume_integral():
            break
        bound_pushes(steps, last)
        proved = prove_pieces(steps, last, ends)
        if not proved.unproved:
            return last, proved, history
        refusal = f"no proof from {unsolved(steps.policy, proved.unproved)}: try more knots there"
    raise Infeasible(refusal)


def _start(
    steps: LSteps, funnel: ContinuousFunnel, margin: float
) -> tuple[ContinuousFunnel, list[Ends]]:
    """A funnel within this one with ρ = 1, and its L-steps; see `shrunk`.

    P/ρ at the knots, linear between them, is no longer what was swept.
    """
    P = funnel.P / funnel.rho[:, None, None]
    caps = INSIDE * validity_caps(steps.field, steps.policy, P)[:-1]
    P[:-1] /= np.minimum(caps, 1.0)[:, None, None]
    return shrunk(steps, replace(funnel, P=P, rho=np.ones(len(P))), margin)


def shrunk(
    steps: LSteps, funnel: ContinuousFunnel, margin: float, near: Sequence[Ends] | None = None
) -> tuple[ContinuousFunnel, list[Ends]]:
    """A funnel with ρ = 1 a little smaller than this one, whose L-steps leave enough, and these.

    P(t) that falls by exp(ε h) more on an interval of h s leaves ε more there: so little of the
    volume is lost to what a V-step takes to first order. near: L-steps of a funnel much the same.
    Raises Infeasible if what is missing does not become less.
    """
    P, h, worst = funnel.P, np.diff(funnel.t), np.inf
    for _ in range(SHRINKS):
        funnel = replace(funnel, P=(P + P.transpose(0, 2, 1)) / 2)
        bound_pushes(steps, funnel)
        near = solve_ends(steps, funnel, near, enough=LEFT * margin)
        left = np.array([min(s.m for s in (*pair.start, *pair.end)) for pair in near])
        missing = np.where(left < LEFT * margin, margin - left, 0.0)
        if not missing.any():
            return funnel, near
        if missing.max() >= worst:
            break
        worst = missing.max()
        later = np.cumsum((missing * h)[::-1])[::-1]
        P = P * np.exp(np.append(later, 0.0))[:, None, None]
    raise Infeasible("no smaller funnel leaves the margin")


def bound_pushes(steps: LSteps, funnel: ContinuousFunnel) -> None:
    """κ for this funnel, where w only pushes."""
    for k in range(len(funnel.t) - 1):
        steps.bound_pushes(section_at(steps, funnel.P, k, 1.0), float(funnel.rho[k + 1]))


def solve_ends(
    steps: LSteps,
    funnel: ContinuousFunnel,
    near: Sequence[Ends] | None = None,
    *,
    enough: float = np.inf,
) -> list[Ends]:
    """L-steps at both ends of every interval; near: those of a funnel that is much the same.

    enough: see `SphereProgram`.
    """
    found: list[Ends] = []
    for k in range(len(funnel.t) - 1):
        start, end = (section_at(steps, funnel.P, k, float(s)) for s in (0, 1))
        at_start, at_end = (None, None) if near is None else (near[k].start, near[k].end)
        first = steps.solve(start, float(funnel.rho[k]), at_start, enough=enough)
        last = steps.solve(end, float(funnel.rho[k + 1]), at_end or first, enough=enough)
        found.append(Ends(first, last))
    return found
