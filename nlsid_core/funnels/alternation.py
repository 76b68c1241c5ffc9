"""The thesis's alternation (Sections 6.2, 6.3): L-steps find multipliers, V-steps enlarge.

`alternate_rho` enlarges ρ(t), `alternate_shape` P(t). Both start from a funnel that holds at its
knots and stop when the volume grows by less than 2.5 %. What holds at knots alone is a sampled
relaxation, thesis (6.7), and proves nothing: only a proof for every t makes a funnel.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.continuous import Funnel, Policy
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.funnels.knots import KnotForms
from nlsid_core.funnels.lstep import LSteps, section_at, sections
from nlsid_core.funnels.pieces import Proved, prove_pieces, unsolved
from nlsid_core.funnels.sampled import Sampled
from nlsid_core.funnels.sweep import Ends, Progress, sweep_rho
from nlsid_core.funnels.vstep import MAX_DEGREE, improve, largest_level

STOP = 0.025  # thesis: growth of the volume below which the alternation has converged
MAX_ITERATIONS = 30
TRUST = 0.5  # of P in the V-step: the volume is linearised at the present one
SHAPE_MARGIN = 16.0  # times the sweep's margin: with P(t) free there is volume to pay it with
OBJECTIVES = ("volume", "reference")
ROOM = 10.0  # times the margin, at the start, so that the first V-step has somewhere to go
HIGHEST_DECAY = 40.0  # of the exponential start


def exponential_start(
    steps: LSteps, policy: Policy, P: FloatArray, *, rho_final: float = 1.0
) -> Funnel:
    """ρ(t) = ρ(t_f) exp(-c (t_f - t)/(t_f - t₀)), c the least whole number that holds (Prop 6.2).

    Raises Infeasible if none up to 40 does.
    """
    t = policy.t
    decay = 0.0
    while decay <= HIGHEST_DECAY:
        rho = rho_final * np.exp(-decay * (t[-1] - t) / (t[-1] - t[0]))
        funnel = Funnel(policy.x, P, rho, policy.vector_field, "")
        if least_margin(funnel, solve_ends(steps, policy, funnel)) > 0:
            return funnel
        decay += 1.0
    raise Infeasible(
        f"no exponential start up to c = {HIGHEST_DECAY:g} holds: try a smaller goal, more "
        "knots, or other weights of the LQR"
    )


def solve_ends(
    steps: LSteps, policy: Policy, funnel: Funnel, *, executor: Executor | None = None
) -> list[Ends]:
    """L-steps at both ends of every interval; they are independent, and an executor shares them."""
    solve = partial(_ends_of, steps, policy, funnel)
    intervals = range(len(funnel.t) - 1)
    return list(map(solve, intervals) if executor is None else executor.map(solve, intervals))


def _ends_of(steps: LSteps, policy: Policy, funnel: Funnel, k: int) -> Ends:
    start, end = (section_at(steps.field, policy, funnel.P, k, float(s)) for s in (0, 1))
    first = steps.solve(start, float(funnel.rho[k]))
    return Ends(first, steps.solve(end, float(funnel.rho[k + 1]), first))


def least_margin(funnel: Funnel, ends: Sequence[Ends]) -> float:
    """The smallest L-step margin over all ends, in 1/s, ρ̇/ρ included."""
    growth = np.diff(funnel.rho) / np.diff(funnel.t)
    margins = []
    for k, pair in enumerate(ends):
        margins.append(min(s.m for s in pair.start) + growth[k] / funnel.rho[k])
        margins.append(min(s.m for s in pair.end) + growth[k] / funnel.rho[k + 1])
    return float(min(margins))


def refuse_start(funnel: Funnel, ends: Sequence[Ends]) -> None:
    """Raise Infeasible, with what to try, unless the L-steps at the knots of a first ρ hold."""
    margin = least_margin(funnel, ends)
    if margin <= 0:
        raise Infeasible(
            f"the first rho does not hold: its margin is {margin:.3g} 1/s at worst. Try one that "
            "grows faster towards t_f, a smaller one, or none: an exponential one is then found"
        )


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


def alternate_rho(
    steps: LSteps,
    policy: Policy,
    funnel: Funnel,
    *,
    margin: float = 0.0,
    stop: float = STOP,
    iterations: int = MAX_ITERATIONS,
    executor: Executor | None = None,
) -> Sampled:
    """Enlarge ρ(t) at fixed P(t), keeping ρ(t_f) and, where the start has it, a margin in 1/s.

    With the multipliers fixed, each V-step takes the largest ρ at a knot after the one behind it:
    at both ends of an interval the constraint is an interval of ρ that contains the present one.
    """
    volumes = [funnel.volume_integral()]
    for _ in range(iterations):
        ends = solve_ends(steps, policy, funnel, executor=executor)
        forms = KnotForms(steps, policy, funnel, ends, margin=0.0)
        rho = funnel.rho.copy()
        for k in range(len(rho) - 2, -1, -1):
            levels = []
            for constant, slope in forms.levels(k, rho[k + 1]):
                constant[0] -= margin
                try:
                    levels.append(largest_level(constant, slope, forms.basis))
                except SolverError:
                    levels.append(0.0)
            rho[k] = max(funnel.rho[k], min(levels) * (1 - 1e-6))
        funnel = replace(funnel, rho=rho)
        volumes.append(funnel.volume_integral())
        if volumes[-1] < volumes[-2] * (1 + stop):
            break
    return Sampled(funnel, tuple(volumes))


def alternate_shape(
    steps: LSteps,
    policy: Policy,
    funnel: Funnel,
    *,
    margin: float,
    objective: str = "volume",
    iterations: int = MAX_ITERATIONS,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> tuple[Funnel, Proved, list[tuple[str, float]]]:
    """Enlarge P(t), keeping the end, and prove the last funnel of the alternation that can be.

    objective: "volume", linearised within a trust region, or "reference", the thesis's largest
    scaled copies of the ellipsoids it starts from. Raises Infeasible if none could be proved.
    """
    margin *= SHAPE_MARGIN
    rho, _ = sweep_rho(steps, sections(steps.field, policy, funnel.P), margin=ROOM * margin,
                       rho_final=float(funnel.rho[-1]))  # fmt: skip
    P = funnel.P / rho[:, None, None]
    present = replace(funnel, P=(P + P.transpose(0, 2, 1)) / 2, rho=np.ones(len(rho)))
    found = [present]
    for iteration in range(iterations):
        candidate = _enlarged(steps, policy, present, margin, objective, found[0].P, executor)
        if candidate is None:
            break
        growth = candidate.volume_integral() / present.volume_integral()
        present = candidate
        found.append(present)
        if progress is not None:
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


def _enlarged(
    steps: LSteps,
    policy: Policy,
    funnel: Funnel,
    margin: float,
    objective: str,
    reference: FloatArray,
    executor: Executor | None,
) -> Funnel | None:
    """One V-step for all knots but the last; None if none was found or it does not hold."""
    ends = solve_ends(steps, policy, funnel, executor=executor)
    forms = KnotForms(steps, policy, funnel, ends, margin=margin)
    h = np.diff(funnel.t)
    share = (np.r_[h, 0] + np.r_[0, h])[:-1] / 2
    volumes = np.array([funnel.volume(float(t)) for t in funnel.t[:-1]])
    weights = share * volumes / (share * volumes).max()
    copies = None
    if objective == "reference":
        copies = np.array([T.T @ P @ T for T, P in zip(forms.frames, reference[:-1], strict=False)])
    try:
        D = improve(forms.samples, forms.pairs, len(weights), forms.basis, weights=weights,
                    margins=forms.margins, trust=TRUST, reference=copies)  # fmt: skip
    except SolverError:
        return None
    for part in (1.0, 0.5, 0.2):
        moved = funnel.P.copy()
        for k, change in enumerate(D):
            inverse = np.linalg.inv(forms.frames[k])
            new = inverse.T @ (np.eye(len(inverse)) + part * change) @ inverse
            moved[k] = (new + new.T) / 2
        candidate = replace(funnel, P=moved)
        if _holds(steps, policy, candidate, margin / 4):
            return candidate
    return None


def _holds(steps: LSteps, policy: Policy, funnel: Funnel, margin: float) -> bool:
    """True if every L-step at the knots of a funnel with ρ = 1 leaves the margin."""
    for k in range(len(funnel.t) - 1):
        for end in (0, 1):
            section = section_at(steps.field, policy, funnel.P, k, float(end))
            if min(s.m for s in steps.solve(section, float(funnel.rho[k + end]))) < margin:
                return False
    return True
