"""The V-step: one semidefinite program improves P(t) at every knot, from the L-steps of the last.

At each end of each interval, in the coordinates z in which the present funnel is |z| ≤ 1, a new
P_κ = T⁻ᵀ(I + D)T⁻¹ changes c(z) = -Ẇ + μ(1 - W) to first order in D, the L-step's μ held. Where W
was 1 before, c is asked to be v'Qv with Q ⪰ 0: so μ is free to follow. The L-steps of the new P(t)
decide how much of that is so. `vstep_program` solves it.
Source: thesis (6.8), which holds μ; the linearised-volume objective needs the trust region.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.lstep import Ends, LSteps, Section, coordinates, section_at
from nlsid_core.design.continuous.validity import validity_rows
from nlsid_core.design.continuous.vstep_program import ShapeProgram
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.polynomial.values import monomial_values
from nlsid_core.sos.sphere import SphereSolution

KEEP = 0.9  # of an L-step's margin that a V-step asks for: it stays feasible where it is
RADII, SLOPE = (0.5, 0.75, 1.25, 1.5), (1 / 3, -8 / 3, 8 / 3, -1 / 3)  # exact up to degree 4


@dataclass(frozen=True, eq=False)
class Sample:
    """c at the points of the L-steps, at one end of an interval in one case.

    c = constant + own·D_own + other·D_other, D by its upper triangle of d entries. own, other: the
    knots. constant: (N,). of_own, of_other: (N, d).
    """

    own: int
    other: int
    constant: FloatArray
    of_own: FloatArray
    of_other: FloatArray


def samples_of(steps: LSteps, P: FloatArray, ends: Sequence[Ends], margin: float) -> list[Sample]:
    """c, less the margin in 1/s, at both ends of every interval in every case; ρ is 1.

    P: (K, n, n), of which `ends` are the L-steps.
    """
    found = []
    for k, pair in enumerate(ends):
        for end, solutions in enumerate((pair.start, pair.end)):
            section = section_at(steps, P, k, float(end))
            for case, solution in enumerate(solutions):
                found.append(_sample(steps, P, section, solutions, case))
                found[-1].constant[:] -= min(margin, KEEP * solution.m)
    return found


def _sample(
    steps: LSteps,
    P: FloatArray,
    section: Section,
    solutions: Sequence[SphereSolution],
    case: int,
) -> Sample:
    k, z, t = section.interval, steps.program.points, steps.policy.t
    own, other = (k, k + 1) if section.t == t[k] else (k + 1, k)
    across = z @ (np.linalg.inv(coordinates(P[other], steps.nonlinear)) @ section.shape.base).T
    into = np.linalg.inv(section.shape.base).T
    moved = steps.moves(section, 1.0, [case])[0] @ into
    if steps.kappa is not None:
        G = steps.pushes(section).T @ into
        moved = moved + (z @ G.T * steps.kappa[k] * steps.radius) @ G
    turns = 1 / float(t[other] - t[own])
    mu = multiplier(steps, section, solutions, case)
    return Sample(
        own,
        other,
        steps.left(section, 1.0, solutions, [case])[0],
        of_triangle(z, (turns - mu)[:, None] * z - 2 * moved),
        of_triangle(across, -turns * across),
    )


def multiplier(
    steps: LSteps, section: Section, solutions: Sequence[SphereSolution], case: int
) -> FloatArray:
    """(N,) μ at the points, of g - m + μ(1 - |z|²) = v'Qv.

    2μ is what the derivative of g along z is more than that of v'Qv.
    """
    program = steps.program
    along = [r**2 * steps.left(section, r**2, solutions, [case], r)[0] for r in RADII]
    v = monomial_values(program.basis, program.points)
    squares = np.einsum(
        "nk,nk->n", v * program.basis.sum(axis=1) @ program.gram(solutions[case]), v
    )
    return np.asarray(np.tensordot(SLOPE, along, 1) / 2 - squares)


def of_triangle(z: FloatArray, y: FloatArray) -> FloatArray:
    """(N, d): z'Dy at every row by the upper triangle of D."""
    p, q = np.triu_indices(z.shape[1])
    twice = z[:, p] * y[:, q] + z[:, q] * y[:, p]
    return np.asarray(np.where(p == q, twice / 2, twice))


def improved(
    steps: LSteps, funnel: ContinuousFunnel, ends: Sequence[Ends], margin: float, trust: float
) -> FloatArray:
    """P (K, n, n) of a larger funnel that ends as this one; its ρ is 1, `ends` are its L-steps.

    margin: 1/s. trust: of |D|. Raises SolverError if none was found that leaves it to first order.
    """
    P, h = funnel.P, np.diff(funnel.t)
    frames = [coordinates(here, steps.nonlinear) for here in P[:-1]]
    rows = validity_rows(steps.field, steps.policy)
    bounds = [r @ T for r, T in zip(rows, frames, strict=False)]
    share = np.append(h, 0)[:-1] + np.append(0, h)[:-1]
    weights = share * [funnel.volume(t) for t in funnel.t[:-1].tolist()]
    program = steps.program
    v = monomial_values(program.basis, program.points)
    samples = samples_of(steps, P, ends, margin)
    D = enlarging(samples, v, weights / weights.max(), bounds, trust)
    found = P.copy()
    for k, T in enumerate(frames):
        root = np.linalg.inv(T)
        new = root.T @ (np.eye(len(T)) + D[k]) @ root
        found[k] = (new + new.T) / 2
    return found


def enlarging(
    samples: Sequence[Sample],
    v: FloatArray,
    weights: FloatArray,
    bounds: Sequence[FloatArray],
    trust: float,
) -> FloatArray:
    """D (free, n, n) for the free knots 0..free-1 with c ≥ 0 at each sample; D = 0 beyond.

    v: (N, k) at the points. weights: (free,) of each knot's volume. bounds: per free knot (R, n)
    rows r: |r'z| ≤ 1 in the set, I + D ⪰ rr'. trust: of |D|; the linearised volume is what is
    enlarged. Raises SolverError if it ends at no point with c ≥ 0.
    """
    free, d = len(weights), samples[0].of_own.shape[1]
    n = bounds[0].shape[1]
    p, q = np.triu_indices(n)
    units = np.zeros((d, n, n))
    units[range(d), p, q] = units[range(d), q, p] = 1.0
    # F (free, L, 1 + d, n, n): trust·I ± D, and I + D - rr'.
    rows = [np.concatenate([trust * np.eye(n)[None], sign * units]) for sign in (1.0, -1.0)]
    within = np.repeat(np.array(rows)[None], free, axis=0)
    most = max(len(r) for r in bounds)
    inside = np.tile(np.concatenate([np.eye(n)[None], units]), (free, most, 1, 1, 1))
    for place, directions in zip(inside, bounds, strict=False):
        place[: len(directions), 0] -= directions[:, :, None] * directions[:, None]
    g = np.array([s.constant for s in samples])
    size = np.abs(g).max(axis=1, keepdims=True)
    first = np.array([min(s.own, s.other) for s in samples])
    B = np.zeros((len(samples), 2, d, len(v)))
    for row, sample in enumerate(samples):
        for knot, part in ((sample.own, sample.of_own), (sample.other, sample.of_other)):
            if knot < free:
                B[row, knot - first[row]] = part.T / size[row]
    V = np.linalg.qr(v)[0] * np.sqrt(len(v))
    cost = weights[:, None] * np.trace(units, axis1=1, axis2=2)
    program = ShapeProgram(V, g / size, B, first, np.concatenate([within, inside], axis=1), cost)
    found = program.solve(np.zeros((free, d)))
    D = np.zeros((free, n, n))
    D[:, p, q] = D[:, q, p] = found
    return D
