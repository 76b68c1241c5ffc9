"""Small linear matrix inequalities: their barriers, and linear objectives over them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray

CENTRED = 1e-6  # Newton decrement of -log det: the barrier has no unit
NEWTON_STEPS = 100
QUADRATIC = 0.1  # decrement below which a full Newton step stays inside


@dataclass(frozen=True, eq=False)
class MatrixInequality:
    """F₀ + Σ z_i F_i ⪰ 0 on z = [θ; extra unknowns]; F: (1 + n_z, …, m, m), F₀ first.

    Several matrices of one order stand in one inequality.
    """

    F: FloatArray

    @property
    def order(self) -> int:
        """The parameter of the barrier: m times how many matrices there are."""
        return int(np.prod(self.F.shape[1:-1]))

    def at(self, z: FloatArray) -> FloatArray:
        """The matrices (…, m, m) at z."""
        moved = z @ self.F[1:].reshape(len(z), -1)
        return np.asarray(self.F[0] + moved.reshape(self.F.shape[1:]))

    def barrier(self, z: FloatArray) -> float:
        """-log det; infinite outside."""
        try:
            L = np.linalg.cholesky(self.at(z))
            return float(-2.0 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum())
        except np.linalg.LinAlgError:
            return np.inf

    def derivatives(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of the barrier."""
        inverse = np.linalg.inv(np.linalg.cholesky(self.at(z)))
        scaled = inverse @ self.F[1:] @ np.swapaxes(inverse, -2, -1)
        flat = scaled.reshape(len(scaled), -1)
        traces = np.trace(scaled, axis1=-2, axis2=-1).reshape(len(scaled), -1)
        return -traces.sum(axis=1), flat @ flat.T


def centre(
    inequalities: Sequence[MatrixInequality],
    z: FloatArray,
    *,
    objective: FloatArray | None = None,
    mu: float = 1.0,
) -> FloatArray:
    """Minimise objective'z/μ - Σ log det by damped Newton, from a z strictly inside."""
    c = np.zeros(len(z)) if objective is None else objective / mu

    def value(z: FloatArray) -> float:
        return float(c @ z + sum(inequality.barrier(z) for inequality in inequalities))

    for _ in range(NEWTON_STEPS if len(z) else 0):
        parts = [inequality.derivatives(z) for inequality in inequalities]
        gradient = c + np.sum([slope for slope, _ in parts], axis=0)
        hessian = np.sum([curvature for _, curvature in parts], axis=0)
        step = -np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        decrement = -float(gradient @ step)
        if decrement < CENTRED:
            break
        length = 1.0 if decrement < QUADRATIC else 1.0 / (1.0 + np.sqrt(decrement))
        while not value(z + length * step) <= value(z):
            length /= 2
            if length < CENTRED:
                return z
        z = z + length * step
    return z


def traceless(n: int) -> FloatArray:
    """(n(n+1)/2 - 1, n, n): a basis of the symmetric matrices with trace zero."""
    basis = []
    for i in range(n):
        for j in range(i, n):
            X = np.zeros((n, n))
            X[i, j] = X[j, i] = 1.0
            if i == j:
                if i == 0:
                    continue
                X[0, 0] = -1.0
            basis.append(X)
    return np.array(basis).reshape(-1, n, n)
