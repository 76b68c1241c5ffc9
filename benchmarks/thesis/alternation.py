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
from nlsid_core.design.continuous.lstep import Ends, LSteps, Section, section_at
from nlsid_core.design.continuous.pieces import end_proof
from nlsid_core.design.continuous.shape import MAX_ITERATIONS, solve_ends
from nlsid_core.errors import Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.polynomial.values import monomial_values

HIGHEST_DECAY = 40  # of the exponential start
STOP = 0.025  # thesis: growth of the volume below which the alternation has converged
RADII = (0.5, 1.0, 1.5)  # what has degree 4 at most and vanishes on three spheres is zero
DEGREE = 4  # of c in z
CONSTANT = 0.95  # of an L-step's margin, that a V-step may ask for again


def exponential_start(steps: LSteps, P: FloatArray) -> ContinuousFunnel:
    """ρ(t) = exp(-c (t_f - t)/(t_f - t₀)), c the least whole number that holds (Prop 6.2).

    Raises Infeasible if none up to 40 does.
    """
    t = steps.policy.t
    for decay in range(HIGHEST_DECAY + 1):
        rho = np.exp(-decay * (t[-1] - t) / (t[-1] - t[0]))
        funnel = ContinuousFunnel(steps.policy.x, P, rho, steps.policy.vector_field, "")
        if least_margin(funnel, solve_ends(steps, funnel)) > 0:
            return funnel
    raise Infeasible(
        f"no exponential start up to c = {HIGHEST_DECAY} holds: try a smaller goal, more "
        "knots, or other weights of the LQR"
    )


def least_margin(funnel: ContinuousFunnel, ends: Sequence[Ends]) -> float:
    """The smallest L-step margin over all ends, in 1/s, ρ̇/ρ included."""
    growth = np.diff(funnel.rho) / np.diff(funnel.t)
    margins = [
        min(found.m for found in solutions) + growth[k] / funnel.rho[k + end]
        for k, pair in enumerate(ends)
        for end, solutions in enumerate((pair.start, pair.end))
    ]
    return float(min(margins))


def alternate_rho(steps: LSteps, funnel: ContinuousFunnel, *, stop: float = STOP) -> Sampled:
    """Enlarge ρ(t) at fixed P(t), keeping ρ(t_f).

    With the multipliers fixed, each V-step takes the largest ρ at a knot after the one behind it:
    at both ends of an interval the constraint is an interval of ρ that contains the present one.
    """
    volumes = [funnel.volume_integral()]
    for _ in range(MAX_ITERATIONS):
        ends = solve_ends(steps, funnel)
        rho = funnel.rho.copy()
        for k in range(len(rho) - 2, -1, -1):
            largest = []
            for constant, slope in levels(steps, funnel, ends[k], k, rho[k + 1]):
                try:
                    largest.append(largest_level(constant, slope, funnel.n))
                except SolverError:
                    largest.append(0.0)
            rho[k] = max(funnel.rho[k], min(largest) * (1 - 1e-6))
        funnel = replace(funnel, rho=rho)
        volumes.append(funnel.volume_integral())
        if volumes[-1] < volumes[-2] * (1 + stop):
            break
    return Sampled(funnel, tuple(volumes))


def levels(
    steps: LSteps, funnel: ContinuousFunnel, ends: Ends, k: int, after: float
) -> list[tuple[FloatArray, FloatArray]]:
    """c/ρ = constant + slope·ρ_k at both ends of interval k, for ρ_{k+1} = after.

    In the frames of the present funnel W = ρ°|z|², ρ° the present ρ at that end, so that
    c/ρ° = -Ẇ/ρ° + ρ̇/ρ° + μ(ρ/ρ° - |z|²).
    """
    result, firsts = [], [len(_monomials(funnel.n, q)) for q in range(DEGREE)]
    h, before = funnel.t[k + 1] - funnel.t[k], float(funnel.rho[k])
    for end, solutions in enumerate((ends.start, ends.end)):
        present = float(funnel.rho[k + end])
        growth = (funnel.rho[k + 1] - before) / h / present
        falls = _falls(steps, section_at(steps, funnel.P, k, float(end)), present)
        for found, row in zip(solutions, falls, strict=True):
            kept = CONSTANT * (found.m + growth)
            parts = dict(enumerate(np.split(row, firsts))) | {0: row[:1] + growth - kept}
            mu = end_proof(steps.program, found, parts, 1.0, found.m + growth - kept)[1]
            constant, slope = row.copy(), np.zeros_like(row)
            for unit in np.eye(funnel.n, dtype=np.int64):
                rows = _monomials(funnel.n, DEGREE - 2) + 2 * unit
                constant[positions(rows, _monomials(funnel.n, DEGREE))] -= mu
            constant[0] += after / h / present
            slope[0] -= 1 / h / present
            grows = slope if end == 0 else constant
            grows[: len(mu)] += mu / before if end == 0 else mu * after / present
            result.append((constant, slope))
    return result


def _falls(steps: LSteps, section: Section, rho: float) -> FloatArray:
    """(cases, M) coefficients of -Ẇ/ρ in the monomials of degree 0..4."""
    z = np.concatenate([r * steps.program.points for r in RADII])
    values = [r**2 * steps.values(section, rho * r**2, range(steps.cases)) for r in RADII]
    table = monomial_values(_monomials(z.shape[1], DEGREE), z)
    return np.linalg.lstsq(table, np.concatenate(values, axis=1).T, rcond=None)[0].T


def _monomials(n: int, degree: int) -> IntArray:
    return np.concatenate([monomials_of(n, q) for q in range(degree + 1)])


def largest_level(constant: FloatArray, slope: FloatArray, n: int) -> float:
    """The largest r with constant + r·slope = v'Qv, Q ⪰ 0; both in the monomials of degree 0..4.

    Raises Infeasible or SolverError if there is none.
    """
    basis = _monomials(n, DEGREE // 2)
    i, j = conic.triangle(len(basis))
    size, home = len(i), positions(basis[i] + basis[j], _monomials(n, DEGREE))
    entries = np.where(i == j, 1.0, conic.SQRT2), (home, np.arange(size))
    gram = sp.csc_matrix(entries, shape=(len(constant), size))
    A = sp.vstack(
        [
            sp.hstack([sp.csc_matrix(-slope[:, None]), gram]),
            sp.hstack([sp.csc_matrix((size, 1)), -sp.eye(size)]),
        ],
        format="csc",
    )
    q = np.append(-1.0, np.zeros(size))
    cones = (Cone("zero", len(constant)), Cone("psd", len(basis)))
    program = ConeProgram(
        sp.csc_matrix((1 + size, 1 + size)), q, A, np.append(constant, np.zeros(size)), cones
    )
    return float(conic.solve(program).x[0])
