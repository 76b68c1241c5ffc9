"""The V-step for P(t): what c is in D, and the optimum that another solver finds."""

from typing import Any

import cvxpy
import numpy as np
import pytest

from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, integrate_nominal
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.design.continuous.lstep import coordinates, section_at
from nlsid_core.design.continuous.setting import Setting, prepare
from nlsid_core.design.continuous.shape import bound_pushes, solve_ends
from nlsid_core.design.continuous.vstep import Sample, enlarging, multiplier, samples_of
from nlsid_core.design.continuous.vstep_program import GAP
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.polynomial.values import monomial_values
from nlsid_core.sos import SphereProgram

cp: Any = cvxpy  # its functions are not typed
PROGRAM = SphereProgram(2)
V = monomial_values(PROGRAM.basis, PROGRAM.points)


def pushed() -> tuple[Setting, ContinuousFunnel]:
    """A cubic with three pushes along a motion, and a funnel with ρ = 1 around it."""
    field = VectorField.from_function(
        lambda x, w: np.array([x[1] + w[0], w[2] - x[0] - x[1] + w[1] + x[0] ** 3 / 9 + x[0] ** 2]),
        2,
        0,
        uncertain=[[-0.01, 0.01], [-0.02, 0.02], [-0.03, 0.03]],
    )
    t = np.linspace(0, 1, 5)
    nominal = integrate_nominal(field, lambda _: np.zeros(0), t=t, start=[0.3, 0.1])
    setting = prepare(ContinuousTracking(field, nominal, goal=[0.5, 0.5]))
    return setting, ContinuousFunnel(setting.policy.x, setting.P, np.ones(5), "", "")


def triangle(D: FloatArray) -> FloatArray:
    return np.asarray(D[np.triu_indices(len(D))])


@pytest.mark.parametrize("end", [0, 1])
def test_c_is_to_first_order_what_the_derivative_of_w_says(end: int) -> None:
    setting, funnel = pushed()
    steps, P, t = setting.steps, funnel.P, funnel.t
    bound_pushes(steps, funnel)
    k, margin = 2, 1e-3
    assert steps.kappa is not None
    ends = solve_ends(steps, funnel)
    sample = samples_of(steps, P, ends, margin)[2 * k + end]
    section = section_at(steps, P, k, float(end))
    T, x_bar = section.shape.base, steps.program.points @ section.shape.base.T
    G, kappa = steps.pushes(section), steps.kappa[k]
    mu = multiplier(steps, section, (ends[k].start, ends[k].end)[end], 0)
    u = np.zeros((len(x_bar), 0))
    moves = steps.field(section.t, section.x + x_bar, u, np.zeros(3), span=0) - section.x_rate
    rng, root = np.random.default_rng(end), np.linalg.inv(T)
    other = np.linalg.inv(coordinates(P[sample.other], steps.nonlinear))
    D, D_other = ((A + A.T) / 2 for A in rng.normal(size=(2, 2, 2)))

    def c(part: float) -> FloatArray:
        here = root.T @ (np.eye(2) + part * D) @ root
        there = other.T @ (np.eye(2) + part * D_other) @ other
        rate = (1 - 2 * end) * (there - here) / (t[k + 1] - t[k])
        falls = -2 * np.einsum("ni,ij,nj->n", x_bar, here, moves)
        falls -= np.einsum("ni,ij,nj->n", x_bar, rate, x_bar)
        along = x_bar @ here @ G
        falls -= ((kappa * along**2 + 1 / kappa) * [0.01, 0.02, 0.03]).sum(axis=1)
        W = np.einsum("ni,ij,nj->n", x_bar, here, x_bar)
        return np.asarray(falls + mu * (1 - W) - margin)

    np.testing.assert_allclose(sample.constant, c(0.0), rtol=1e-9)
    found = sample.of_own @ triangle(D) + sample.of_other @ triangle(D_other)
    slope = (c(1e-5) - c(-1e-5)) / 2e-5
    np.testing.assert_allclose(found, slope, rtol=1e-6, atol=1e-8 * np.abs(slope).max())


def test_the_multiplier_makes_the_l_step_an_identity_off_the_sphere() -> None:
    setting, funnel = pushed()
    steps = setting.steps
    section = section_at(steps, funnel.P, 1, 0.0)
    (solution,) = steps.solve(section, 1.0)
    mu = multiplier(steps, section, [solution], 0)
    rows = np.concatenate([monomials_of(2, q) for q in range(3)])
    z = steps.program.points
    r = 0.6
    g = r**2 * steps.values(section, r**2, [0])[0]
    v = monomial_values(steps.program.basis, r * z)
    squares = np.einsum("nk,nk->n", v @ steps.program.gram(solution), v)
    inner = (squares - g + solution.m) / (1 - r**2)
    both = np.concatenate([mu, inner])
    table = monomial_values(rows, np.concatenate([z, r * z]))
    whole = np.linalg.lstsq(table, both, rcond=None)[0]
    np.testing.assert_allclose(table @ whole, both, atol=1e-6 * np.abs(both).max())


def contracting(knots: int, margin: float = 0.05) -> list[Sample]:
    """x₁' = -x₁ + 0.3x₂ - 0.2x₁³, x₂' = -0.3x₁ - 2x₂ - 0.3x₂³, P = I, μ = 0.8."""
    z = PROGRAM.points
    moves = z @ np.array([[-1.0, -0.3], [0.3, -2.0]]) - z**3 * [0.2, 0.3]
    p, q = np.triu_indices(2)

    def rows(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray((a[:, p] * b[:, q] + a[:, q] * b[:, p]) * np.where(p == q, 0.5, 1.0))

    falls = -2 * np.einsum("ni,ni->n", z, moves)
    samples = []
    for k in range(knots - 1):
        for sign, (own, other) in ((1, (k, k + 1)), (-1, (k + 1, k))):
            turns = 4.0 * sign
            of_own = rows(z, (turns - 0.8) * z - 2 * moves)
            samples.append(Sample(own, other, falls - margin, of_own, rows(z, -turns * z)))
    return samples


NO_BOUNDS = [np.zeros((0, 2))] * 3


def test_bounds_are_kept() -> None:
    rows = np.array([[0.9, 0.0], [0.5, 0.7]])
    samples, weights = contracting(4), np.ones(3)
    free = enlarging(samples, V, weights, NO_BOUNDS, 0.4)
    kept = enlarging(samples, V, weights, [rows, rows[:1], rows[:0]], 0.4)
    assert np.einsum("ri,ij,rj->r", rows, np.linalg.inv(np.eye(2) + free[0]), rows).max() > 1.01
    for k, count in enumerate((2, 1, 0)):
        reach = np.einsum("ri,ij,rj->r", rows, np.linalg.inv(np.eye(2) + kept[k]), rows)
        assert (reach[:count] <= 1).all()
    np.testing.assert_allclose(kept[2], free[2], atol=0.1)


def by_cvxpy(samples: list[Sample], weights: FloatArray, trust: float) -> Any:
    """The same program at the same points, by a general solver; the optimal value."""
    D = [cp.Variable((2, 2), symmetric=True) for _ in weights]
    limits = [sign * d << trust * np.eye(2) for d in D for sign in (1, -1)]
    for sample in samples:
        Q = cp.Variable((5, 5), PSD=True)
        c: Any = sample.constant
        for knot, part in ((sample.own, sample.of_own), (sample.other, sample.of_other)):
            if knot < len(D):
                c = c + part @ cp.hstack([D[knot][0, 0], D[knot][0, 1], D[knot][1, 1]])
        limits.append(cp.sum(cp.multiply(V @ Q, V), axis=1) == c)
    problem = cp.Problem(
        cp.Minimize(cp.sum([w * cp.trace(d) for w, d in zip(weights, D, strict=True)])), limits
    )
    problem.solve(solver=cp.CLARABEL)
    return problem.value


def test_the_optimum_is_that_of_a_general_solver() -> None:
    samples, weights, trust = contracting(4), np.array([1.0, 0.5, 0.8]), 0.4
    D = enlarging(samples, V, weights, NO_BOUNDS, trust)
    best = by_cvxpy(samples, weights, trust)
    assert np.abs(np.linalg.eigvalsh(D)).max() <= trust
    reached = weights @ np.trace(D, axis1=1, axis2=2)
    assert best - 1e-4 <= reached <= best + GAP * 2 * weights.sum()


def test_margins_that_nothing_keeps_are_said() -> None:
    with pytest.raises(SolverError, match="keeps the margins"):
        enlarging(contracting(4, 50.0), V, np.ones(3), NO_BOUNDS, 0.4)
