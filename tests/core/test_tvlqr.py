"""Motions and their feedback: Riccati and Lyapunov equations against known answers."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import companion, expm, solve_continuous_are, solve_discrete_are
from scipy.optimize import minimize

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design import discrete_tvlqr, integrate_nominal, lyapunov, tvlqr
from nlsid_core.design.riccati import _by_doubling, solve_riccati
from nlsid_core.design.sampled.motion import NEARNESS, RESERVE, SMOOTHNESS, plan_motion
from nlsid_core.dynamics import Nominal, VectorField, constant_on
from nlsid_core.errors import DataError, Infeasible, ShapeError
from nlsid_core.policies.continuous import ContinuousPolicy
from tests.tracked import pendulum

A = np.array([[0.0, 1.0], [2.0, -0.3]])
B = np.array([[0.0], [1.5]])
Q, R = np.diag([2.0, 1.0]), np.array([[0.5]])


def linear_motion(knots: int = 41, end: float = 2.0) -> tuple[VectorField, Nominal]:
    """ẋ = Ax + Bu, at rest."""
    field = VectorField.from_function(
        lambda x, u: np.array([x[1], 2 * x[0] - 0.3 * x[1] + 1.5 * u[0]]), 2, 1
    )
    t = np.linspace(0, end, knots)
    return field, integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))


def driven(knots: int) -> tuple[VectorField, Nominal]:
    """A pendulum whose input matters less the further it swings, thrown."""
    field = VectorField.from_function(
        lambda x, u: np.array([x[1], -x[0] + x[0] ** 3 / 6 + (1 - x[0] ** 2) * u[0]]), 2, 1
    )
    t = np.linspace(0, 1, knots)
    return field, integrate_nominal(field, lambda _: np.zeros(1), t=t, start=[0.4, 0.5])


def test_from_the_algebraic_solution_the_riccati_equation_stays_there() -> None:
    field, nominal = linear_motion()
    still = solve_continuous_are(A, B, Q, R)
    found = tvlqr(field, nominal, Q=Q, R=R, S_final=(still + still.T) / 2)
    assert pytest.approx(np.broadcast_to(still, found.S.shape), rel=1e-7) == found.S
    assert found.policy.K(0.3) == pytest.approx(np.linalg.inv(R) @ B.T @ still, rel=1e-7)


def test_the_recursion_stays_at_the_discrete_algebraic_solution() -> None:
    step, push = expm(0.1 * A), 0.1 * B
    still = solve_discrete_are(step, push, Q, R)
    found = discrete_tvlqr([step] * 30, [push] * 30, Q=Q, R=R, P_final=(still + still.T) / 2)
    assert pytest.approx(np.broadcast_to(still, (31, 2, 2)), rel=1e-9) == found.P
    from_zero = discrete_tvlqr([step] * 300, [push] * 300, Q=Q, R=R, P_final=np.zeros((2, 2)))
    assert from_zero.P[0] == pytest.approx(still, rel=1e-6)


def cost(A: FloatArray, B: FloatArray, K: FloatArray, P_final: FloatArray, x: FloatArray) -> float:
    total = 0.0
    for A_k, B_k, K_k in zip(A, B, K, strict=True):
        u = -K_k @ x
        total += float(x @ Q @ x + u @ R @ u)
        x = A_k @ x + B_k @ u
    return total + float(x @ P_final @ x)


def test_the_cost_to_go_is_what_it_costs_and_no_other_gain_is_cheaper() -> None:
    rng = np.random.default_rng(1)
    steps = np.eye(2) + 0.2 * rng.normal(size=(12, 2, 2))
    pushes = rng.normal(size=(12, 2, 1))
    found = discrete_tvlqr(steps, pushes, Q=Q, R=R, P_final=np.eye(2))
    assert found.K.shape == (12, 1, 2)
    for x in rng.normal(size=(10, 2)):
        best = cost(steps, pushes, found.K, np.eye(2), x)
        assert best == pytest.approx(x @ found.P[0] @ x)
        other = found.K + 0.01 * rng.normal(size=found.K.shape)
        assert cost(steps, pushes, other, np.eye(2), x) > best


def test_the_recursion_tends_to_the_differential_equation() -> None:
    gaps = []
    for knots in (51, 101):
        field, nominal = driven(knots)
        continuous = tvlqr(field, nominal, Q=Q, R=R, S_final=np.eye(2)).S
        h = 1 / (knots - 1)
        linear = [field.jacobians(float(t), nominal.x(t), nominal.u(t)) for t in nominal.t[:-1]]
        found = discrete_tvlqr(
            [np.eye(2) + h * a for a, _ in linear],
            [h * b for _, b in linear],
            Q=h * Q,
            R=h * R,
            P_final=np.eye(2),
        )
        gaps.append(np.abs(found.P - continuous).max())
    assert gaps[1] < 0.6 * gaps[0] < 0.1


def test_the_lyapunov_equation_has_its_closed_form_along_a_constant_loop() -> None:
    field, nominal = linear_motion()
    K = np.array([[2.0, 1.0]])
    gains = constant_on(nominal.t, np.broadcast_to(K, (40, 1, 2)))
    policy = ContinuousPolicy(nominal.x, nominal.u, gains, files.digest(field.document()))
    P = lyapunov(field, policy, Q=Q, P_final=np.eye(2))
    closed = A - B @ K
    for k in (0, 13, 39):
        left = 2.0 - nominal.t[k]
        # d/ds e^{A's}Qe^{As} from the block exponential (Van Loan).
        block = expm(np.block([[-closed.T, Q], [np.zeros((2, 2)), closed]]) * left)
        flow = block[2:, 2:]
        expected = flow.T @ np.eye(2) @ flow + flow.T @ block[:2, 2:]
        assert P[k] == pytest.approx(expected, rel=1e-6)
    assert (P[-1] == np.eye(2)).all()


@pytest.mark.slow
def test_a_gain_that_is_linear_between_knots_is_closer() -> None:
    fine_field, fine = driven(801)
    exact = tvlqr(fine_field, fine, Q=Q, R=R, S_final=np.eye(2), linear=True).policy
    times = np.linspace(0, 1, 801)[:-1]
    worst = {}
    for degree in (0, 1):
        field, nominal = driven(9)
        policy = tvlqr(field, nominal, Q=Q, R=R, S_final=np.eye(2), linear=degree == 1).policy
        assert policy.K.degree == degree
        assert policy.K.control[:, 0] == pytest.approx(exact.K(nominal.t[:-1]), abs=1e-6)
        worst[degree] = np.abs(policy.K(times) - exact.K(times)).max()
    assert worst[0] > 10 * worst[1]


@pytest.mark.parametrize(
    ("weights", "reason"),
    [
        ({"Q": -Q}, "Q should be positive semidefinite; its smallest eigenvalue is -2"),
        ({"R": 0 * R}, "R should be positive definite; its smallest eigenvalue is 0"),
        ({"Q": np.eye(3)}, "Q should be a symmetric 2x2 matrix"),
        ({"Q": np.array([[1.0, 2.0], [0.0, 1.0]])}, "Q should be a symmetric 2x2 matrix"),
    ],
)
def test_weights_that_are_none_are_named_by_both(weights: Any, reason: str) -> None:
    field, nominal = linear_motion(5)
    chosen = {"Q": Q, "R": R} | weights
    with pytest.raises(DataError, match=reason):
        tvlqr(field, nominal, S_final=np.eye(2), **chosen)
    with pytest.raises(DataError, match=reason):
        discrete_tvlqr([A], [B], P_final=np.eye(2), **chosen)


def test_matrices_that_do_not_fit_are_named() -> None:
    with pytest.raises(ShapeError, match=r"they are \(2, 2\), \(1, 2, 1\)"):
        discrete_tvlqr(A, [B], Q=Q, R=R, P_final=np.eye(2))


# -- The Riccati equation: both ways give the solution, and one of them where the other cannot


def residual(
    X: FloatArray, A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> float:
    """Of X = A'XA + Q - (A'XB + S)(R + B'XB)⁻¹(B'XA + S'), over the largest entry of X."""
    cross = A.T @ X @ B + S
    right = A.T @ X @ A + Q - cross @ np.linalg.solve(R + B.T @ X @ B, cross.T)
    return float(np.abs(X - right).max() / np.abs(X).max())


@pytest.mark.parametrize("seed", range(12))
def test_doubling_agrees_with_ordered_eigenvalues(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 9)), int(rng.integers(1, 4))
    A = rng.normal(size=(n, n)) * rng.choice([0.2, 0.5, 1.0])
    B = rng.normal(size=(n, m))
    joint = rng.normal(size=(n + m, n + m))
    joint = joint @ joint.T + 0.1 * np.eye(n + m)
    Q, S, R = joint[:n, :n], joint[:n, n:], joint[n:, n:]
    X = _by_doubling(A, B, Q, R, S)
    assert residual(X, A, B, Q, R, S) < 1e-9
    np.testing.assert_allclose(X, solve_discrete_are(A, B, Q, R, s=S), rtol=1e-6, atol=1e-8)


def test_a_pole_near_zero_is_no_obstacle() -> None:
    """The car's speed with four lags, of which one has nothing to do: a pole at 0.027."""
    a = np.array([2.74105474, -2.52227791, 0.80017418, -0.01969405])
    b = np.array([0.13118925, -0.22536555, 0.10870322, -0.04824889, 0.03446403])
    A, C = companion(np.concatenate([[1.0], -a])).T, np.eye(1, 4)
    B = (b[1:] + a * b[0])[:, None]
    X = solve_riccati(A, B, C.T @ C, np.eye(1))
    assert residual(X, A, B, C.T @ C, np.eye(1), np.zeros((4, 1))) < 1e-9
    closed = A - B @ np.linalg.solve(np.eye(1) + B.T @ X @ B, B.T @ X @ A)
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0


def test_an_unstable_state_that_no_input_reaches_has_no_solution() -> None:
    with pytest.raises(Infeasible, match="Riccati"):
        solve_riccati(np.diag([2.0, 0.5]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


# -- A motion of a measured state is the one that a slower solver finds


def test_a_planned_motion_is_the_one_that_scipy_finds_more_slowly() -> None:
    """The same transcription of 15 samples by SLSQP, in units of the box."""
    model, steps = pendulum(), 15
    half_x, half_u = model.x_range[:, 1], model.u_range[:, 1]
    ends = np.array([[0.0, 0.0], [0.1, 0.0]]) / half_x

    def parts(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return z[: 2 * (steps + 1)].reshape(-1, 2), z[2 * (steps + 1) :].reshape(-1, 1)

    def cost(z: np.ndarray) -> float:
        x, u = parts(z)
        smooth = SMOOTHNESS * steps * float(np.sum(np.diff(u, axis=0) ** 2))
        return (NEARNESS * float(np.sum(x**2)) + float(np.sum(u**2)) + smooth) / 2

    def defects(z: np.ndarray) -> np.ndarray:
        x, u = parts(z)
        steps_missed = model(x[:-1] * half_x, u * half_u) / half_x - x[1:]
        return np.concatenate([steps_missed.ravel(), x[0] - ends[0], x[-1] - ends[1]])

    start = np.zeros(3 * steps + 2)
    found = minimize(
        cost,
        start,
        method="SLSQP",
        constraints={"type": "eq", "fun": defects},
        bounds=[(-1.0 + RESERVE, 1.0 - RESERVE)] * len(start),
        options={"maxiter": 300},
    )
    assert found.success
    x, u = plan_motion(model, [0.0, 0.0], [0.1, 0.0], steps=steps)
    ours = np.concatenate([(x / half_x).ravel(), (u / half_u).ravel()])
    assert cost(ours) <= found.fun * (1 + 1e-5)
    np.testing.assert_allclose(ours, found.x, atol=2e-3)
