"""The core of every polynomial claim: is Σ ± left·right = v'Qv with Q ≻ 0 (or Q ⪰ 0)?

The residual of the identity is absorbed: each monomial of it that is a product b_i·b_j of the
basis goes into Q_ij. What is then decided is the definiteness of a matrix, in one of two modes:
`exact` multiplies out in integers over one common denominator; `rigorous` in floating point with
a bound on every rounding error. Neither trusts where the numbers come from.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import IntArray
from nlsid_core.certificate import exact_numbers, rigorous
from nlsid_core.errors import CertificateRejected, Undecided
from nlsid_core.polynomial import Gram, Polynomial

Mode: TypeAlias = Literal["exact", "rigorous"]
Factor: TypeAlias = Polynomial | Gram

MAX_ORDER = (
    500  # of a Gram matrix: beyond it deciding takes minutes, and so would a denial of service
)
MAX_ENTRIES = 40_000_000  # exponents of the products to expand (320 MB); real proofs have 1e6
MAX_DEGREE = 2**15  # keeps sums of exponents and their weights within 64-bit integers


@dataclass(frozen=True)
class Product:
    """One summand ±left·right; `derivative` takes ∂left/∂(that variable) instead of left."""

    left: Factor
    right: Factor
    sign: int = 1
    derivative: int | None = None


@dataclass(frozen=True, eq=False)
class Terms:
    """Σ_k weight[k]·left[k]·right[k]·x^exponents[k], not collected, nothing rounded."""

    exponents: IntArray
    left: NDArray[Any]
    right: NDArray[Any]
    weight: IntArray


def decide_identity(
    target: Sequence[Product], gram: Gram, *, strict: bool, mode: Mode = "exact"
) -> float:
    """Prove Σ target = v'Q'v with Q' ≻ 0 (strict) or Q' ⪰ 0, Q' being gram.Q plus the residual.

    All factors are in the variables of `gram`, in that order. Returns a proved lower bound of the
    smallest eigenvalue of Q', relative to its largest diagonal entry; 0 if only definiteness or
    semidefiniteness is proved. Raises CertificateRejected with the reason, Undecided if this mode
    cannot tell.
    """
    terms = _expand(target, gram)
    pairs = (gram.basis[:, None] + gram.basis[None]).reshape(-1, len(gram.names))
    keys, position = group(np.concatenate([terms.exponents, pairs]))
    of_terms, of_pairs = position[: len(terms.exponents)], position[len(terms.exponents) :]
    home = np.full(len(keys), -1, dtype=np.int64)
    home[of_pairs[::-1]] = np.arange(len(pairs))[::-1]
    decide = exact_numbers.decide if mode == "exact" else rigorous.decide
    try:
        return decide(terms, of_terms, gram.Q, of_pairs, home, strict=strict)
    except rigorous.NotRepresentable as error:
        monomial = Polynomial(keys[[error.index]], np.ones(1), gram.names)
        raise CertificateRejected(
            f"the identity fails at {monomial}: its coefficient differs and the Gram basis has no "
            "product that could absorb it"
        ) from error


def decide_gram(gram: Gram, *, strict: bool, mode: Mode = "exact") -> None:
    """Prove gram.Q ≻ 0 (strict) or ⪰ 0 as it stands; raises as `decide_identity`."""
    _refuse_order(gram)
    decide = exact_numbers.decide_matrix if mode == "exact" else rigorous.decide_matrix
    decide(gram.Q, strict=strict)


def vanishes_only_at_zero(gram: Gram) -> bool:
    """True if v(x) = 0 exactly at x = 0: no constant in v, and a pure power of each variable."""
    used = gram.basis > 0
    pure = used[used.sum(axis=1) == 1]
    return bool(used.any(axis=1).all() and pure.any(axis=0).all())


def group(exponents: IntArray) -> tuple[IntArray, IntArray]:
    """Distinct rows and, for every row, the position of its like among them."""
    bases = exponents.max(axis=0, initial=0) + 1
    if np.log2(bases).sum() < 62:  # then a row is one 64-bit integer, and sorting is fast
        places = np.r_[1, np.cumprod(bases[:-1])]
        _, first, position = np.unique(exponents @ places, return_index=True, return_inverse=True)
        return exponents[first], position.ravel()
    rows, position = np.unique(exponents, axis=0, return_inverse=True)
    return rows, position.ravel()


def one(names: Sequence[str], value: int | float | Fraction = 1) -> Polynomial:
    """The constant `value`, exactly, as a factor in these variables."""
    exactly = Fraction(value)
    is_float = isinstance(value, float) or (exactly.denominator == 1 and abs(exactly) <= 2**53)
    coefficient = np.array([float(value)]) if is_float else np.array([exactly], dtype=object)
    return Polynomial(np.zeros((1, len(names)), dtype=np.int64), coefficient, tuple(names))


def _expand(target: Sequence[Product], gram: Gram) -> Terms:
    _refuse_order(gram)
    n, parts, size = len(gram.names), [], len(gram) ** 2
    for product in target:
        factors = (product.left, product.right)
        if any(factor.names != gram.names for factor in factors):
            raise CertificateRejected("the polynomials of a proof are in different variables")
        for factor in factors:
            if isinstance(factor, Gram):
                _refuse_order(factor)
        (e, a, w), (f, b, v) = _raw(product.left, product.derivative), _raw(product.right, None)
        size += len(a) * len(b)
        if size * n > MAX_ENTRIES:
            raise Undecided(f"{size} products in {n} variables are too many to expand")
        parts.append(
            Terms(
                (e[:, None] + f[None]).reshape(-1, n),
                np.repeat(a, len(b)),
                np.tile(b, len(a)),
                (product.sign * w[:, None] * v[None]).ravel(),
            )
        )
    if not parts:
        return Terms(np.zeros((0, n), np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))
    return Terms(
        np.concatenate([part.exponents for part in parts]),
        _joined([part.left for part in parts]),
        _joined([part.right for part in parts]),
        np.concatenate([part.weight for part in parts]),
    )


def _raw(factor: Factor, derivative: int | None) -> tuple[IntArray, NDArray[Any], IntArray]:
    """Exponents, coefficients and integer weights of a factor, uncollected."""
    if isinstance(factor, Gram):
        exponents = (factor.basis[:, None] + factor.basis[None]).reshape(-1, len(factor.names))
        coefficients = factor.Q.ravel()
    else:
        exponents, coefficients = factor.exponents, factor.coefficients
    if np.max(exponents, initial=0) > MAX_DEGREE:
        raise CertificateRejected(f"degree {np.max(exponents)} is more than {MAX_DEGREE}")
    weights = np.ones(len(coefficients), dtype=np.int64)
    if derivative is not None:
        keep = exponents[:, derivative] > 0
        exponents, coefficients = exponents[keep].copy(), coefficients[keep]
        weights = exponents[:, derivative].copy()
        exponents[:, derivative] -= 1
    return exponents, coefficients, weights


def _joined(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """One array; rationals throughout if there is one among them."""
    joined = np.concatenate(arrays)
    if joined.dtype == object:
        joined[:] = [Fraction(value) for value in joined]
    return joined


def _refuse_order(gram: Gram) -> None:
    if len(gram) > MAX_ORDER:
        raise Undecided(f"a Gram matrix of order {len(gram)}; this checker decides {MAX_ORDER}")
    if np.max(gram.basis, initial=0) > MAX_DEGREE:
        raise CertificateRejected(f"degree {np.max(gram.basis)} is more than {MAX_DEGREE}")
