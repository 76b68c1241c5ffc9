"""ρ(t) by one backward sweep, which expands dynamics around what it finds if need be.

The box on which a Taylor model is bounded has to hold the funnel, and what the model leaves out
makes the funnel smaller: so ρ and the box of every interval are chosen together.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.expansion import BACK, NoExpansion
from nlsid_core.design.continuous.lstep import section_at
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.sweep import (
    Again,
    Ends,
    Wanted,
    estimated_before,
    largest_before,
)
from nlsid_core.design.continuous.validity import validity_caps
from nlsid_core.dynamics.taylor import field_of
from nlsid_core.errors import Infeasible
from nlsid_core.progress import Progress, silent
from nlsid_core.sos.sphere import SphereSolution

LOOKS, TRIES = 2, 3  # boxes in which ρ is estimated by the L-steps of the interval after; found
LARGER = 1.5  # of the box before: the largest in which ρ is estimated, and the first one else
CLOSE, NEAR = 1.02, 0.95  # of ρ, the box in which it is found; of that box, what is no smaller
SMALLEST = 1e-3  # of ρ at an interval's end: it does not fall farther on one interval
MAX_BACK = 40  # how often ρ is lowered for the interval before


class Swept(NamedTuple):
    """ρ (K,), the L-steps at the ends of intervals, and the setting of their field."""

    setting: Setting
    rho: FloatArray
    ends: list[Ends]


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
    again: Again | None = None,
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
                box = float(np.sqrt(box * rho)) if looks else min(CLOSE * rho, cap)
                continue
            rho, found = largest_before(steps, instants, after, min(box, cap), wanted, duals)
        except (NoExpansion, NoFunnel):
            if box <= SMALLEST * after:
                raise
            box, cap = box / 2, box / 2
            continue
        tries -= 1
        if NEAR * box <= rho < box or rho >= cap or not tries:
            return rho, found
        box, duals = min(CLOSE * rho if rho < box else LARGER * box, cap), found.start


def with_field(setting: Setting) -> Setting:
    """The setting with the field of the cubics that its L-steps hold."""
    steps, policy = setting.steps, setting.policy
    field = field_of([steps.local[k] for k in range(len(policy.t) - 1)], policy.t)
    policy = replace(policy, vector_field=files.digest(field.document()))
    proving = steps.like(field, policy)
    proving.kappa = None if steps.kappa is None else steps.kappa.copy()
    return replace(setting, steps=proving)
