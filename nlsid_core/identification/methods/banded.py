"""A dataset as one banded linear system in the model's parameters, and banded matrices.

Equation errors over all rows of all trajectories: ε(θ, p) = errors θ - Q p, and the banded matrix
G(θ) = Σ_i θ_i diag(weights_i) S_{offset_i}, S_D the shift by D rows. A matrix G is stored by its
diagonals, {D: (N,) array}: entry (r, r - D) is G[D][r]; entries that fall outside are zero.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csr_array, dia_array

from nlsid_core.arrays import FloatArray

Diagonals = Mapping[int, FloatArray]


@dataclass(frozen=True, eq=False)
class Rows:
    """offsets: the diagonal of each left parameter; weights, errors: (N, n_g) columns; Q: (N, n_p)
    with orthonormal columns. Weights are zero where a lag reaches before its trajectory's first
    row: there the measured output stands in the errors only. `identity` are the left parameters
    of G = I.
    """

    offsets: tuple[int, ...]
    weights: FloatArray
    errors: FloatArray
    Q: FloatArray
    identity: FloatArray

    def __len__(self) -> int:
        """The number of rows N."""
        return len(self.errors)

    @cached_property
    def bandwidth(self) -> int:
        """The bandwidth of GG'."""
        return max(self.offsets) - min(*self.offsets, 0)

    @cached_property
    def groups(self) -> tuple[tuple[int, slice | list[int], FloatArray], ...]:
        """(diagonal, its left parameters, their weights), a slice where they are neighbours."""
        members: dict[int, list[int]] = {}
        for i, D in enumerate(self.offsets):
            members.setdefault(D, []).append(i)
        made = []
        for D, found in members.items():
            together = found[-1] - found[0] + 1 == len(found)
            group = slice(found[0], found[-1] + 1) if together else found
            made.append((D, group, self.weights[:, group]))
        return tuple(made)

    def G(self, theta: FloatArray) -> Diagonals:
        """G(θ) by diagonals."""
        return {D: weights @ theta[group] for D, group, weights in self.groups}

    @cached_property
    def eye(self) -> Diagonals:
        """The identity by diagonals."""
        return {0: np.ones(len(self))}

    @cached_property
    def unit(self) -> float:
        """Σ of the squared measured outputs: the scale of J."""
        return float(np.sum((self.errors @ self.identity) ** 2))


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


def sparse(G: Diagonals) -> csr_array:
    """G as a sparse matrix."""
    N = len(next(iter(G.values())))
    rows = np.array([shift(diagonal, -D) for D, diagonal in G.items()])
    return dia_array((rows, [-D for D in G]), shape=(N, N)).tocsr()


def lower_band(K: Diagonals) -> FloatArray:
    """(bandwidth + 1, N): the diagonals D ≥ 0 of K as LAPACK stores them, [D, s] = (s + D, s)."""
    N = len(next(iter(K.values())))
    band = np.zeros((max(K) + 1, N))
    for D, diagonal in K.items():
        if D >= 0:
            band[D, : N - D] = diagonal[D:]
    return band


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
    def pivots(self) -> FloatArray:
        """(N,): the pivots of the elimination of K."""
        return np.asarray(self.L[0] ** 2)
