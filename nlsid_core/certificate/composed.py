"""f(Az + b) exactly, fast: floats are whole numbers over powers of two, so integers do."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import FloatArray, IntArray
from nlsid_core.polynomial import monomials


def compose(
    exponents: IntArray, coefficients: FloatArray, A: NDArray[np.object_], b: NDArray[np.object_]
) -> tuple[NDArray[np.object_], int]:
    """Σ_i coefficients[i]·(Az + b)^exponents[i] as integers (k, n) over 2^bits, and bits.

    exponents: (m, v), coefficients: (m, n) floats, A: (v, d) and b: (v,) of dyadic Fractions. Rows
    of the result are the monomials(d, range(degree + 1)) of z.
    """
    degree, d = int(np.max(exponents.sum(axis=1))), A.shape[1]
    (forms, bits), (weights, weight_bits) = _whole(np.column_stack([b, A])), _whole(coefficients)
    known: dict[tuple[int, ...], NDArray[np.object_]] = {}
    size = len(monomials(d, range(degree + 1)))
    total = np.zeros((size, coefficients.shape[1]), dtype=np.object_)
    for exponent, weight in zip(exponents.tolist(), weights, strict=True):
        value = _power(tuple(exponent), forms, known)
        lift = bits * (degree - sum(exponent))
        total[: len(value)] += np.multiply.outer(value, weight << lift)
    return total, weight_bits + bits * degree


def _power(
    exponent: tuple[int, ...],
    forms: NDArray[np.object_],
    known: dict[tuple[int, ...], NDArray[np.object_]],
) -> NDArray[np.object_]:
    """Π_j forms[j]^exponent[j] over monomials up to its degree; remembers every part."""
    if exponent not in known:
        j = next((j for j, e in enumerate(exponent) if e), None)
        if j is None:
            known[exponent] = np.array([1], dtype=np.object_)
        else:
            lower = (*exponent[:j], exponent[j] - 1, *exponent[j + 1 :])
            before = _power(lower, forms, known)
            places = _times(forms.shape[1] - 1, sum(exponent))
            product = np.zeros(int(np.max(places)) + 1, dtype=np.object_)
            for factor, place in zip(forms[j], places, strict=True):
                if factor:
                    product[place] += factor * before
            known[exponent] = product
    return known[exponent]


@cache
def _times(d: int, degree: int) -> IntArray:
    """(d + 1, k): where each monomial below `degree` goes times 1, z0, …, z(d-1)."""
    index = {tuple(row): i for i, row in enumerate(monomials(d, range(degree + 1)).tolist())}
    factors = np.vstack([np.zeros((1, d), dtype=np.int64), np.eye(d, dtype=np.int64)])
    lower = monomials(d, range(degree))
    return np.array([[index[tuple(row)] for row in (lower + f).tolist()] for f in factors])


def _whole(values: NDArray[np.object_] | FloatArray) -> tuple[NDArray[np.object_], int]:
    """Floats or dyadic Fractions as integers over 2^bits, and bits."""
    ratios = [value.as_integer_ratio() for value in values.ravel().tolist()]
    bits = max(denominator.bit_length() - 1 for _, denominator in ratios)
    whole = np.empty(len(ratios), dtype=np.object_)
    whole[:] = [n << (bits - d.bit_length() + 1) for n, d in ratios]
    return whole.reshape(values.shape), bits
