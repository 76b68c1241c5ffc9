"""Simulation residual of a block cascade with exact sensitivities, each a recursive filter."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from nlsid_core._types import FloatArray
from nlsid_core.models.spline import Spline


@dataclass(frozen=True, eq=False)
class Blocks:
    """A cascade's numbers in scaled signals; letters as in `BlockCascade`."""

    A1: FloatArray
    B1: FloatArray
    f: Spline
    A2: FloatArray
    B2: FloatArray

    def vector(self) -> FloatArray:
        """All parameters in one vector."""
        return np.concatenate([self.A1, self.B1.ravel(), self.f.c, self.A2, self.B2.ravel()])

    def with_vector(self, theta: FloatArray) -> "Blocks":
        """The same structure with other parameters."""
        sizes = [len(self.A1), self.B1.size, len(self.f.c), len(self.A2)]
        A1, B1, c, A2, B2 = np.split(theta, np.cumsum(sizes))
        return Blocks(
            A1, B1.reshape(self.B1.shape), replace(self.f, c=c), A2, B2.reshape(self.B2.shape)
        )

    def is_stable(self) -> bool:
        """Both denominators have their roots inside the unit circle."""
        roots = [np.roots(np.concatenate([[1.0], A])) for A in (self.A1, self.A2)]
        return bool((abs(np.concatenate(roots)) < 1.0).all())

    def intermediate(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u/A1 (N,), and the signals (M, N) that enter the nonlinearity."""
        v = over(self.A1, u)
        return v, np.stack([lfilter(B, [1.0], v) for B in self.B1])

    def simulate(self, u: FloatArray) -> FloatArray:
        """Scaled outputs (N,), both filters from the zero state."""
        _, x = self.intermediate(u)
        forcing = sum(lfilter(B, [1.0], self.f(row)) for B, row in zip(self.B2, x, strict=True))
        return over(self.A2, np.asarray(forcing))

    def sensitivities(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs (N,) and their derivatives (n_parameters, N)."""
        v, x = self.intermediate(u)
        N, K = len(u), len(self.f.c)
        f, slope = self.f(x), self.f.derivative(x)
        y = over(
            self.A2,
            np.asarray(sum(lfilter(B, [1.0], row) for B, row in zip(self.B2, f, strict=True))),
        )
        first, weights = self.f.weights(x)
        basis = np.zeros((K, N))
        to_A1 = np.zeros((len(self.A1), N))
        to_B1 = []
        columns = np.arange(N)
        for j, B2 in enumerate(self.B2):
            piece = np.zeros((K, N))
            for k in range(4):
                piece[first[j] + k, columns] = weights[j, :, k]
            basis += lfilter(B2, [1.0], piece)
            denominator = np.concatenate([[1.0], self.A2])
            older = over(self.A1, x[j])
            for k in range(len(self.A1)):
                to_A1[k] -= lfilter(B2, denominator, slope[j] * _delayed(older, k + 1))
            lags = np.stack([_delayed(v, k) for k in range(len(self.A1) + 1)])
            to_B1.append(lfilter(B2, denominator, slope[j] * lags))
        to_B2 = [
            np.stack([_delayed(past, k) for k in range(len(self.A2) + 1)])
            for past in (over(self.A2, row) for row in f)
        ]
        response = over(self.A2, y)
        to_A2 = [-_delayed(response, k + 1)[None] for k in range(len(self.A2))]
        return y, np.concatenate([to_A1, *to_B1, over(self.A2, basis), *to_A2, *to_B2])


def over(A: FloatArray, x: FloatArray) -> FloatArray:
    """x/A along the last axis, from the zero state."""
    return np.asarray(lfilter([1.0], np.concatenate([[1.0], A]), x))


def _delayed(x: FloatArray, k: int) -> FloatArray:
    moved = np.zeros_like(x)
    moved[k:] = x[: len(x) - k]
    return moved
