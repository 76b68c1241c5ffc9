"""The robust simulation error J_m: its value and derivatives in the left parameters.

With outputs weighted by W (usually I) and the multiplier that is exact at θ_m, P = G_m⁻ᵀW,
    J_m(θ) = min_p ε' K⁻¹ ε,   K(θ) = G W⁻¹ G_m' + G_m W⁻¹ G' - G_m W⁻¹ G_m'    (first: G_m = I)

K and ε are affine in θ. p enters linearly and is projected out: with K = LL', x = K⁻¹ε at the best
p and v_i = ε_i - K_i x,
    gradient_i = 2 ε_i'x - x'K_i x,   Hessian = 2 |(I - Π) L⁻¹V|²,  Π the projection on L⁻¹Q.
K is banded (bandwidth n·n_y, and that of W⁻¹): O(N·p·n) a step.
Source: thesis (4.1)-(4.3), Proposition 4.3 and Section 4.4; |Δ|²_W - 2(PΔ)'(GΔ + ε) with
Δ = W⁻¹G_m'η is η'G_m W⁻¹G_m'η - 2η'(G W⁻¹G_m'η + ε).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from nlsid_core._types import FloatArray
from nlsid_core.identification.banded import (
    Factor,
    shift,
    symmetric_product,
    times,
    transposed_times,
)
from nlsid_core.identification.rows import Rows


class Root(Protocol):
    """A matrix L with J = |L⁻¹ε|², by what it solves."""

    def half_solve(self, B: FloatArray, *, overwrite: bool = False) -> FloatArray:
        """L⁻¹B for B (N,) or (N, m)."""
        ...

    def half_solve_transposed(self, B: FloatArray) -> FloatArray:
        """L⁻ᵀB for B (N,) or (N, m)."""
        ...

    @property
    def pivots(self) -> FloatArray:
        """(N,): the pivots of the elimination of LL', or what stands for them."""
        ...


@dataclass(frozen=True, eq=False)
class Point:
    """J at θ with the best p (n_p,), and the factors its derivatives are made of."""

    theta: FloatArray
    p: FloatArray
    J: float
    residual: FloatArray  # L⁻¹ε
    x: FloatArray  # L⁻ᵀL⁻¹ε
    factor: Root
    projected: FloatArray  # L⁻¹Q
    normal: tuple[FloatArray, bool]  # Cholesky factor of Q'K⁻¹Q

    def curvature(self, V: FloatArray) -> FloatArray:
        """2 |(I - Π) L⁻¹V|² for columns V (N, n)."""
        solved = self.factor.half_solve(V)
        inner = self.projected.T @ solved
        square = solved.T @ solved - inner.T @ cho_solve(self.normal, inner, check_finite=False)
        return np.asarray(2.0 * square)

    def derivatives(self, errors: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of ε'K⁻¹ε from ε_i and K_i x, columns (N, n)."""
        gradient = 2.0 * errors.T @ self.x - slopes.T @ self.x
        return gradient, self.curvature(errors - slopes)


def project(rows: Rows, unknowns: FloatArray, theta: FloatArray, factor: Root) -> Point:
    """The point of J = min_p |L⁻¹(errors θ - Q p)|²; LinAlgError if rounding decides it."""
    both = np.empty((len(rows), 1 + rows.Q.shape[1]), order="F")  # as LAPACK takes it: no copy
    both[:, 0], both[:, 1:] = rows.errors @ theta, rows.Q
    return project_columns(both, unknowns, factor)


def project_columns(both: FloatArray, unknowns: FloatArray, factor: Root) -> Point:
    """`project` for columns [errors θ, Q] of any rows; overwrites them."""
    solved = factor.half_solve(both, overwrite=True)
    left, projected = solved[:, 0], solved[:, 1:]
    if not np.isfinite(left @ left):
        raise LinAlgError("the errors overflow")
    normal = cho_factor(projected.T @ projected, check_finite=False)
    p = cho_solve(normal, projected.T @ left, check_finite=False)
    residual = left - projected @ p
    J = float(residual @ residual)
    if not np.isfinite(J):
        raise LinAlgError("K is positive definite to rounding only")
    x = factor.half_solve_transposed(residual)
    return Point(unknowns, p, J, residual, x, factor, projected, normal)


class Bound:
    """J_m linearised at the left parameters `theta_m` (None: the first bound)."""

    def __init__(self, rows: Rows, theta_m: FloatArray | None) -> None:
        self.rows = rows
        G_m = rows.eye if theta_m is None else rows.G(theta_m)
        self.H = rows.weighed(G_m)
        self._constant = -0.5 * symmetric_product(G_m, self.H, rows.bandwidth)

    def at(self, theta: FloatArray) -> Point:
        """Value and best p; LinAlgError if K(θ) is not positive definite."""
        rows = self.rows
        K = self._constant + symmetric_product(rows.G(theta), self.H, rows.bandwidth)
        return project(rows, theta, theta, Factor.of(K))

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient (n_g,) and Hessian (n_g, n_g) of J at `point`."""
        return point.derivatives(self.rows.errors, self.slopes(point.x))

    def slopes(self, x: FloatArray) -> FloatArray:
        """(N, n_g): K_i x, K_i = G_i H' + H G_i', of every left parameter i."""
        rows, ahead = self.rows, transposed_times(self.H, x)
        columns = np.empty_like(rows.weights)
        for D, group in rows.groups:
            weights = rows.weights[:, group]
            columns[:, group] = weights * shift(ahead, D)[:, None]
            columns[:, group] += times(self.H, shift(weights * x[:, None], -D))
        return columns
