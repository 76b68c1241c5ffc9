"""The gain step: for fixed P(t), ρ(t) and multipliers, the gains with which V falls fastest.

On |z| = 1, x̄ = √ρTz, φ = -Ẇ/ρ is affine in K where f is affine in the inputs; a multiplier of a
limit makes it quadratic, and it is taken at first order. One semidefinite program for all knots:
    maximise Σ_k weight_k m_k   subject to   φ(z; K) + ρ̇/ρ - m_k = v'Qv,  Q ⪰ 0
at both ends of every interval k in every case, with bounds of what K and its change ask of each
input. It only proposes gains: a sweep finds the funnel that they have.
Source: thesis (6.4), in the sphere form; docs/decisions/0038-gains-are-searched-on-request.md.
"""

from dataclasses import dataclass, replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.lstep import LSteps, Section, section_at
from nlsid_core.design.continuous.sweep import Ends
from nlsid_core.design.continuous.vstep_program import ShapeProgram
from nlsid_core.dynamics import VectorField
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.sos.sphere import SphereProgram, SphereSolution

TRUST = 0.5  # of what an input is asked for at most: how much a step changes of it
LEAST = 0.05  # of that at its largest over time: where a gain is small it may change by so much
ROOM = 1.01  # of what is asked now: the program begins strictly inside its bounds


@dataclass(frozen=True, eq=False)
class _Knots:
    """The gains at the knots, in the coordinates in which the funnel is |z| ≤ 1.

    gains: (L, m, n), √ρKT. back: (L, n, n), from z to x̄: K is gains @ back. trust: (L, m) of their
    change, row by row. L is the number of intervals if K is constant on them, one more if linear.
    """

    gains: FloatArray
    back: FloatArray
    trust: FloatArray


def unchanged_gain(field: VectorField, policy: ContinuousPolicy, *, given: bool) -> str:
    """Why no gain step is for this, in words; empty if one is. given: the policy is the user's."""
    if given:
        return "the policy is given"
    if not field.m or field.n == 1:
        return "a gain step takes two states or more, and an input"
    if policy.K.control.shape[1] > 2:
        return "a gain step takes gain='constant' or 'linear'"
    return ""


def faster_gain(
    steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, ends: list[Ends]
) -> FloatArray:
    """Control points (K-1, d+1, m, n) of gains with which V falls faster on the boundary.

    They ask in the funnel for no larger u - u₀ than the present ones, at each knot. ends: the
    L-steps of the funnel. Raises SolverError if the program is not solved.
    """
    intervals, points, m, n = policy.K.control.shape
    linear, h = points - 1, np.diff(funnel.t)
    knots = _knots(steps, policy, funnel)
    count, unknowns = len(knots.gains), m * n + 1
    g, B, first = [], [], []
    for k in range(intervals):
        growth = (funnel.rho[k + 1] - funnel.rho[k]) / h[k]
        for end, solutions in enumerate((ends[k].start, ends[k].end)):
            section, rho = section_at(steps, policy, funnel.P, k, end), float(funnel.rho[k + end])
            later = end * linear
            rows = np.zeros((steps.cases, 2, unknowns, len(steps.program.points)))
            rows[:, later, :-1] = _slopes(steps, section, rho, solutions, knots, k + later)
            g.append(_values(steps, section, rho, solutions) + growth / rho)
            B.append(rows)
            first += [k] * steps.cases
    values, slopes, at = np.concatenate(g), np.concatenate(B), np.array(first)
    size = np.abs(values).max(axis=1)
    unit = np.array([size[at == k].min() for k in range(intervals)])  # of m, in 1/s
    slopes[:, 0, -1] = -unit[at][:, None]
    volumes = h * [funnel.volume(float(t)) for t in funnel.t[:-1]]
    cost = np.zeros((count, unknowns))
    cost[:intervals, -1] = -h * np.cumsum(volumes) * unit  # more m_k widens all that is before
    assert isinstance(steps.program, SphereProgram)  # `unchanged_gain` names what has another
    program = ShapeProgram(
        steps.program.orthonormal(), values / size[:, None], slopes / size[:, None, None, None], at,
        _bounds(knots), cost / np.abs(cost).max(),
    )  # fmt: skip
    x = program.solve(np.zeros((count, unknowns)))[:, :-1].reshape(count, m, n)
    K = (knots.gains + knots.trust[..., None] * x) @ knots.back
    return np.stack([K[:-1], K[1:]], axis=1) if linear else K[:, None]


def _knots(steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel) -> _Knots:
    control = policy.K.control
    places = [(k, 0) for k in range(len(control))]
    if control.shape[1] > 1:
        places.append((len(control) - 1, 1))
    here = [section_at(steps, policy, funnel.P, k, end) for k, end in places]
    T = np.array([
        np.sqrt(funnel.rho[k + end]) * section.base
        for (k, end), section in zip(places, here, strict=True)
    ])  # fmt: skip
    gains = np.array([section.K for section in here]) @ T
    asked = np.linalg.norm(gains, axis=2)
    trust = TRUST * np.maximum(asked, LEAST * asked.max(axis=0))
    return _Knots(gains, np.linalg.inv(T), np.maximum(trust, np.finfo(float).tiny))


def _slopes(
    steps: LSteps, section: Section, rho: float, solutions: list[SphereSolution], knots: _Knots,
    knot: int,
) -> FloatArray:  # fmt: skip
    """(cases, m n, N): what each entry of the gain at a knot, times its trust, adds to `_values`.

    Central differences, which are exact for what is quadratic.
    """
    m, n = section.K.shape
    rows = np.empty((steps.cases, m * n, len(steps.program.points)))
    for place, (i, j) in enumerate(np.ndindex(m, n)):
        change = np.zeros((m, n))
        change[i] = knots.trust[knot, i] * knots.back[knot, j]
        ahead, behind = (
            _values(steps, replace(section, K=section.K + side * change), rho, solutions)
            for side in (1, -1)
        )
        rows[:, place] = (ahead - behind) / 2
    return rows


def _values(
    steps: LSteps, section: Section, rho: float, solutions: list[SphereSolution]
) -> FloatArray:
    """(cases, N) φ at the program's points, less what the solutions' multipliers of limits take."""
    g = steps.values(section, rho, range(steps.cases))
    y = np.hstack([np.ones((len(steps.program.points), 1)), steps.program.points])
    for case, solution in enumerate(solutions if len(steps.limits) else []):
        q = steps.in_mode(section, rho, case)
        g[case] -= np.einsum("ln,na,lab,nb->n", q, y, solution.tau, y)
    return g


def _bounds(knots: _Knots) -> FloatArray:
    """F (L, 2m + 2, 1 + unknowns, n + 1, n + 1), each F(x) ⪰ 0.

    They say |x_i| ≤ 1, |gains_i + trust_i x_i| ≤ what is asked now, and -1 ≤ m ≤ 1.
    """
    count, m, n = knots.gains.shape
    F = np.zeros((count, 2 * m + 2, 2 + m * n, n + 1, n + 1))
    F[:, :, 0] = np.eye(n + 1)
    F[:, -2, -1], F[:, -1, -1] = np.eye(n + 1), -np.eye(n + 1)
    for i in range(m):
        most = np.maximum(ROOM * np.linalg.norm(knots.gains[:, i], axis=1), knots.trust[:, i])
        F[:, m + i, 0, 0, 1:] = F[:, m + i, 0, 1:, 0] = knots.gains[:, i] / most[:, None]
        for j in range(n):
            entry = 1 + i * n + j
            F[:, i, entry, 0, 1 + j] = F[:, i, entry, 1 + j, 0] = 1.0
            ratio = knots.trust[:, i] / most
            F[:, m + i, entry, 0, 1 + j] = F[:, m + i, entry, 1 + j, 0] = ratio
    return F
