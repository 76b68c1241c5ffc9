"""`Products`: monomials at a few points, with little overhead: one product for each degree."""

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray


class Products:
    """The monomials with these exponents (K, n), as products of entries of (z, 1)."""

    def __init__(self, exponents: IntArray) -> None:
        variables = exponents.shape[1]
        factors = [[j for j, e in enumerate(row) for _ in range(e)] for row in exponents.tolist()]
        depth = max(1, *map(len, factors)) if factors else 1
        filled = [row + [variables] * (depth - len(row)) for row in factors]
        self._factors = list(np.array(filled, dtype=np.intp).reshape(len(factors), depth).T)

    def __call__(self, z: FloatArray) -> FloatArray:
        """(B, K) at points (B, n + 1) whose last entries are 1."""
        values = z[:, self._factors[0]]
        for factor in self._factors[1:]:
            values = values * z[:, factor]
        return values
