"""The banded kernel of the robust simulation error against dense formulas and a cone solver."""

import cvxpy as cp
import numpy as np
import pytest

from benchmarks.thesis.rie import (
    IdentificationErrorBound,
)
from nlsid import Dataset, Degrees, Polynomial, Trajectory
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.newton import (
    Descent,
    Repulsion,
    minimise,
)
from nlsid_core.identification.methods.rse import Bound
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from tests.state_affine_rows import EXACT, dense, near_identity, problem

SOLVER = 1e-6  # agreement with a cone solver's optimum


def dense_K(rows: Rows, theta: np.ndarray, theta_m: np.ndarray | None) -> np.ndarray:
    H = np.eye(len(rows)) if theta_m is None else dense(rows, theta_m)
    product = dense(rows, theta) @ H.T
    return np.asarray(product + product.T - H @ H.T)


def dense_J(rows: Rows, theta: np.ndarray, theta_m: np.ndarray | None) -> float:
    """J_m with the best p, by a dense generalised least-squares problem."""
    L = np.linalg.cholesky(dense_K(rows, theta, theta_m))
    left, right = np.linalg.solve(L, rows.errors @ theta), np.linalg.solve(L, rows.Q)
    p = np.linalg.lstsq(right, left, rcond=None)[0]
    return float(np.sum((left - right @ p) ** 2))


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("first", [True, False])
def test_banded_value_gradient_and_hessian_equal_the_dense_formula(
    outputs: int, first: bool
) -> None:
    rows = problem(outputs=outputs).rows
    theta = near_identity(rows, 0, 0.02)
    theta_m = None if first else near_identity(rows, 1, 0.05)
    bound = Bound(rows, theta_m)
    point = bound.at(theta)
    assert pytest.approx(dense_J(rows, theta, theta_m), rel=EXACT) == point.J

    K = dense_K(rows, theta, theta_m)
    unit = np.eye(len(theta))
    still = dense_K(rows, np.zeros(len(theta)), theta_m)
    slopes = [dense_K(rows, unit[i], theta_m) - still for i in range(len(theta))]
    inverse = np.linalg.inv(K)
    e = rows.errors @ theta - rows.Q @ point.p
    V = np.column_stack([rows.errors[:, i] - S @ inverse @ e for i, S in enumerate(slopes)])
    everything = np.column_stack([V, -rows.Q])
    full = 2.0 * everything.T @ inverse @ everything
    n = len(theta)
    reduced = full[:n, :n] - full[:n, n:] @ np.linalg.solve(full[n:, n:], full[n:, :n])
    expected = rows.errors.T @ inverse @ e + V.T @ inverse @ e
    gradient, hessian = bound.derivatives(point)
    np.testing.assert_allclose(gradient, expected, rtol=1e-8, atol=EXACT * abs(expected).max())
    np.testing.assert_allclose(hessian, reduced, rtol=1e-7, atol=1e-9 * abs(reduced).max())


@pytest.mark.parametrize("outputs", [1, 2])
def test_bound_is_above_the_simulation_error_and_equal_where_it_was_linearised(
    outputs: int,
) -> None:
    stacked = problem(outputs=outputs)
    rows = stacked.rows
    theta_m = near_identity(rows, 4, 0.05)
    bound = Bound(rows, theta_m)

    def simulation_error(theta: np.ndarray, p: np.ndarray) -> float:
        model = stacked.model(theta, p)
        total = 0.0
        for trial in stacked.dataset:
            simulated = model.simulate(trial.u, trial.y[: len(model)])
            total += float(np.sum(((trial.y - simulated) / model.y_scale) ** 2))
        return total

    at = bound.at(theta_m)
    assert pytest.approx(simulation_error(theta_m, at.p), rel=1e-8) == at.J
    for seed in range(10):
        point = bound.at(theta_m + 0.01 * (near_identity(rows, seed, 1.0) - rows.identity))
        assert simulation_error(point.theta, point.p) * (1 - EXACT) <= point.J


def matrix_inequality(rows: Rows) -> float:
    """min t with [K, ε; ε', t] ⪰ 0, by a cone solver."""
    eye, nothing, zero = np.eye(len(rows.identity)), 0.0 * np.eye(len(rows)), np.zeros(len(rows))
    theta, p, t = cp.Variable(len(eye)), cp.Variable(rows.Q.shape[1]), cp.Variable()
    still = dense_K(rows, 0.0 * rows.identity, None)

    def bordered(K: np.ndarray, error: np.ndarray, corner: float = 0.0) -> np.ndarray:
        return np.block([[K, error[:, None]], [error[None], np.array([[corner]])]])

    M = bordered(still, zero) + t * bordered(nothing, zero, 1.0)
    for i, error in enumerate(rows.errors.T):
        M += theta[i] * bordered(dense_K(rows, eye[i], None) - still, error)
    for j, column in enumerate(rows.Q.T):
        M -= p[j] * bordered(nothing, column)
    solved = cp.Problem(cp.Minimize(t), [M >> 0])
    solved.solve(solver="CLARABEL")
    return float(solved.value)


@pytest.mark.parametrize("lagged_degree", [0, 1])
def test_first_minimum_equals_the_matrix_inequality_solved_by_a_cone_solver(
    lagged_degree: int,
) -> None:
    """min t with [K, ε; ε', t] ⪰ 0, also where the minimiser is on the boundary of K ⪰ 0."""
    for seed, noise in ((3, 0.05), (5, 1.0)):
        stacked = problem(
            trials=1,
            samples=26,
            noise=noise,
            seed=seed,
            model_class=Polynomial(2, degrees=Degrees(leading=1, lagged=lagged_degree)),
        )
        rows = stacked.rows
        found = minimise(Bound(rows, None), rows.identity)
        assert pytest.approx(matrix_inequality(rows), rel=SOLVER) == found.point.J


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("lagged_degree", [0, 1])
def test_the_identification_error_is_the_worst_case_over_states_and_above_both_bounds(
    outputs: int, lagged_degree: int
) -> None:
    """(2.28) maximised row by row, from the polynomials of the model, for the P that was found."""
    stacked = problem(
        trials=1,
        samples=120,
        outputs=outputs,
        noise=0.1,
        model_class=Polynomial(2, degrees=Degrees(leading=1, lagged=lagged_degree)),
    )
    bound = IdentificationErrorBound(stacked)
    found = minimise(bound, bound.start(), inequalities=(bound.storage(),)).point
    n_g, m = len(stacked.rows.identity), outputs
    model = stacked.model(found.theta[:n_g], found.p)
    P = np.zeros((2 * m, 2 * m))
    P[np.triu_indices(2 * m)] = found.theta[n_g:]
    P = P + np.triu(P, 1).T
    trial = stacked.dataset.trajectories[0]
    y = (trial.y - model.y_offset) / model.y_scale
    w = model.windows(trial.u)
    lead, lags = model.G[0](w), np.concatenate([g(w) for g in model.G[1:]], axis=-1)
    rng, total = np.random.default_rng(0), 0.0
    for row, t in enumerate(range(2, len(trial))):
        past = np.concatenate([y[t - 1], y[t - 2]])
        error = lead[row] @ y[t] + lags[row] @ past + model.p(w)[row]

        def integrand(z: np.ndarray, row: int = row, error: np.ndarray = error) -> float:
            gap, nu = z[: 2 * m], z[2 * m :]
            after = np.concatenate([nu, gap[:m]])
            h = lead[row] @ nu + lags[row] @ gap + error
            return float(gap[:m] @ gap[:m] - gap @ P @ gap + after @ P @ after - 2.0 * nu @ h)

        unit = np.eye(3 * m)
        zero, ones = integrand(np.zeros(3 * m)), [integrand(e) for e in unit]
        minus = [integrand(-e) for e in unit]
        slope = 0.5 * (np.array(ones) - np.array(minus))
        square = np.array(
            [
                [0.5 * (integrand(a + b) - integrand(a) - integrand(b) + zero) for a in unit]
                for b in unit
            ]
        )
        worst = -0.5 * np.linalg.solve(square, slope)
        assert np.linalg.eigvalsh(square)[-1] < 0.0
        total += integrand(worst)
        assert integrand(worst) >= integrand(worst + 0.1 * rng.standard_normal(3 * m))
    assert pytest.approx(total, rel=1e-7) == found.J
    start = bound.at(bound.start()).J
    assert 0.9 * start > found.J
    best = minimise(Bound(stacked.rows, None), stacked.rows.identity).point
    assert best.J <= found.J * (1 + SOLVER)
    simulated = (model.simulate(trial.u, trial.y[:2]) - trial.y) / model.y_scale
    assert np.sum(simulated**2) <= found.J * (1 + EXACT)


def burst_rows(N: int) -> Rows:
    """A burst that has nothing to do with its input: the minimiser lies on K ⪰ 0."""
    rng = np.random.default_rng(1)
    burst = np.exp(-np.arange(N + 2) / 10.0) * rng.standard_normal(N + 2)
    u = rng.uniform(-1.0, 1.0, N + 2)
    data = Dataset((Trajectory(t=np.arange(N + 2) * 1.0, y=burst, u=u, name="burst"),))
    model_class = Polynomial(2, degrees=Degrees(leading=1, lagged=1))
    return build_state_affine_rows(data, model_class).rows


@pytest.mark.parametrize("N", [90, 120])
def test_minimisers_where_eigenvalues_vanish_equal_the_cone_solver_s(N: int) -> None:
    """A burst its input says nothing of: K is singular at the minimiser."""
    rows = burst_rows(N)
    optimum = matrix_inequality(rows)
    found = minimise(Bound(rows, None), rows.identity)
    assert found.converged
    smallest = np.linalg.eigvalsh(dense_K(rows, found.point.theta, None))[0]
    assert smallest < 1e-4 * float(np.median(found.point.factor.pivots))
    assert pytest.approx(optimum, rel=SOLVER) == found.point.J


def slow_outputs() -> Rows:
    """Two outputs of four slow poles: on its way from the identity Newton comes near det K = 0."""
    rng = np.random.default_rng(0)
    poles, B, C = np.linspace(0.8, 0.99, 4), rng.standard_normal(4), rng.standard_normal((2, 4))
    u = np.repeat(rng.standard_normal(10), 10)[:, None]
    x = np.zeros((len(u), 4))
    for t in range(1, len(u)):
        x[t] = poles * x[t - 1] + 0.1 * B * u[t - 1]
    y = x @ C.T
    y += 0.05 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    data = Dataset((Trajectory(t=np.arange(len(u)) * 1.0, y=y, u=u, name="slow"),))
    return build_state_affine_rows(data, Polynomial(2, (1,))).rows


def test_where_newton_stalls_on_its_way_the_minimiser_inside_is_found() -> None:
    rows = slow_outputs()
    bound = Bound(rows, None)
    stalled = Descent(bound, (), len(rows.identity)).to_minimum(rows.identity)
    optimum = matrix_inequality(rows)
    assert not stalled.converged
    assert 2.0 * optimum < stalled.point.J
    found = minimise(bound, rows.identity)
    assert found.is_inside
    assert found.steps < 40
    assert pytest.approx(optimum, rel=SOLVER) == found.point.J


def test_the_derivatives_of_the_repulsion_are_those_of_its_value() -> None:
    rows = slow_outputs()
    bound = Bound(rows, None)
    repulsion = Repulsion(bound, bound.at(rows.identity))
    assert repulsion.value(bound.at(rows.identity)) == pytest.approx(1.0)
    theta = near_identity(rows, 0, 0.02)
    gradient, hessian = repulsion.derivatives(bound.at(theta))
    step = 1e-5
    for i in range(len(theta)):
        moved = step * np.eye(len(theta))[i]
        above, below = bound.at(theta + moved), bound.at(theta - moved)
        slope = (repulsion.value(above) - repulsion.value(below)) / (2 * step)
        assert gradient[i] == pytest.approx(slope, rel=1e-5, abs=1e-6)
        change = (repulsion.derivatives(above)[0] - repulsion.derivatives(below)[0]) / (2 * step)
        assert hessian[i] == pytest.approx(change, rel=1e-5, abs=1e-5)
