"""The search for P(t): L-steps find multipliers, V-steps enlarge the set at every knot.

It starts from a funnel that holds at its knots and stops when the volume grows by less than 2.5 %.
What holds at knots alone proves nothing: the last funnel that can be proved for every t is taken.
Source: thesis (6.8).
"""

from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.knots import KnotForms
from nlsid_core.design.continuous.lstep import LSteps, section_at, sections
from nlsid_core.design.continuous.pieces import Proved, proof_basis, prove_pieces, unsolved
from nlsid_core.design.continuous.sweep import Ends, sweep_rho
from nlsid_core.design.continuous.vstep import MAX_DEGREE, improve
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.progress import Progress, silent

STOP = 0.025  # thesis: growth of the volume below which the alternation has converged
MAX_ITERATIONS = 30
TRUST = 0.5  # of P in the V-step: the volume is linearised at the present one
SHAPE_MARGIN = 16.0  # times the sweep's margin: with P(t) free there is volume to pay it with
ROOM = 10.0  # times the margin, at the start, so that the first V-step has somewhere to go


def refuse_shape(steps: LSteps) -> None:
    """Raise DataError where V-steps do not apply: pushes, limits, or a degree above 3."""
    if len(steps.limits):
        raise DataError(
            "V-steps (shape P, alternation) search one polynomial at a time: with limits take "
            "shape rho by the sweep"
        )
    if steps.kappa is not None:
        raise DataError("V-steps take w at its corners: they are for fewer than three pushes")
    if steps.field.degree > MAX_DEGREE:
        raise DataError(
            f"V-steps (shape P, alternation) are for dynamics of degree up to {MAX_DEGREE}, not "
            f"{steps.field.degree}: take shape rho by the sweep, or a Taylor polynomial of degree "
            f"{MAX_DEGREE} with its remainder as an uncertain w"
        )


def enlarge_shape(
    steps: LSteps,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    *,
    margin: float,
    objective: str = "volume",
    iterations: int = MAX_ITERATIONS,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> tuple[ContinuousFunnel, Proved, list[tuple[str, float]]]:
    """Enlarge P(t), keeping the end, and prove the last funnel of the alternation that can be.

    objective: "volume", linearised within a trust region, or "reference", the thesis's largest
    scaled copies of the ellipsoids it starts from. Raises Infeasible if none could be proved.
    """
    margin *= SHAPE_MARGIN
    rho, _ = sweep_rho(steps, sections(steps, policy, funnel.P), margin=ROOM * margin,
                       rho_final=float(funnel.rho[-1]))  # fmt: skip
    P = funnel.P / rho[:, None, None]
    present = replace(funnel, P=(P + P.transpose(0, 2, 1)) / 2, rho=np.ones(len(rho)))
    found = [present]
    ends = solve_ends(steps, policy, present, executor=executor)
    for iteration in range(iterations):
        enlarged = _enlarged(steps, policy, present, ends, margin, objective, found[0].P, executor)
        if enlarged is None:
            break
        candidate, ends = enlarged
        growth = candidate.volume_integral() / present.volume_integral()
        present = candidate
        found.append(present)
        volume = present.volume_integral()
        progress(f"P(t): volume integral {volume:.4g}", min(0.95, (iteration + 1) / 10))
        if growth < 1 + STOP:
            break
    history = [(f"P {i}", f.volume_integral()) for i, f in enumerate(found)]
    while found:
        last = found.pop()
        proved = prove_pieces(steps, policy, last)
        if not proved.unproved:
            return last, proved, history
    raise Infeasible(f"no proof from {unsolved(policy, proved.unproved)}: try more knots there")


def solve_ends(
    steps: LSteps,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    *,
    executor: Executor | None = None,
) -> list[Ends]:
    """L-steps at both ends of every interval; they are independent, and an executor shares them."""
    solve = partial(_ends_of, steps, policy, funnel)
    intervals = range(len(funnel.t) - 1)
    return list(map(solve, intervals) if executor is None else executor.map(solve, intervals))


def _ends_of(steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, k: int) -> Ends:
    start, end = (section_at(steps, policy, funnel.P, k, float(s)) for s in (0, 1))
    first = steps.solve(start, float(funnel.rho[k]))
    return Ends(first, steps.solve(end, float(funnel.rho[k + 1]), first))


def _enlarged(
    steps: LSteps,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    ends: list[Ends],
    margin: float,
    objective: str,
    reference: FloatArray,
    executor: Executor | None,
) -> tuple[ContinuousFunnel, list[Ends]] | None:
    """One V-step for all knots but the last, with its L-steps; None if none was found that holds.

    ends: the L-steps of the funnel it starts from.
    """
    forms = KnotForms(steps, policy, funnel, ends, margin=margin)
    h = np.diff(funnel.t)
    share = (np.r_[h, 0] + np.r_[0, h])[:-1] / 2
    volumes = np.array([funnel.volume(float(t)) for t in funnel.t[:-1]])
    weights = share * volumes / (share * volumes).max()
    copies = None
    if objective == "reference":
        copies = np.array([T.T @ P @ T for T, P in zip(forms.frames, reference[:-1], strict=False)])
    try:
        D = improve(forms.samples, forms.pairs, len(weights), proof_basis(steps.program),
                    weights=weights, margins=forms.margins, trust=TRUST,
                    reference=copies)  # fmt: skip
    except SolverError:
        return None
    for part in (1.0, 0.5, 0.2):
        moved = funnel.P.copy()
        for k, change in enumerate(D):
            inverse = np.linalg.inv(forms.frames[k])
            new = inverse.T @ (np.eye(len(inverse)) + part * change) @ inverse
            moved[k] = (new + new.T) / 2
        candidate = replace(funnel, P=moved)
        ends = solve_ends(steps, policy, candidate, executor=executor)
        if min(s.m for pair in ends for s in (*pair.start, *pair.end)) >= margin / 4:  # ρ = 1
            return candidate, ends
    return None
