"""Which monomials a Gram matrix needs, and how it splits into blocks.

Source: Löfberg, "Pre- and post-processing sum-of-squares programs in practice", IEEE TAC 2009.
"""

import numpy as np

from nlsid_core.arrays import IntArray
from nlsid_core.polynomial import monomials


def gram_basis(support: IntArray) -> IntArray:
    """(k, n) monomials that can occur in the squares of a polynomial with this support (m, n).

    Starts from the monomials within half the degree bounds, then repeatedly drops b while b² is
    neither in the support nor a product of two other candidates. What is left lies in half the
    Newton polytope: for a vertex b of the hull of the candidates b² is b·b only, so b stays only if
    b² is in the support.
    """
    if not len(support):
        return np.zeros((0, support.shape[1]), dtype=np.int64)
    degrees = support.sum(axis=1)
    low, high = int(np.min(degrees) + 1) // 2, int(np.max(degrees)) // 2
    return drop_inconsistent(monomials(support.shape[1], range(low, high + 1)), support)


def drop_inconsistent(candidates: IntArray, support: IntArray) -> IntArray:
    """Drop b while b² is neither in the support nor a product of two other candidates.

    Those outside half the box of the support, which the rule would drop one after the other, first.
    """
    low, high = (support.min(axis=0) + 1) // 2, support.max(axis=0) // 2
    candidates = candidates[((candidates >= low) & (candidates <= high)).all(axis=1)]
    # A number for each monomial, so that products are sums; 2 high + 1 is the largest exponent.
    places = np.cumprod([1, *(2 * high + 2).tolist()], dtype=object)
    weights = places[:-1].astype(np.int64 if places[-1] < 2**62 else object)
    numbers, present = candidates @ weights, support @ weights
    while True:
        products, counts = np.unique(numbers[:, None] + numbers, return_counts=True)
        keep = np.isin(2 * numbers, np.concatenate([present, products[counts > 1]]))
        if keep.all():
            return candidates
        candidates, numbers = candidates[keep], numbers[keep]


def sign_blocks(basis: IntArray, support: IntArray) -> list[IntArray]:
    """Index sets of `basis` that a Gram matrix never couples, by sign symmetry.

    A sign change z_j -> -z_j that leaves every monomial of the support unchanged splits the basis
    into the monomials it keeps and those it negates; products across the two cannot be needed.
    """
    signs = parity_kernel(support % 2)
    signature = (basis @ signs.T) % 2
    keys = [tuple(row) for row in signature.tolist()]
    return [
        np.array([i for i, k in enumerate(keys) if k == key], dtype=np.int64)
        for key in sorted(set(keys))
    ]


def parity_kernel(parity: IntArray) -> IntArray:
    """Rows s in {0,1}^n with s·α even for every row α: the kernel over GF(2)."""
    n = parity.shape[1]
    rows = [row.copy() for row in np.unique(parity, axis=0)]
    pivots: list[int] = []
    reduced: list[IntArray] = []
    for row in rows:
        for pivot, other in zip(pivots, reduced, strict=True):
            if row[pivot]:
                row ^= other
        if row.any():
            pivot = int(np.flatnonzero(row)[0])
            for k, other in enumerate(reduced):
                if other[pivot]:
                    reduced[k] = other ^ row
            pivots.append(pivot)
            reduced.append(row)
    kernel = []
    for free in (j for j in range(n) if j not in pivots):
        s = np.zeros(n, dtype=np.int64)
        s[free] = 1
        for pivot, row in zip(pivots, reduced, strict=True):
            s[pivot] = row[free]
        kernel.append(s)
    return np.array(kernel, dtype=np.int64).reshape(-1, n)
