"""`Rows`: a dataset as one banded linear system in the model's parameters.

Equation errors over all rows of all trajectories: ε(θ, p) = errors θ - Q p, and the banded matrix
G(θ) = Σ_i θ_i diag(weights_i) S_{offset_i}, S_D the shift by D rows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.identification.banded import Diagonals


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

    def G(self, theta: FloatArray) -> Diagonals:
        """G(θ) by diagonals."""
        diagonals: dict[int, FloatArray] = {}
        for D, column, value in zip(self.offsets, self.weights.T, theta, strict=True):
            diagonals[D] = diagonals.get(D, 0.0) + value * column
        return diagonals

    @cached_property
    def eye(self) -> Diagonals:
        """The identity by diagonals."""
        return {0: np.ones(len(self))}

    @cached_property
    def unit(self) -> float:
        """Σ of the squared measured outputs: the scale of J."""
        return float(np.sum((self.errors @ self.identity) ** 2))
