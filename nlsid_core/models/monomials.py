"""Monomials in the entries of an input window: which there are, and their values."""

from itertools import combinations_with_replacement

import numpy as np

from nlsid_core._types import FloatArray, IntArray


def monomials_up_to(degree: int, variables: int) -> IntArray:
    """(m, variables) exponents of every monomial of total degree 0 … `degree`, lowest first."""
    rows = [
        np.bincount(np.array(chosen, dtype=np.int64), minlength=variables)
        for total in range(degree + 1)
        for chosen in combinations_with_replacement(range(variables), total)
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, variables)


def monomial_values(exponents: IntArray, points: FloatArray) -> FloatArray:
    """(..., m) values of m monomials (m, n) at points (..., n)."""
    values = np.ones((*points.shape[:-1], len(exponents)))
    for j in range(exponents.shape[1]):
        highest = max(exponents[:, j].tolist(), default=0)
        for power in range(1, highest + 1):
            values[..., exponents[:, j] >= power] *= points[..., j, None]
    return values
