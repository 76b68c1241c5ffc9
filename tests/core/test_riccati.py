"""The Riccati equation: both ways give the solution, and one of them where the other cannot."""

import numpy as np
import pytest
from scipy.linalg import companion, solve_discrete_are

from nlsid_core.arrays import FloatArray
from nlsid_core.design.riccati import _by_doubling, solve_riccati
from nlsid_core.errors import Infeasible


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
