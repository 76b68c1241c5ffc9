"""The search for P(t): L-steps find multipliers, V-steps enlarge the set at every knot.

It starts from a funnel that holds at its knots and stops when the volume grows by less than 2.5 %.
What holds at knots alone proves nothing: the last funnel that can be proved for every t is taken.
Source: thesis (6.8).
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.expanded_sweep import swept
from nlsid_core.design.continuous.knots import KnotForms
from nlsid_core.design.continuous.lstep import LSteps, section_at
from nlsid_core.design.continuous.pieces import Proved, proof_basis, prove_pieces, unsolved
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.sweep import Ends, Wanted
from nlsid_core.design.continuous.validity import validity_caps, validity_rows
from nlsid_core.design.continuous.vstep import improve
from nlsid_core.errors import Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.progress import Progress, silent

STOP = 0.025  # thesis: growth of the volume below which the alternation has converged
MAX_ITERATIONS = 30
TRUST = 0.5  # of P in the V-step: the volume is linearised at the present one
SHAPE_MARGIN = 16.0  # times the sweep's margin: with P(t) free there is volume to pay it with
INSIDE = 0.95  # of what validity allows, at the start: a V-step begins strictly inside
SWEEPS, NEAR = 6, 0.05  # of P/ρ, until ρ is nearly 1
ROOM = 10.0  # times the margin, at the start, so that the first V-step has somewhere to go


def enlarge_shape(
    setting: Setting,
    funnel: ContinuousFunnel,
    *,
    margin: float,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> tuple[ContinuousFunnel, Proved, list[tuple[str, float]]]:
    """Enlarge P(t), keeping the end, and prove the last funnel of the alternation that can be.

    The funnel stays where the dynamics are valid: there I + D ⪰ rr' for all `validity_rows`.

    The volume is linearised within a trust region. Raises Infeasible if none could be proved.
    """
    steps, policy = setting.steps, setting.policy
    margin *= SHAPE_MARGIN
    volume_before, kappa = funnel.volume_integral(), steps.kappa
    steps.kappa = None if kappa is None else kappa.copy()
    present = _normalised(setting, funnel, ROOM * margin)
    found = [_Kept(present, steps.kappa)]
    ends = solve_ends(steps, policy, present, executor=executor)
    for iteration in range(MAX_ITERATIONS):
        enlarged = _enlarged(steps, policy, present, ends, margin, executor)
        if enlarged is None:
            break
        candidate, ends = enlarged
        growth = candidate.volume_integral() / present.volume_integral()
        present = candidate
        found.append(_Kept(present, steps.kappa))
        volume = present.volume_integral()
        progress(f"P(t): volume integral {volume:.4g}", min(0.95, (iteration + 1) / 10))
        if growth < 1 + STOP:
            break
    history = [(f"P {i}", kept.funnel.volume_integral()) for i, kept in enumerate(found)]
    proved: Proved | None = None
    while found:
        last, steps.kappa = found.pop()
        if last.volume_integral() <= volume_before:
            break
        proved = prove_pieces(steps, policy, last)
        if not proved.unproved:
            return last, proved, history
    steps.kappa = kappa
    if proved is None:
        raise Infeasible("no V-step made the funnel larger")
    raise Infeasible(f"no proof from {unsolved(policy, proved.unproved)}: try more knots there")


def _normalised(setting: Setting, funnel: ContinuousFunnel, margin: float) -> ContinuousFunnel:
    """The funnel with P/ρ for P and ρ = 1, ρ as the sweep finds it for a margin.

    P/ρ at the knots, linear between them, is no longer what was swept: so it is swept again.
    """
    P, final = funnel.P, float(funnel.rho[-1])
    for _ in range(SWEEPS):
        caps = INSIDE * validity_caps(setting.steps.field, setting.policy, P)
        same = replace(setting, P=P, expansion=None)
        rho = swept(same, Wanted(margin, final, caps)).rho
        P, final = P / rho[:, None, None], 1.0
        if np.abs(rho - 1).max() < NEAR:
            break
    P = (P + P.transpose(0, 2, 1)) / 2
    return replace(funnel, P=P, rho=np.ones(len(P)))


class _Kept(NamedTuple):
    funnel: ContinuousFunnel
    kappa: FloatArray | None


def solve_ends(
    steps: LSteps,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    *,
    near: Sequence[Ends] | None = None,
    executor: Executor | None = None,
) -> list[Ends]:
    """L-steps at both ends of every interval; they are independent, and an executor shares them.

    near: those of a funnel that is much the same.
    """
    solve = partial(_ends_of, steps, policy, funnel)
    intervals = range(len(funnel.t) - 1)
    starts = [None] * len(intervals) if near is None else near
    return list((map if executor is None else executor.map)(solve, intervals, starts))


def _ends_of(
    steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, k: int, near: Ends | None
) -> Ends:
    start, end = (section_at(steps, policy, funnel.P, k, float(s)) for s in (0, 1))
    at_start = None if near is None else near.start
    first = steps.solve(start, float(funnel.rho[k]), at_start)
    at_end = first if near is None else near.end
    return Ends(first, steps.solve(end, float(funnel.rho[k + 1]), at_end))


def _enlarged(
    steps: LSteps,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    ends: list[Ends],
    margin: float,
    executor: Executor | None,
) -> tuple[ContinuousFunnel, list[Ends]] | None:
    """One V-step for all knots but the last, with its L-steps; None if none was found that holds.

    ends: the L-steps of the funnel it starts from.
    """
    forms = KnotForms(steps, policy, funnel, ends, margin=margin)
    rows, kappa = validity_rows(steps.field, policy), steps.kappa
    h = np.diff(funnel.t)
    share = (np.r_[h, 0] + np.r_[0, h])[:-1] / 2
    volumes = np.array([funnel.volume(float(t)) for t in funnel.t[:-1]])
    weights = share * volumes / (share * volumes).max()
    try:
        D = improve(
            forms.samples,
            proof_basis(steps.program),
            weights=weights,
            trust=TRUST,
            bounds=[r @ T for r, T in zip(rows, forms.frames, strict=True)],
        )
    except SolverError:
        return None
    for part in (1.0, 0.5, 0.2):
        moved = funnel.P.copy()
        for k, change in enumerate(D):
            inverse = np.linalg.inv(forms.frames[k])
            new = inverse.T @ (np.eye(len(inverse)) + part * change) @ inverse
            moved[k] = (new + new.T) / 2
        candidate = replace(funnel, P=moved)
        if kappa is not None:
            steps.kappa = kappa.copy()
            for k in range(len(kappa)):
                steps.bound_pushes(section_at(steps, policy, moved, k, 1.0), 1.0)
        ends = solve_ends(steps, policy, candidate, near=ends, executor=executor)
        if min(s.m for pair in ends for s in (*pair.start, *pair.end)) >= margin / 4:  # ρ = 1
            return candidate, ends
    steps.kappa = kappa
    return None
