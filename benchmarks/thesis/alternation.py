"""The thesis's alternation for ρ(t) (Section 6.2): L-steps find multipliers, V-steps enlarge.

It starts from a funnel that holds at its knots and stops when the volume grows by less than 2.5 %.
What holds at knots alone is a sampled relaxation, thesis (6.7), and proves nothing: only a proof
for every t makes a funnel.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from benchmarks.thesis.relaxation import Sampled
from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.design.continuous.graded import monomials_of, positions
from nlsid_core.design.continuous.knots import KnotForms
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.design.continuous.shape import MAX_ITERATIONS, STOP, solve_ends
from nlsid_core.design.continuous.sweep import Ends
from nlsid_core.design.continuous.vstep import DEGREE
from nlsid_core.errors import Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy

HIGHEST_DECAY = 40.0  # of the exponential start


def exponential_start(
    steps: LSteps, policy: ContinuousPolicy, P: FloatArray, *, rho_final: float = 1.0
) -> ContinuousFunnel:
    """ρ(t) = ρ(t_f) exp(-c (t_f - t)/(t_f - t₀)), c the least whole number that holds (Prop 6.2).

    Raises Infeasible if none up to 40 does.
    """
    t = policy.t
    decay = 0.0
    while decay <= HIGHEST_DECAY:
        rho = rho_final * np.exp(-decay * (t[-1] - t) / (t[-1] - t[0]))
        funnel = ContinuousFunnel(policy.x, P, rho, policy.vector_field, "")
        if least_margin(funnel, solve_ends(steps, policy, funnel)) > 0:
            return funnel
        decay += 1.0
    raise Infeasible(
        f"no exponential start up to c = {HIGHEST_DECAY:g} holds: try a smaller goal, more "
        "knots, or other weights of the LQR"
    )


def least_margin(funnel: ContinuousFunnel, ends: Sequence[Ends]) -> float:
    """The smallest L-step margin over all ends, in 1/s, ρ̇/ρ included."""
    growth = np.diff(funnel.rho) / np.diff(funnel.t)
    margins = []
    for k, pair in enumerate(ends):
        margins.append(min(s.m for s in pair.start) + growth[k] / funnel.rho[k])
        margins.append(min(s.m for s in pair.end) + growth[k] / funnel.rho[k + 1])
    return float(min(margins))


def alternate_rho(
    steps: LSteps,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    *,
    margin: float = 0.0,
    stop: float = STOP,
    iterations: int = MAX_ITERATIONS,
) -> Sampled:
    """Enlarge ρ(t) at fixed P(t), keeping ρ(t_f) and, where the start has it, a margin in 1/s.

    With the multipliers fixed, each V-step takes the largest ρ at a knot after the one behind it:
    at both ends of an interval the constraint is an interval of ρ that contains the present one.
    """
    volumes = [funnel.volume_integral()]
    for _ in range(iterations):
        ends = solve_ends(steps, policy, funnel)
        forms = KnotForms(steps, policy, funnel, ends, margin=0.0)
        rho = funnel.rho.copy()
        basis = np.vstack([monomials_of(funnel.n, q) for q in range(3)])
        for k in range(len(rho) - 2, -1, -1):
            largest = []
            for constant, slope in levels(forms, k, rho[k + 1]):
                constant[0] -= margin
                try:
                    largest.append(largest_level(constant, slope, basis))
                except SolverError:
                    largest.append(0.0)
            rho[k] = max(funnel.rho[k], min(largest) * (1 - 1e-6))
        funnel = replace(funnel, rho=rho)
        volumes.append(funnel.volume_integral())
        if volumes[-1] < volumes[-2] * (1 + stop):
            break
    return Sampled(funnel, tuple(volumes))


def levels(forms: KnotForms, k: int, after: float) -> list[tuple[FloatArray, FloatArray]]:
    """c/ρ = constant + slope·ρ_k at both ends of interval k, for ρ_{k+1} = after.

    In the frames of the present funnel W = ρ°|z|², ρ° the present ρ at that end: the sample's
    constant is -Ẇ/ρ° + μ(1 - |z|²), so c/ρ° = it + ρ̇/ρ° + μ(ρ/ρ° - 1).
    """
    result = []
    half = len(forms.h) * forms.cases
    for end in (0, 1):
        present = forms.rho[k + end]
        for v in range(forms.cases):
            sample = forms.samples[end * half + k * forms.cases + v]
            mu = sample.mu
            constant, slope = sample.constant.copy(), np.zeros_like(sample.constant)
            constant[0] += after / forms.h[k] / present
            slope[0] -= 1 / forms.h[k] / present
            size = len(mu)
            if end == 0:
                constant[:size] -= mu
                slope[:size] += mu / present
            else:
                constant[:size] += mu * (after / present - 1)
            result.append((constant, slope))
    return result


def largest_level(constant: FloatArray, slope: FloatArray, basis: IntArray) -> float:
    """The largest r with constant + r·slope = v'Qv, Q ⪰ 0; both in the monomials of degree 0..4.

    Raises Infeasible or SolverError if there is none.
    """
    gram, size = gram_columns(basis)
    A = sp.vstack(
        [
            sp.hstack([sp.csc_matrix(-slope[:, None]), gram]),
            sp.hstack([sp.csc_matrix((size, 1)), -sp.eye(size)]),
        ],
        format="csc",
    )
    q = np.zeros(1 + size)
    q[0] = -1.0
    cones = (Cone("zero", len(constant)), Cone("psd", len(basis)))
    program = ConeProgram(
        sp.csc_matrix((1 + size, 1 + size)), q, A, np.concatenate([constant, np.zeros(size)]), cones
    )
    return float(conic.solve(program).x[0])


def gram_columns(basis: IntArray) -> tuple[sp.csc_matrix, int]:
    """Monomial coefficients of v'Qv from svec(Q), and how long that is."""
    n = basis.shape[1]
    i, j = conic.triangle(len(basis))
    rows = np.concatenate([monomials_of(n, q) for q in range(DEGREE + 1)])
    home = positions(basis[i] + basis[j], rows)
    weight = np.where(i == j, 1.0, conic.SQRT2)
    shape = (len(rows), len(i))
    return sp.csc_matrix((weight, (home, np.arange(len(i)))), shape=shape), len(i)
