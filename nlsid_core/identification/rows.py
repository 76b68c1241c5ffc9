"""`Rows`: a dataset as one banded linear system in the model's parameters.

Equation errors over all rows of all trajectories: ε(θ, p) = errors θ - Q p, and the banded matrix
G(θ) = Σ_i θ_i diag(weights_i) S_{offset_i}, S_D the shift by D rows.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.identification.banded import Diagonals, product


@dataclass(frozen=True, eq=False)
class Rows:
    """offsets: the diagonal of each left parameter; weights, errors: (N, n_g) columns; Q: (N, n_p)
    with orthonormal columns. Weights are zero where a lag reaches before its trajectory's first
    row: there the measured output stands in the errors only. `identity` are the left parameters
    of G = I. covariance: W⁻¹, symmetric positive definite by diagonals, of errors measured as
    |y - ŷ|²_W (None: W = I).
    """

    offsets: tuple[int, ...]
    weights: FloatArray
    errors: FloatArray
    Q: FloatArray
    identity: FloatArray
    covariance: Diagonals | None = None

    def __len__(self) -> int:
        """The number of rows N."""
        return len(self.errors)

    def weighted(self, weights: FloatArray) -> "Rows":
        """The same rows with errors measured as Σ weights (y - ŷ)², (N,) in the order of the rows.

        Raises DataError unless every weight is positive and finite.
        """
        given = np.asarray(weights, dtype=np.float64)
        if given.shape != (len(self),) or not (np.isfinite(given) & (given > 0)).all():
            raise DataError(f"weights should be ({len(self)},), positive and finite")
        return replace(self, covariance={0: 1.0 / given})

    @cached_property
    def bandwidth(self) -> int:
        """The bandwidth of G W⁻¹ G'."""
        own = 0 if self.covariance is None else max(map(abs, self.covariance))
        return max(self.offsets) - min(*self.offsets, 0) + own

    @cached_property
    def groups(self) -> tuple[tuple[int, slice | list[int]], ...]:
        """(diagonal, its left parameters), a slice where they are neighbours."""
        members: dict[int, list[int]] = {}
        for i, D in enumerate(self.offsets):
            members.setdefault(D, []).append(i)
        return tuple(
            (D, slice(found[0], found[-1] + 1) if found[-1] - found[0] + 1 == len(found) else found)
            for D, found in members.items()
        )

    def G(self, theta: FloatArray) -> Diagonals:
        """G(θ) by diagonals."""
        return {D: self.weights[:, group] @ theta[group] for D, group in self.groups}

    def weighed(self, G: Diagonals) -> Diagonals:
        """G W⁻¹."""
        return G if self.covariance is None else product(G, self.covariance)

    @cached_property
    def eye(self) -> Diagonals:
        """The identity by diagonals."""
        return {0: np.ones(len(self))}

    @cached_property
    def unit(self) -> float:
        """Σ of the squared measured outputs: the scale of J."""
        return float(np.sum((self.errors @ self.identity) ** 2))
