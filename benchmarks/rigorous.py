"""Bounds decided in floating point, for searches that decide thousands: this is no proof by check.

p - bound = v'Qv + Σ σ_k g_k + Σ μ_j h_j is multiplied out with a bound on every rounding error that
is made. What is left of it goes into Q, up to errors whose sum is at most ρ, and Q - ρI ≻ 0 is
shown by a Cholesky factorisation that completes on a matrix shifted by its own error bound. It
takes a millisecond where the kernel takes tens; only the kernel decides a proof file.
Source: Rump, "Verification of positive definiteness", BIT 46 (2006); Higham, "Accuracy and
Stability of Numerical Algorithms", Theorem 10.3. Assumes IEEE 754 double precision, rounding to
nearest, and a Cholesky factorisation that forms the usual inner products in any order.
"""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import CertificateRejected
from nlsid_core.polynomial import Gram, Polynomial

U = 2.0**-53  # unit roundoff
TINY = 2.0**-1000  # more than any underflow, times any integer weight, can contribute
SLACK = 1 + 1e-9  # covers the roundings made in the bounds: at most 4e6 of relative size U
# Residuals are what rounding and solver tolerance leave. A larger one might still be absorbed, but
# says that something went wrong before.
RESIDUAL_RATIO = 2**16
Summands = tuple[IntArray, FloatArray, FloatArray]  # exponents, and the two factors of each product


class Undecided(CertificateRejected):
    """Not decided in floating point; the kernel may decide it. Never a proof."""


@np.errstate(over="ignore", under="ignore", invalid="ignore")  # infinities are undecided below
def bound_holds(
    p: Polynomial,
    bound: float,
    gram: Gram,
    *,
    domain: Sequence[Polynomial] = (),
    multipliers: Sequence[Gram] = (),
    equalities: Sequence[Polynomial] = (),
    equality_multipliers: Sequence[Polynomial] = (),
) -> float:
    """A number below the least eigenvalue of Q once p - bound is v'Qv + …, over its largest entry.

    All are float64, in the variables of `gram`, in that order. Raises Undecided if rounding could
    decide otherwise; nothing is refuted.
    """
    for part in multipliers:
        _definite(part.Q, 0.0)
    n = len(gram.names)
    one = np.zeros((1, n), dtype=np.int64), np.ones(1)
    parts = [_product(_terms(p), one), _product(one, (one[0], np.array([-float(bound)])))]
    parts += [_product(_terms(s), _terms(g), -1) for s, g in zip(multipliers, domain, strict=True)]
    parts += [
        _product(_terms(m), _terms(h), -1)
        for m, h in zip(equality_multipliers, equalities, strict=True)
    ]
    exponents, left, right = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    pairs = (gram.basis[:, None] + gram.basis[None]).reshape(-1, n)
    keys, position = _grouped(np.concatenate([exponents, pairs]))
    of_pairs = position[len(exponents) :]
    home = np.full(len(keys), -1, dtype=np.int64)
    home[of_pairs[::-1]] = np.arange(len(pairs))[::-1]
    # Two roundings a product, and one less than `count` additions a coefficient:
    summands = np.r_[left * right, -gram.Q.ravel()]
    count = np.bincount(position, minlength=len(keys))
    magnitude = np.bincount(position, np.abs(summands), len(keys))
    residual = np.bincount(position, summands, len(keys))
    error = ((count + 4) * (U * magnitude) + count * TINY) * SLACK
    for k in np.flatnonzero((home < 0) & (count > 0)).tolist():
        which = np.flatnonzero(position[: len(exponents)] == k)
        products = zip(left[which].tolist(), right[which].tolist(), strict=True)
        if sum((Fraction(a) * Fraction(b) for a, b in products), Fraction(0)):
            raise Undecided(f"no product of the basis is the monomial {keys[k].tolist()}")
    residual, error, home = residual[home >= 0], error[home >= 0], home[home >= 0]
    largest = np.abs(gram.Q).max(initial=0.0)
    if not (np.abs(residual) + error <= largest / RESIDUAL_RATIO).all():  # also if not finite
        raise Undecided("the identity does not hold: its residual is more than rounding leaves")
    # Absorb: each residual into one entry and its mirror image, which rounds once more.
    i, j = np.divmod(home, len(gram))
    absorbed = gram.Q.copy()
    absorbed[i, j] += np.where(i == j, residual, residual / 2)
    absorbed[j, i] = absorbed[i, j]
    rounding = 2 * U * np.abs(absorbed[i, j]) + TINY
    return _definite(absorbed, float(error.sum() + rounding[residual != 0].sum()) * SLACK)


@np.errstate(over="ignore", under="ignore", invalid="ignore")
def is_positive_definite(A: FloatArray, shift: float = 0.0) -> bool:
    """True proves A - shift·I ≻ 0 for symmetric A; False proves nothing."""
    n = len(A)
    diagonal = np.nextafter(np.diag(A) - shift, -np.inf)
    if not (np.isfinite(A).all() and (diagonal > 0).all()):
        return False
    # Powers of two on both sides bring the diagonal into [¼, 1]: exact, save for underflow (TINY).
    scale = -((np.frexp(diagonal)[1] + 1) // 2)
    scaled = np.ldexp(np.ldexp(A, scale[:, None]), scale[None, :])
    unit = np.ldexp(diagonal, 2 * scale)
    # γ_{n+1} of the textbook factorisation, three times over: kernels may multiply by reciprocals.
    k = 3 * (n + 5) * U
    error = (k / (1 - 2 * k) * unit.sum() + n * TINY) * SLACK
    scaled[np.diag_indices(n)] = np.nextafter(unit - error, -np.inf)
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(factor).all() and (np.diag(factor) > 0).all())


def _definite(Q: FloatArray, rho: float) -> float:
    """A bound below λ_min(Q - ρI) over the largest diagonal entry; Undecided if not positive."""
    if len(Q) and np.isfinite(Q).all():
        half = (float(np.linalg.eigvalsh(Q)[0]) - rho) / 2
        if half > 0 and is_positive_definite(Q, (rho + half) * SLACK):
            return half / float(np.max(np.diag(Q))) / SLACK
    if is_positive_definite(Q, rho):
        return 0.0
    raise Undecided(f"Q - {rho:.2e} I is not shown to be positive definite in floating point")


def _product(
    a: tuple[IntArray, FloatArray], b: tuple[IntArray, FloatArray], sign: int = 1
) -> Summands:
    exponents = (a[0][:, None] + b[0][None]).reshape(-1, a[0].shape[1])
    return exponents, sign * np.repeat(a[1], len(b[1])), np.tile(b[1], len(a[1]))


def _grouped(exponents: IntArray) -> tuple[IntArray, IntArray]:
    """Distinct rows and, for every row, the position of its like among them."""
    bases = exponents.max(axis=0, initial=0) + 1
    if np.log2(bases).sum() < 62:  # then a row is one 64-bit integer, and sorting is fast
        places = np.r_[1, np.cumprod(bases[:-1])]
        _, first, position = np.unique(exponents @ places, return_index=True, return_inverse=True)
        return exponents[first], position.ravel()
    rows, position = np.unique(exponents, axis=0, return_inverse=True)
    return rows, position.ravel()


def _terms(factor: Polynomial | Gram) -> tuple[IntArray, FloatArray]:
    """Exponents and coefficients, not collected."""
    if isinstance(factor, Gram):
        exponents = (factor.basis[:, None] + factor.basis[None]).reshape(-1, len(factor.names))
        return exponents, _floats(factor.Q.ravel())
    return factor.exponents, _floats(factor.coefficients)


def _floats(values: FloatArray) -> FloatArray:
    if values.dtype == object:
        raise Undecided("floating point decides float64 coefficients only")
    return values
