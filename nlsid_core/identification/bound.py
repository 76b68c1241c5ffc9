"""The robust simulation error J_m: its value and derivatives in the left parameters.

    J_m(θ) = min_p ε' K⁻¹ ε,   K(θ) = G G_m' + G_m G' - G_m G_m'      (first: K = G + G' - I)

K and ε are affine in θ. p enters linearly and is projected out: with K = LL', x = K⁻¹ε at the best
p and v_i = ε_i - K_i x,
    gradient_i = 2 ε_i'x - x'K_i x,   Hessian = 2 |(I - Π) L⁻¹V|²,  Π the projection on L⁻¹Q.
K is banded (bandwidth n·n_y): O(N·p·n) a step.
Source: thesis (4.1)-(4.3), Proposition 4.3 and Section 4.4.
"""

from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class Point:
    """J at θ with the best p (n_p,), and the factors its derivatives are made of."""

    theta: FloatArray
    p: FloatArray
    J: float
    x: FloatArray
    factor: Factor
    projected: FloatArray  # L⁻¹Q
    normal: tuple[FloatArray, bool]  # Cholesky factor of Q'K⁻¹Q

    def derivatives(self, errors: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of J from ε_i and K_i x, columns (N, n)."""
        gradient = 2.0 * errors.T @ self.x - slopes.T @ self.x
        solved = self.factor.half_solve(errors - slopes)
        inner = self.projected.T @ solved
        hessian = solved.T @ solved - inner.T @ cho_solve(self.normal, inner, check_finite=False)
        return gradient, 2.0 * hessian


def project(rows: Rows, unknowns: FloatArray, theta: FloatArray, factor: Factor) -> Point:
    """The point of J = min_p |L⁻¹(errors θ - Q p)|²; LinAlgError if rounding decides it."""
    both = np.empty((len(rows), 1 + rows.Q.shape[1]), order="F")  # as LAPACK takes it: no copy
    both[:, 0], both[:, 1:] = rows.errors @ theta, rows.Q
    solved = factor.half_solve(both, overwrite=True)
    left, projected = solved[:, 0], solved[:, 1:]
    normal = cho_factor(projected.T @ projected, check_finite=False)
    p = cho_solve(normal, projected.T @ left, check_finite=False)
    residual = left - projected @ p
    J = float(residual @ residual)
    if not np.isfinite(J):
        raise LinAlgError("K is positive definite to rounding only")
    x = factor.half_solve_transposed(residual)
    return Point(unknowns, p, J, x, factor, projected, normal)


class Bound:
    """J_m linearised at the left parameters `theta_m` (None: the first bound)."""

    def __init__(self, rows: Rows, theta_m: FloatArray | None) -> None:
        self.rows = rows
        self.H = rows.eye if theta_m is None else rows.G(theta_m)
        self._constant = -0.5 * symmetric_product(self.H, self.H, rows.bandwidth)

    def at(self, theta: FloatArray) -> Point:
        """Value and best p; LinAlgError if K(θ) is not positive definite."""
        rows = self.rows
        K = self._constant + symmetric_product(rows.G(theta), self.H, rows.bandwidth)
        factor = Factor.of(K)
        return project(rows, theta, theta, factor)

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient (n_g,) and Hessian (n_g, n_g) of J at `point`."""
        return point.derivatives(self.rows.errors, self.slopes(point.x))

    def slopes(self, x: FloatArray) -> FloatArray:
        """(N, n_g): K_i x, K_i = G_i H' + H G_i', of every left parameter i."""
        rows, ahead = self.rows, transposed_times(self.H, x)
        columns = np.empty_like(rows.weights)
        for i, D in enumerate(rows.offsets):
            weight = rows.weights[:, i]
            columns[:, i] = weight * shift(ahead, D) + times(self.H, shift(weight * x, -D))
        return columns

    def log_determinant_gradient(self, point: Point) -> FloatArray:
        """(n_g,): d log det K/dθ_i = tr(K⁻¹K_i) = 2 Σ_t weight_i(t) (K⁻¹H)(t, t - D_i).

        Only entries of K⁻¹ on the band of K occur (selected inverse).
        """
        rows = self.rows
        Z = point.factor.inverse_band()
        N = len(rows)
        columns: dict[int, FloatArray] = {}
        for D in set(rows.offsets):
            total = np.zeros(N)
            for E, h in self.H.items():
                # (K⁻¹)(t, s) H(s, s - E) with s = t - D + E
                total += shift(h, D - E) * _entries(Z, D - E)
            columns[D] = total
        return np.array([2.0 * rows.weights[:, i] @ columns[D] for i, D in enumerate(rows.offsets)])

    def log_determinant_curvature(self, point: Point, probes: FloatArray) -> FloatArray:
        """(n_g, n_g): tr(K⁻¹K_iK⁻¹K_j) estimated with random probes (N, m), E zz' = I.

        Only the metric of Newton's method: the gradient is exact.
        """
        total = np.zeros((len(self.rows.offsets), len(self.rows.offsets)))
        for z in probes.T:
            solved = point.factor.half_solve(self.slopes(point.factor.half_solve_transposed(z)))
            total += solved.T @ solved
        return np.asarray(total / probes.shape[1])


def _entries(Z: FloatArray, d: int) -> FloatArray:
    """(N,): symmetric entries (t, t - d) of a band stored as lower diagonals; zero outside."""
    N = Z.shape[1]
    row = np.zeros(N)
    if d >= 0:
        row[d:] = Z[d, : N - d]
    else:
        row[:d] = Z[-d, : N + d]
    return row
