"""ρ(t) by one backward sweep: the largest piecewise-linear ρ that the L-steps allow.

With s = log ρ the condition is ṡ ≥ margin - φ(t, ρ) at both ends of every interval, so each ρ_k
follows from ρ_{k+1}: no alternation, no objective.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import brentq

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import Diagnosis, NoFunnel, diagnosed
from nlsid_core.design.continuous.lstep import LSteps, Section
from nlsid_core.progress import Progress, silent
from nlsid_core.sos.sphere import SphereSolution

ACCEPT = 0.5  # of the margin asked for: closer is not worth another program
MAX_TRIES = 12
NEAR = 1.01  # of a feasible ρ: closer to the largest is not worth another program
CLOSE = 1e-6  # of ρ: how near a bound's root is found
LOWEST = 1e-9  # of ρ at the right end: below, there is no funnel worth the name


@dataclass(frozen=True, eq=False)
class Ends:
    """One interval's L-steps: solutions at its start and end per vertex; margins include ρ̇/ρ."""

    start: list[SphereSolution]
    end: list[SphereSolution]


def sweep_rho(
    steps: LSteps,
    instants: Sequence[Sequence[Section]],
    *,
    margin: float,
    rho_final: float = 1.0,
    caps: FloatArray | None = None,
    expected: bool = False,
    progress: Progress = silent,
) -> tuple[FloatArray, list[Ends]]:
    """ρ (K,) with ρ(t_f) = rho_final and the L-steps at both ends of every interval.

    instants: per interval its start, its end and, between them, others where ρ has to hold too.
    margin: what (ρ̇ - Ẇ)/ρ keeps above zero, in 1/s. caps: (K,) that ρ keeps below;
    expected: whether it is likely to be there, and tried there first.
    Raises Infeasible naming the time.
    """
    rho = np.empty(len(instants) + 1)
    rho[-1] = rho_final
    ends: list[Ends] = []
    duals: list[SphereSolution] | None = None
    for k in range(len(instants) - 1, -1, -1):
        start, *between, end = instants[k]
        h = end.t - start.t
        steps.bound_pushes(end, rho[k + 1])
        wanted = (
            (caps[k] / rho[k + 1] - 1) / h + margin if expected and caps is not None else np.inf
        )
        at_end = steps.solve(end, rho[k + 1], duals, enough=wanted)
        phi = min(s.m for s in at_end)
        cap = rho[k + 1] * (1 + h * (phi - margin))
        if cap <= LOWEST * rho[k + 1]:  # ρ̇ cannot be large enough for this end
            after = float(rho[k + 1])
            raise NoFunnel(
                end.t, partial(diagnosed, steps.as_it_is(), [end], [after], after / h), phi - margin
            )
        if caps is not None:
            cap = min(cap, float(caps[k]))
        for section in between:
            share = (section.t - start.t) / h
            cap, _ = _largest(steps, section, share, rho[k + 1], h, cap, margin, at_end, expected)
        rho[k], at_start = _largest(steps, start, 0.0, rho[k + 1], h, cap, margin, at_end, expected)
        ends.append(Ends(at_start, at_end))
        duals = at_start
        progress(f"rho at {start.t:.3g} s", 1 - k / len(instants))
    return rho, ends[::-1]


def _largest(
    steps: LSteps,
    section: Section,
    share: float,
    after: float,
    h: float,
    cap: float,
    margin: float,
    duals: list[SphereSolution],
    expected: bool,
) -> tuple[float, list[SphereSolution]]:
    """The largest ρ_k ≤ cap with which the L-step at s = share leaves the margin, and that L-step.

    ρ is linear from ρ_k to `after`.
    """

    def here(rho: float) -> float:
        return (1 - share) * rho + share * after

    def slack(rho: float, phi: float) -> float:
        return phi + (after - rho) / here(rho) / h - margin

    feasible, infeasible = 0.0, np.inf
    best: list[SphereSolution] | None = None
    limited = len(steps.limits) > 0
    for _ in range(MAX_TRIES + steps.cases):  # one that fails is solved for one case
        if cap <= LOWEST * after:
            break
        known = duals
        if expected and infeasible > cap:
            rho = cap
        else:
            rho = _root(
                lambda r: slack(r, steps.predicted(section, here(r), known)),  # noqa: B023
                LOWEST * after,
                min(cap, infeasible),
            )
        if best is not None and rho <= feasible:
            break
        least = -ACCEPT * margin - slack(rho, 0.0)
        enough = -slack(rho, 0.0) if expected else np.inf
        found = steps.solve(section, here(rho), duals, least=least, enough=enough)
        left = slack(rho, min(s.m for s in found))
        if left >= -ACCEPT * margin:
            if not limited or rho >= cap:  # else `predicted` may be too low
                return rho, found
            done = rho <= NEAR * feasible
            feasible, best = rho, found
            if done:
                break
        else:
            infeasible = min(infeasible, rho)
        duals = found
    if best is None:
        kept = steps.as_it_is()

        def why() -> Diagnosis:
            levels = (after * np.geomspace(1e-3, 1.0, 12)).tolist()
            rho = max(levels, key=lambda r: slack(r, kept.predicted(section, here(r), duals)))
            return diagnosed(kept, [section], [here(rho)], (after - rho) / h)

        raise NoFunnel(section.t, why)
    return feasible, best


def _root(slack: Callable[[float], float], low: float, high: float) -> float:
    """The largest r in [low, high] with slack(r) ≥ 0, nearly, after a coarse look from above."""
    if slack(high) >= 0:
        return high
    step = 0.9
    inside = high
    while inside > low and slack(inside) < 0:
        high, inside = inside, inside * step
        step *= step
    if inside <= low:
        return low
    return float(brentq(slack, inside, high, xtol=CLOSE * high))
