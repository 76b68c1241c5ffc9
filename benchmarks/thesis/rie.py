"""Robust identification error (RIE), data point by data point, for state-affine models.

With V = |x - x̃|²_P, ν = v - ỹ, Δ = x - x̃ and x⁺ = [v; S x], the worst case over (x, v) at one
row is
    sup -[Δ; ν]' M [Δ; ν] - 2ν'ε = ε' (M⁻¹)_νν ε,
    M = [ρ²P - Q - S'P₂₂S, r; r', G_0 + G_0' - P₁₁],   r = [G_1 … G_n]' - S'P₂₁,
M affine in θ and P at the row's window; ρ ≤ 1 keeps the model as fast as is asked for. Its sum
over the rows is a robust simulation error with a block diagonal K. The scale of y is in Q = e₁e₁':
the newest output.
Source: thesis (2.28), Lemma 2.16 and Proposition 4.4.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.methods.inequalities import MatrixInequality
from nlsid_core.identification.methods.newton import Point, minimise, project_columns
from nlsid_core.identification.polynomial.rows import StateAffineRows
from nlsid_core.polynomial.values import monomial_values

ROOM = 0.5  # of the first storage function: V exceeds |x - x̃|²_Q by it


def robust_identification_error(
    problem: StateAffineRows,
) -> tuple[Any, float]:
    """The model that minimises the RIE, and the RIE itself (scaled, as J).

    Raises SolverError if no minimiser is found.
    """
    bound = IdentificationErrorBound(problem)
    found = minimise(bound, bound.start(), inequalities=(bound.storage(),))
    n_g = len(problem.rows.identity)
    return problem.model(found.point.theta[:n_g], found.point.p), found.point.J


class IdentificationErrorBound:
    """Σ ε'(M⁻¹)_νν ε in z = [θ; P's upper triangle], with the interface of `Bound`."""

    def __init__(self, problem: StateAffineRows) -> None:
        self.rows, self.problem = problem.rows, problem
        self.outputs = len(problem.y_scale[0])
        self.size = (len(problem.left) - 1) * self.outputs  # of a state
        self.order = self.size + self.outputs  # of M
        values = [monomial_values(exponents, problem.w) for exponents in problem.left]
        repeated = [np.repeat(v, self.outputs**2, axis=1) for v in values]
        self.upper = list(zip(*np.triu_indices(self.size), strict=True))
        ones = np.ones((len(problem.w), len(self.upper)))
        self.phi = np.concatenate([*repeated, ones], axis=1)
        self.shapes = np.array([*self._left_shapes(), *self._storage_shapes()])
        self.constant = np.zeros((self.order, self.order))
        self.constant[: self.outputs, : self.outputs] = -np.eye(self.outputs)

    def _left_shapes(self) -> list[FloatArray]:
        """M's derivative in each left parameter, at φ = 1: lag k, output a, lagged output b."""
        shapes: list[FloatArray] = []
        for k, exponents in enumerate(self.problem.left):
            for _ in exponents:
                for a in range(self.outputs):
                    for b in range(self.outputs):
                        M = np.zeros((self.order, self.order))
                        column = self.size + b if k == 0 else (k - 1) * self.outputs + b
                        M[self.size + a, column] += 1.0
                        M[column, self.size + a] += 1.0
                        shapes.append(M)
        return shapes

    def _storage_shapes(self) -> list[FloatArray]:
        """M's derivative in each entry of P."""
        next_state = np.zeros((self.size, self.order))  # [ν; SΔ] of [Δ; ν]
        next_state[: self.outputs, self.size :] = np.eye(self.outputs)
        next_state[self.outputs :, : self.size - self.outputs] = np.eye(self.size - self.outputs)
        shapes: list[FloatArray] = []
        for i, j in self.upper:
            P = np.zeros((self.size, self.size))
            P[i, j] = P[j, i] = 1.0
            M = -next_state.T @ P @ next_state
            M[: self.size, : self.size] += self.problem.slowest**2 * P
            shapes.append(M)
        return shapes

    def start(self) -> FloatArray:
        """A multiple of G = I and a diagonal P with every M ≻ 0."""
        n = self.size // self.outputs
        levels, last = np.zeros(n), 0.0
        for k in reversed(range(n)):
            levels[k] = last = (last + ROOM / n + (k == 0)) / self.problem.slowest**2
        P = np.diag(np.repeat(levels, self.outputs))
        return np.concatenate([levels[0] * self.rows.identity, P[np.triu_indices(self.size)]])

    def storage(self) -> MatrixInequality:
        """ρ²P - Q - S'P₂₂S ⪰ 0, which every M shares."""
        n = slice(0, self.size)
        return MatrixInequality(np.concatenate([self.constant[None, n, n], self.shapes[:, n, n]]))

    @cached_property
    def _errors(self) -> FloatArray:
        """(N m, n_z): [0; ε_i] at every row."""
        rows, n_g = len(self.phi), len(self.rows.identity)
        padded = np.zeros((rows, self.order, len(self.shapes)))
        padded[:, self.size :, :n_g] = self.rows.errors.reshape(rows, self.outputs, n_g)
        return padded.reshape(rows * self.order, -1)

    @cached_property
    def _regressors(self) -> FloatArray:
        """(N m, n_p): [0; Q] at every row."""
        rows, n_p = len(self.phi), self.rows.Q.shape[1]
        padded = np.zeros((rows, self.order, n_p))
        padded[:, self.size :] = self.rows.Q.reshape(rows, self.outputs, n_p)
        return padded.reshape(rows * self.order, n_p)

    def at(self, theta: FloatArray) -> Point:
        """Value and best p; LinAlgError where an M is not positive definite."""
        flat = (self.phi * theta) @ self.shapes.reshape(len(self.shapes), -1)
        blocks = Blocks.of(self.constant + flat.reshape(-1, self.order, self.order))
        both = np.column_stack([self._errors @ theta, self._regressors])
        return project_columns(both, theta, blocks)

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian in z."""
        return point.derivatives(self._errors, self.slopes(point.x))

    def slopes(self, x: FloatArray) -> FloatArray:
        """(N m, n_z): M_i x."""
        states = x.reshape(-1, self.order)
        moved = np.tensordot(states, self.shapes, axes=(1, 2))  # (N, n_z, m)
        return np.asarray((moved * self.phi[:, :, None]).transpose(0, 2, 1).reshape(len(x), -1))


@dataclass(frozen=True, eq=False)
class Blocks:
    """K = LL' of a block diagonal matrix: L (N, m, m) and its inverses."""

    L: FloatArray
    inverse: FloatArray

    @classmethod
    def of(cls, M: FloatArray) -> "Blocks":
        """Factor the blocks (N, m, m); LinAlgError if one is not positive definite."""
        L = np.linalg.cholesky(M)
        if not np.isfinite(L).all():
            raise LinAlgError("a block overflows")
        return cls(L, np.linalg.inv(L))

    def half_solve(self, B: FloatArray, *, overwrite: bool = False) -> FloatArray:
        """L⁻¹B."""
        del overwrite
        columns = B.reshape(len(self.L), self.L.shape[1], -1)
        return np.asarray((self.inverse @ columns).reshape(B.shape))

    def half_solve_transposed(self, B: FloatArray) -> FloatArray:
        """L⁻ᵀB."""
        columns = B.reshape(len(self.L), self.L.shape[1], -1)
        return np.asarray((self.inverse.transpose(0, 2, 1) @ columns).reshape(B.shape))

    @property
    def pivots(self) -> FloatArray:
        """The pivots of every block."""
        return np.asarray(np.diagonal(self.L, axis1=1, axis2=2).ravel() ** 2)
