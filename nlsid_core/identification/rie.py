"""Robust identification error (RIE), data point by data point, for scalar state-affine models.

With V = |x - x̃|²_P and constant lagged coefficients g = [G_1 … G_n], the worst case over (x, v) at
one row is ε²/(2 G_0(w) - c), where
    [c - P₁₁, r'; r, P - e₁e₁' - S'P₂₂S] ⪰ 0,   r = g' - S'P₂₁,   x⁺ = [v; S x],
couples c, P and g for all rows at once: the data enter through a diagonal K = 2 G_0(w) - c.
Source: thesis (2.28), Lemma 2.16 and Proposition 4.4 (Q = e₁e₁', W = I).
"""

from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError

from nlsid_core._types import FloatArray
from nlsid_core.errors import ShapeError
from nlsid_core.identification.banded import Factor
from nlsid_core.identification.bound import Point, project
from nlsid_core.identification.inequalities import MatrixInequality
from nlsid_core.identification.newton import minimise
from nlsid_core.identification.state_affine import StateAffineRows
from nlsid_core.models import StateAffineModel

ROOM = 0.5  # of the first storage function: V exceeds |x - x̃|²_Q by it


def robust_identification_error(problem: StateAffineRows) -> tuple[StateAffineModel, float]:
    """The model that minimises the RIE, and the RIE itself (scaled, as J).

    Raises ShapeError for several outputs or lagged coefficients that depend on the input.
    """
    bound = IdentificationErrorBound(problem)
    n = len(problem.left) - 1
    storage = 1.0 + ROOM * np.arange(n, 0, -1) / n
    start = np.concatenate([problem.rows.identity, [0.5 * (storage[0] + 2.0)]])
    if n > 1:
        storage[1:] -= 1.0
    found = minimise(
        bound,
        start,
        inequalities=(bound.dissipation(),),
        extra=np.diag(storage)[np.triu_indices(n)],
    )
    return problem.model(found.point.theta[:-1], found.point.p), found.point.J


class IdentificationErrorBound:
    """Σ ε²/(2 G_0(w) - c) in [θ; c], with the interface of `Bound`."""

    def __init__(self, problem: StateAffineRows) -> None:
        if not problem.has_constant_lags:
            raise ShapeError(
                "the robust identification error is implemented for one output and constant "
                "coefficients of the lagged outputs"
            )
        self.rows, self.lags = problem.rows, len(problem.left) - 1
        self.leading = len(problem.left[0])

    def at(self, theta: FloatArray) -> Point:
        """Value and best p; LinAlgError where 2 G_0 ≤ c at a row."""
        rows = self.rows
        K = 2.0 * rows.weights[:, : self.leading] @ theta[: self.leading] - theta[-1]
        if K.min() <= 0.0:
            raise LinAlgError("2 G_0 does not exceed c")
        return project(rows, theta, theta[:-1], Factor(np.sqrt(K)[None, :]))

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian in [θ; c]."""
        errors = np.column_stack([self.rows.errors, np.zeros(len(self.rows))])
        return point.derivatives(errors, self._slopes * point.x[:, None])

    @cached_property
    def _slopes(self) -> FloatArray:
        """(N, n_g + 1): derivatives of the diagonal K."""
        slopes = np.zeros((len(self.rows), len(self.rows.offsets) + 1))
        slopes[:, : self.leading] = 2.0 * self.rows.weights[:, : self.leading]
        slopes[:, -1] = -1.0
        return slopes

    def log_determinant_gradient(self, point: Point) -> FloatArray:
        """Gradient of Σ log K."""
        return np.asarray(self._slopes.T @ point.factor.L[0] ** -2.0)

    def log_determinant_curvature(self, point: Point, probes: FloatArray) -> FloatArray:
        """Hessian of -Σ log K, exactly."""
        del probes
        scaled = self._slopes / point.factor.L[0][:, None] ** 2
        return np.asarray(scaled.T @ scaled)

    def dissipation(self) -> MatrixInequality:
        """The matrix inequality above, affine in [θ; c; P's upper triangle]."""
        n, n_g = self.lags, len(self.rows.offsets)
        upper = list(zip(*np.triu_indices(n), strict=True))
        F = np.zeros((1 + n_g + 1 + len(upper), n + 1, n + 1))
        F[0, 1, 1] = -1.0
        for k in range(n):
            F[1 + self.leading + k, 0, 1 + k] = F[1 + self.leading + k, 1 + k, 0] = 1.0
        F[1 + n_g, 0, 0] = 1.0
        for index, (i, j) in enumerate(upper):
            P = np.zeros((n, n))
            P[i, j] = P[j, i] = 1.0
            entry = F[2 + n_g + index]
            entry[0, 0] = -P[0, 0]
            entry[1:, 1:] = P
            entry[1:n, 1:n] -= P[1:, 1:]
            entry[0, 1:n] -= P[0, 1:]
            entry[1:n, 0] -= P[0, 1:]
        return MatrixInequality(F)
