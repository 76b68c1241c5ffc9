"""Banded matrices by diagonals, and what the robust simulation error needs of them.

A matrix G is {D: (N,) array}: entry (r, r - D) is G[D][r]; entries that fall outside are zero.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from nlsid_core._types import FloatArray

Diagonals = Mapping[int, FloatArray]


def shift(x: FloatArray, D: int) -> FloatArray:
    """Rows x(r - D) of x (N, ...), zero where r - D is outside."""
    if D == 0:
        return x
    moved = np.zeros_like(x)
    if D > 0:
        moved[D:] = x[:-D]
    else:
        moved[:D] = x[-D:]
    return moved


def times(G: Diagonals, x: FloatArray) -> FloatArray:
    """G x."""
    result = np.zeros_like(x)
    for D, diagonal in G.items():
        result += diagonal * shift(x, D)
    return result


def transposed_times(G: Diagonals, x: FloatArray) -> FloatArray:
    """G' x."""
    result = np.zeros_like(x)
    for D, diagonal in G.items():
        result += shift(diagonal * x, -D)
    return result


def symmetric_product(G: Diagonals, H: Diagonals, bandwidth: int) -> FloatArray:
    """(bandwidth + 1, N): the lower band of GH' + HG' as LAPACK stores it, [d, s] = (s + d, s)."""
    N = len(next(iter(G.values())))
    band = np.zeros((bandwidth + 1, N))
    for A, B in ((G, H), (H, G)):
        for D, a in A.items():
            for E, b in B.items():
                d = D - E
                if 0 <= d <= bandwidth:
                    band[d, : N - d] += a[d:] * b[: N - d]
    return band


@dataclass(frozen=True, eq=False)
class Factor:
    """K = LL' of a banded positive definite matrix; LinAlgError if it is not."""

    L: FloatArray  # (bandwidth + 1, N), as LAPACK stores it

    @classmethod
    def of(cls, K: FloatArray) -> "Factor":
        """Factor the lower band K (bandwidth + 1, N)."""
        return cls(cholesky_banded(K, lower=True, check_finite=False))

    def half_solve(self, B: FloatArray, *, overwrite: bool = False) -> FloatArray:
        """L⁻¹B for B (N,) or (N, m); `overwrite` allows to use B's memory (column by column)."""
        return self._solve(B, "N", overwrite=overwrite)

    def half_solve_transposed(self, B: FloatArray) -> FloatArray:
        """L⁻ᵀB for B (N,) or (N, m)."""
        return self._solve(B, "T")

    def _solve(self, B: FloatArray, trans: str, *, overwrite: bool = False) -> FloatArray:
        columns = B[:, None] if B.ndim == 1 else B
        solved, info = dtbtrs(self.L, columns, uplo="L", trans=trans, overwrite_b=overwrite)
        if info != 0:
            raise LinAlgError(f"triangular solve failed ({info})")
        return np.asarray(solved.reshape(B.shape, order="F"))

    @property
    def log_determinant(self) -> float:
        """log det K."""
        return float(2.0 * np.log(self.L[0]).sum())

    @property
    def smallest_pivot(self) -> float:
        """The smallest pivot of the elimination as a part of the median one."""
        return float((self.L[0].min() / np.median(self.L[0])) ** 2)

    def inverse_band(self) -> FloatArray:
        """(bandwidth + 1, N): the entries of K⁻¹ on the band of K, by the recursion
        K⁻¹ = L⁻ᵀL⁻¹ read from the last column to the first, O(N·bandwidth²).
        """
        L = self.L
        B, N = L.shape[0] - 1, L.shape[1]
        Z = np.zeros((B + 1, N))
        window = np.zeros((B, B))  # K⁻¹ on rows and columns s+1 … s+B
        for s in range(N - 1, -1, -1):
            ratio = L[1:, s] / L[0, s]
            ratio[max(0, N - 1 - s) :] = 0.0
            below = -window @ ratio
            Z[0, s] = 1.0 / L[0, s] ** 2 - ratio @ below
            Z[1:, s] = below
            if B:
                window[1:, 1:] = window[:-1, :-1].copy()
                window[0, 0] = Z[0, s]
                window[0, 1:] = window[1:, 0] = below[:-1]
        return Z
