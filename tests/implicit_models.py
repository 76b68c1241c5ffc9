"""Implicit models that tests share."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from nlsid_core.arrays import FloatArray
from nlsid_core.models import ImplicitModel, Polynomials


def quintic() -> ImplicitModel:
    """Example 2.3.1 with an input: x⁺ + x⁺⁵/5 = x³/3 + w."""
    return ImplicitModel.separable(
        e=Polynomials(np.array([[1], [5]]), np.array([[1.0], [0.2]])),
        f=Polynomials(np.array([[3, 0], [0, 1]]), np.array([[1.0 / 3.0], [1.0]])),
        monotonicity=0.5,
        period=0.1,
        states=("v",),
        inputs=("force",),
    )


def coupled() -> ImplicitModel:
    """Two states: e = x + x³/10 each, f a rotation by half, cubic in the first state."""
    return ImplicitModel.separable(
        e=Polynomials(
            np.array([[1, 0], [0, 1], [3, 0], [0, 3]]),
            np.array([[1.0, 0.0], [0.0, 1.0], [0.1, 0.0], [0.0, 0.1]]),
        ),
        f=Polynomials(
            np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 0]]),
            np.array([[0.4, -0.3], [0.3, 0.4], [1.0, 0.0], [0.0, 0.05]]),
        ),
        monotonicity=0.9,
        period=0.1,
        states=("a", "b"),
        inputs=("u",),
    )


def lagged(a1: float = 0.5, a2: float = -0.3) -> ImplicitModel:
    """3v + v³ = 3(a₁ x₀ + a₂ x₁) + w, x⁺ = [v; x₀]: a delay state with known structure."""
    return ImplicitModel(
        h=Polynomials(
            np.array([[1, 0, 0, 0], [3, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
            np.array([[3.0], [1.0], [-3.0 * a1], [-3.0 * a2], [-1.0]]),
        ),
        shift=Polynomials(np.array([[1, 0, 0]]), np.array([[1.0]])),
        monotonicity=1.5,
        period=0.1,
        states=("y1", "y2"),
        inputs=("u",),
    )


def cubic_spring() -> ImplicitModel:
    """v + v³ + v w²/4 = x/2 + w: the unknown and the input are not separable."""
    return ImplicitModel(
        h=Polynomials(
            np.array([[1, 0, 0], [3, 0, 0], [1, 0, 2], [0, 1, 0], [0, 0, 1]]),
            np.array([[1.0], [1.0], [0.25], [-0.5], [-1.0]]),
        ),
        shift=Polynomials(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 0))),
        monotonicity=0.5,
        period=0.1,
        states=("x",),
        inputs=("u",),
    )


def linear(A: FloatArray) -> ImplicitModel:
    """P x⁺ = P A x + e₁w with a Lyapunov matrix P of A (of any A, if A is unstable P = I)."""
    P = np.eye(2)
    if max(abs(np.linalg.eigvals(A))) < 1.0:
        P = solve_discrete_lyapunov(A.T, np.eye(2))
        P = (P + P.T) / 2.0
    units = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return ImplicitModel.separable(
        e=Polynomials(units[:2, :2], P),
        f=Polynomials(units, np.vstack([(P @ A).T, [[1.0, 0.0]]])),
        monotonicity=0.5,
        period=0.1,
        states=("a", "b"),
        inputs=("u",),
    )
