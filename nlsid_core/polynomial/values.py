"""Values of monomials at many points, the inner loop of every evaluation."""

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray


def monomial_values(exponents: IntArray, points: FloatArray) -> FloatArray:
    """(N, m) values of m monomials (m, n) at N points (N, n)."""
    values = np.ones((len(points), len(exponents)))
    for j in range(exponents.shape[1]):
        top = int(np.max(exponents[:, j], initial=0))
        if top:
            powers = np.ones((top + 1, len(points)))
            for k in range(1, top + 1):
                powers[k] = powers[k - 1] * points[:, j]
            values *= powers[exponents[:, j]].T
    return values
