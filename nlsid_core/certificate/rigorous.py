"""Mode `rigorous`: floating point, with a bound on every rounding error that is made.

The residual is absorbed as in mode `exact`, up to errors whose sum is at most ρ; Q - ρI ≻ 0 is
proved by a Cholesky factorisation that completes on a matrix shifted by its own error bound.
Source: Rump, "Verification of positive definiteness", BIT 46 (2006); Higham, "Accuracy and
Stability of Numerical Algorithms", Theorem 10.3. Assumes IEEE 754 double precision, rounding to
nearest, and a Cholesky factorisation that forms the usual inner products in any order.
"""

from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import FloatArray, IntArray
from nlsid_core.errors import Undecided

if TYPE_CHECKING:
    from nlsid_core.certificate.identity import Terms

U = 2.0**-53  # unit roundoff
TINY = 2.0**-1000  # more than any underflow, times any integer weight, can contribute
SLACK = 1 + 1e-9  # covers the roundings made in the bounds: at most 4e6 of relative size U
# Residuals are what rounding and solver tolerance leave. A larger one might still be absorbed, but
# says that the proof was damaged: refuse it, and never let the checker finish an unfinished proof.
RESIDUAL_RATIO = 2**16
RESIDUAL_TOO_LARGE = "the identity does not hold: its residual is more than rounding leaves"
MAX_EXACT_TERMS = 10_000  # cancellations that have to be exact are checked in rationals


class NotRepresentable(Exception):  # noqa: N818 - internal signal, turned into a rejection
    """A residual monomial that no product of the basis equals; `index` says which."""

    def __init__(self, index: int) -> None:
        super().__init__(index)
        self.index = index


@np.errstate(over="ignore", under="ignore", invalid="ignore")  # infinities are undecided below
def decide(
    terms: "Terms",
    of_terms: IntArray,
    Q: NDArray[Any],
    of_pairs: IntArray,
    home: IntArray,
    *,
    strict: bool,
) -> float:
    """See `identity.decide_identity`. Semidefinite but singular is Undecided here."""
    del strict  # positive definite is all that rounding leaves room to prove
    left, right, matrix = (_floats(array) for array in (terms.left, terms.right, Q))
    position = np.r_[of_terms, of_pairs]
    size = len(home)
    # Two roundings a product, and one less than `count` additions a coefficient:
    summands = np.r_[terms.weight * (left * right), -matrix.ravel()]
    count = np.bincount(position, minlength=size)
    magnitude = np.bincount(position, np.abs(summands), size)
    residual = np.bincount(position, summands, size)
    error = ((count + 4) * (U * magnitude) + count * TINY) * SLACK
    for k in np.flatnonzero((home < 0) & (count > 0)).tolist():
        _refuse_unless_zero(terms, left, right, np.flatnonzero(of_terms == k), k)
    residual, error, home = residual[home >= 0], error[home >= 0], home[home >= 0]
    largest = np.abs(matrix).max(initial=0.0)
    if not (np.abs(residual) + error <= largest / RESIDUAL_RATIO).all():  # also if not finite
        raise Undecided(f"{RESIDUAL_TOO_LARGE}, or overestimated; the exact mode decides")
    # Absorb: each residual into one entry and its mirror image, which rounds once more.
    i, j = np.divmod(home, len(Q))
    absorbed = matrix.copy()
    absorbed[i, j] += np.where(i == j, residual, residual / 2)
    absorbed[j, i] = absorbed[i, j]
    rounding = 2 * U * np.abs(absorbed[i, j]) + TINY
    rho = float(error.sum() + rounding[residual != 0].sum()) * SLACK
    return _decide_shifted(absorbed, rho)


def decide_matrix(Q: NDArray[Any], *, strict: bool) -> float:
    """Q ≻ 0 as it stands (strict or not)."""
    del strict
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return _decide_shifted(_floats(Q), 0.0)


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


def _decide_shifted(Q: FloatArray, rho: float) -> float:
    if len(Q) and np.isfinite(Q).all():
        half = (float(np.linalg.eigvalsh(Q)[0]) - rho) / 2
        largest = float(np.max(np.diag(Q)))
        if half > 0 and is_positive_definite(Q, (rho + half) * SLACK):
            return half / largest / SLACK
    if is_positive_definite(Q, rho):
        return 0.0
    raise Undecided(
        f"Q - {rho:.2e} I is not proved positive definite in floating point; the exact mode decides"
    )


def _floats(array: NDArray[Any]) -> FloatArray:
    if array.dtype != object:
        return array
    try:
        rounded = array.astype(np.float64)
    except OverflowError as error:
        raise Undecided("a rational overflows float64; the exact mode decides") from error
    flat = zip(array.ravel(), rounded.ravel().tolist(), strict=True)
    if not np.isfinite(rounded).all() or any(a != Fraction(b) for a, b in flat):
        raise Undecided("a rational is not a float64; the exact mode decides")
    return rounded


def _refuse_unless_zero(
    terms: "Terms", left: FloatArray, right: FloatArray, which: IntArray, index: int
) -> None:
    """A coefficient that nothing can absorb has to vanish exactly: add it up in rationals."""
    if len(which) > MAX_EXACT_TERMS:
        raise Undecided(f"{len(which)} terms have to cancel exactly; the exact mode decides")
    total = sum(
        (
            Fraction(a) * Fraction(b) * w
            for a, b, w in zip(
                left[which].tolist(),
                right[which].tolist(),
                terms.weight[which].tolist(),
                strict=True,
            )
        ),
        Fraction(0),
    )
    if total:
        raise NotRepresentable(index)
