"""Mode `exact`: every number of claim and proof is an integer over one common denominator D."""

from math import lcm
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import IntArray
from nlsid_core.certificate import dyadic
from nlsid_core.certificate.rigorous import (
    RESIDUAL_RATIO,
    RESIDUAL_TOO_LARGE,
    NotRepresentable,
)
from nlsid_core.errors import CertificateRejected, Undecided

if TYPE_CHECKING:
    from nlsid_core.certificate.identity import Terms

MAX_BITS = 20_000  # of D; all float64 fit in 2100


def decide(
    terms: "Terms",
    of_terms: IntArray,
    Q: NDArray[Any],
    of_pairs: IntArray,
    home: IntArray,
    *,
    strict: bool,
) -> float:
    """See `identity.decide_identity`; all sums are integers over 2D²."""
    D = common_denominator([terms.left, terms.right, Q])
    left, right, entries = (whole(a, D) for a in (terms.left, terms.right, Q.ravel()))
    residual = [0] * len(home)
    for k, a, b, w in zip(of_terms.tolist(), left, right, terms.weight.tolist(), strict=True):
        residual[k] += a * b * w
    for k, entry in zip(of_pairs.tolist(), entries, strict=True):
        residual[k] -= D * entry
    n = len(Q)
    M = [[2 * D * entry for entry in entries[i * n : (i + 1) * n]] for i in range(n)]
    largest = max((abs(entry) for row in M for entry in row), default=0)
    for k, r in enumerate(residual):
        if r:
            if home[k] < 0:
                raise NotRepresentable(k)
            if abs(r) * RESIDUAL_RATIO > largest:
                raise CertificateRejected(RESIDUAL_TOO_LARGE)
            i, j = divmod(int(home[k]), n)
            M[i][j] += r
            M[j][i] += r
    return _decide(M, strict=strict)


def decide_matrix(Q: NDArray[Any], *, strict: bool) -> float:
    """Q ≻ 0 (strict) or Q ⪰ 0 as it stands."""
    entries, n = whole(Q.ravel(), common_denominator([Q])), len(Q)
    return _decide([entries[i * n : (i + 1) * n] for i in range(n)], strict=strict)


def common_denominator(arrays: list[NDArray[Any]]) -> int:
    """The least D found quickly such that D times every entry is whole."""
    D = 1
    for array in arrays:
        if array.dtype == object:
            for value in array.ravel():
                D = lcm(D, value.denominator)
                _refuse_size(D)
        else:
            nonzero = array[array != 0]
            low = int(np.frexp(nonzero)[1].min()) if nonzero.size else 53
            D = lcm(D, 2 ** max(0, 53 - low))
    _refuse_size(D)
    return D


def whole(array: NDArray[Any], D: int) -> list[int]:
    """D times every entry, exactly."""
    if array.dtype == object:
        return [value.numerator * (D // value.denominator) for value in array]
    mantissas, exponents = np.frexp(array)
    scaled = (mantissas * 2.0**53).astype(np.int64).tolist()
    return [
        (m * D) << e if e >= 0 else (m * D) >> -e
        for m, e in zip(scaled, (exponents - 53).tolist(), strict=True)
    ]


def _decide(M: dyadic.Integers, *, strict: bool) -> float:
    margin = _margin(M)
    if margin > 0:
        return margin
    if strict and not dyadic.is_positive_definite(M):
        raise CertificateRejected("the Gram matrix, residual included, is not positive definite")
    if not strict and not dyadic.is_positive_semidefinite(M):
        raise CertificateRejected("the Gram matrix, residual included, has a negative eigenvalue")
    return 0.0


def _margin(M: dyadic.Integers) -> float:
    """Half the estimated smallest eigenvalue over the largest diagonal entry, if that is proved."""
    top = max((M[i][i] for i in range(len(M))), default=0)
    if top <= 0 or any(abs(entry) > top for row in M for entry in row):
        return 0.0
    relative = np.array([[entry / top for entry in row] for row in M])
    smallest = float(np.linalg.eigvalsh(relative)[0]) / 2
    if smallest <= 0:
        return 0.0
    numerator, denominator = smallest.as_integer_ratio()
    shifted = [
        [entry * denominator - (numerator * top if i == j else 0) for j, entry in enumerate(row)]
        for i, row in enumerate(M)
    ]
    return smallest if dyadic.is_dominated(shifted) else 0.0


def _refuse_size(D: int) -> None:
    if D.bit_length() > MAX_BITS:
        raise Undecided(f"the common denominator has more than {MAX_BITS} bits")
