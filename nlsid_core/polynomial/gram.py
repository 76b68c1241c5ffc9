"""`Gram`: a polynomial v(x)'Q v(x), v a vector of monomials; a sum of squares if Q ⪰ 0."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import IntArray, keep
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.polynomial.algebra import Polynomial


@dataclass(frozen=True, eq=False)
class Gram:
    """basis: (k, n) exponents of distinct monomials. Q: (k, k) symmetric, float64 or Fractions.

    Raises ShapeError on sizes that do not fit, DataError if Q is not finite or not symmetric, or
    if a monomial repeats.
    """

    basis: IntArray
    Q: NDArray[Any]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        Q = np.array(self.Q)
        Q = Q if Q.dtype == object else Q.astype(np.float64)
        columns = -1 if len(Q) else len(self.names)
        basis = np.array(self.basis, dtype=np.int64).reshape(len(Q), columns)
        if Q.shape != (len(basis), len(basis)) or basis.shape[1] != len(self.names):
            raise ShapeError(
                f"{len(basis)} monomials in {basis.shape[1]} variables do not fit Q of shape "
                f"{Q.shape} and {len(self.names)} names"
            )
        if Q.dtype != object and not np.isfinite(Q).all():
            raise DataError("a Gram matrix should be finite")
        if not (Q.T == Q).all():
            i, j = np.argwhere(Q.T != Q)[0]
            raise DataError(f"Q[{i}, {j}] = {Q[i, j]} differs from Q[{j}, {i}] = {Q[j, i]}")
        if len({tuple(row) for row in basis.tolist()}) != len(basis) or (basis < 0).any():
            raise DataError("a Gram basis should hold distinct monomials")
        keep(self, {"basis": basis, "Q": Q})
        object.__setattr__(self, "names", tuple(self.names))

    def __len__(self) -> int:
        return len(self.basis)

    def polynomial(self) -> Polynomial:
        """v'Qv multiplied out."""
        exponents = (self.basis[:, None] + self.basis[None]).reshape(-1, len(self.names))
        return Polynomial(exponents, self.Q.ravel(), self.names)
