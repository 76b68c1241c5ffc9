"""How far one step of a closed loop takes an ellipsoid: exact polynomials, and what bounds them.

Around a nominal, x̄ = T z, the step is g(z) = S⁺[f(x_k + Tz, u_k - K_k T z) - x_{k+1}], with all
floats taken as the rationals they are. T is a rounded inverse of S: |z| ≤ κ|S x̄|. The norms of a
state are |x̄| = |S x̄| before the step and |x̄⁺| = |S⁺ x̄⁺| after it.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import product as every
from math import comb, factorial, isqrt, prod
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import FloatArray
from nlsid_core.certificate.composed import compose
from nlsid_core.certificate.exact import is_positive_definite
from nlsid_core.certificate.identity import (
    MAX_ORDER,
    Mode,
    Product,
    decide_gram,
    decide_identity,
    one,
)
from nlsid_core.errors import CertificateRejected, Undecided
from nlsid_core.models.state_map import StateModel
from nlsid_core.polynomial import Gram, Polynomial, monomials

Rational: TypeAlias = NDArray[np.object_]
EIGENVALUE_ROOM = 1.0 + 1e-9  # over an eigenvalue computed in floats, to be proved in rationals
ROOT_BITS = 90  # of an upper bound of a square root, after the binary point


def rational(values: FloatArray) -> Rational:
    """The exact value of every entry."""
    exact = np.empty(values.shape, dtype=object)
    exact.ravel()[:] = [Fraction(entry) for entry in values.ravel().tolist()]
    return exact


def refuse_size(model: StateModel) -> None:
    """Raise Undecided, before any work, if a step's Gram matrices would be too large to decide."""
    n, degree = len(model), int(np.max(model.exponents.sum(axis=1)))
    order = comb(n + degree, n)
    if order > MAX_ORDER:
        raise Undecided(
            f"{n} states and degree {degree} make Gram matrices of order {order}; this checker "
            f"decides {MAX_ORDER}"
        )


def names_of(n: int) -> tuple[str, ...]:
    """The normalised coordinates z0 … z(n-1)."""
    return tuple(f"z{i}" for i in range(n))


def closed_loop(
    model: StateModel,
    *,
    x: FloatArray,
    u: FloatArray,
    K: FloatArray,
    x_next: FloatArray,
    T: FloatArray,
    S_next: FloatArray,
) -> Rational:
    """(m, n): the coefficients of g(z), exactly, over `monomials(n, range(degree + 1))`."""
    exact_T = rational(T)
    whole, bits = compose(
        model.exponents,
        model.coefficients,
        np.vstack([exact_T, -(rational(K) @ exact_T)]),
        np.concatenate([rational(x), rational(u)]),
    )
    f = np.empty(whole.shape, dtype=object)
    f.ravel()[:] = [Fraction(entry, 1 << bits) for entry in whole.ravel()]
    f[0] -= rational(x_next)
    return np.asarray(f @ rational(S_next).T)


def rounded(g: Rational, radius: float) -> tuple[FloatArray, Fraction]:
    """Coefficients of g(radius·z) in floats, and how far they can be off anywhere in |z| ≤ 1."""
    powers = [Fraction(radius) ** degree for degree in range(degree_of(g) + 1)]
    degrees = monomials(g.shape[1], range(len(powers))).sum(axis=1)
    exact = g * np.array([powers[degree] for degree in degrees], dtype=object)[:, None]
    floats = exact.astype(np.float64)
    gap: Fraction = np.abs(exact - rational(floats)).sum()
    return floats, gap


def degree_of(g: Rational, variables: int | None = None) -> int:
    """The degree up to which `g` has rows, in as many variables as it has columns, or so many."""
    n, degree = g.shape[1] if variables is None else variables, 1
    while comb(n + degree, n) < len(g):
        degree += 1
    return degree


def prove_reach(
    g: Rational,
    radius: float,
    inflated: float,
    reach: float,
    Q: FloatArray,
    sigma: FloatArray,
    *,
    mode: Mode = "exact",
) -> float:
    """Prove that |x̄| ≤ radius implies |x̄⁺| ≤ reach, undisturbed; returns the margin.

    inflated: at least κ·radius (`inflation`), so that x̄ = inflated·T z with |z| ≤ 1. With
    ĝ the rounded g(inflated·z), off by at most δ, and v, w all monomials up to degree d, d - 1,
        (reach - δ)² - |ĝ(z)|² - w'Σw (1 - |z|²) = v'Qv,   Q ⪰ 0, Σ ⪰ 0;
    the square on the left is rounded down. Raises CertificateRejected with the reason.
    """
    n, degree = g.shape[1], degree_of(g)
    names = names_of(n)
    basis, inner = (monomials(n, range(d)) for d in (degree + 1, degree))
    if len(Q) != len(basis) or len(sigma) != len(inner):
        raise CertificateRejected(f"Gram matrices of a step of degree {degree} have another size")
    coefficients, off = rounded(g, inflated)
    left = Fraction(reach) - off
    if left <= 0:
        raise CertificateRejected(f"reach {reach:.6g} of radius {radius:.6g} is nothing")
    square = float(left**2)
    if Fraction(square) > left**2:
        square = float(np.nextafter(square, 0.0))
    multiplier = Gram(inner, sigma, names)
    decide_gram(multiplier, strict=False, mode=mode)
    rows = [Polynomial(basis, column, names) for column in coefficients.T]
    target = [Product(one(names), one(names, square))]
    target += [Product(p, p, sign=-1) for p in rows]
    target.append(Product(multiplier, _ball(names), sign=-1))
    return decide_identity(target, Gram(basis, Q, names), strict=False, mode=mode)


def curvature(
    g: Rational, A_unit: Rational, variables: int | None = None
) -> dict[tuple[int, int], Fraction]:
    """c_jl with |g(z + w) - g(z) - A_unit w| ≤ Σ_jl c_jl |z|^j |w|^l, every l ≥ 1.

    The part of degrees j and l is M m(z, w), m the monomials z^α w^β times the roots of the
    multinomials of α and β, so that |m|² = |z|^2j |w|^2l. c_jl² is at least the largest
    eigenvalue of MM', which is rational.
    """
    n = g.shape[1] if variables is None else variables
    squares: dict[tuple[int, int], Rational] = {}
    exponents = monomials(n, range(degree_of(g, n) + 1)).tolist()
    for exponent, row in zip(exponents, g, strict=True):
        if sum(exponent) == 1:
            row = row - A_unit[:, exponent.index(1)]  # linear: compared with A
        if not row.any():
            continue
        outer = np.multiply.outer(row, row)
        for beta in every(*(range(e + 1) for e in exponent)):
            alpha = tuple(e - b for e, b in zip(exponent, beta, strict=True))
            key = (sum(alpha), sum(beta))
            if key[1]:
                share = Fraction(prod(map(comb, exponent, beta)) ** 2)
                share /= _multinomial(alpha) * _multinomial(beta)
                squares[key] = squares.get(key, 0) + outer * share
    return {key: root_above(_largest_eigenvalue(square)) for key, square in squares.items()}


def response_error(
    c: Mapping[tuple[int, int], Fraction], inflation: Fraction, radius: float, bound: float
) -> Fraction:
    """Σ c_jl (κ·radius)^j (κ·bound)^l: what a response up to `bound` adds to one step's reach."""
    s, r = inflation * Fraction(radius), inflation * Fraction(bound)
    return sum((value * s**j * r**i for (j, i), value in c.items()), Fraction(0))


def stretch(
    c: Mapping[tuple[int, int], Fraction],
    inflation: Fraction,
    radius: float | Fraction,
    bound: float | Fraction,
) -> Fraction:
    """μ with |g(z + w) - g(z)| ≤ μ|w| for |z| ≤ radius and |w| ≤ bound, c of A = 0."""
    s, r = inflation * Fraction(radius), inflation * Fraction(bound)
    terms = (value * s**j * r ** (i - 1) for (j, i), value in c.items())
    return inflation * sum(terms, Fraction(0))


def inflation(ST: Rational) -> Fraction:
    """κ with |z| ≤ κ|S T z|: 1/(1 - |S T - I|)."""
    gap = sum(((ST[i, j] - int(i == j)) ** 2 for i, j in np.ndindex(ST.shape)), Fraction(0))
    distance = root_above(gap) if gap else Fraction(0)
    if distance >= 1:
        raise CertificateRejected("T is not an inverse of S")
    return 1 / (1 - distance)


def inflate(kappa: Fraction, radius: float | Fraction) -> float:
    """A float at least κ·radius."""
    value = float(kappa * Fraction(radius))
    return (
        value if Fraction(value) >= kappa * Fraction(radius) else float(np.nextafter(value, np.inf))
    )


def reach_squared(S: Rational, row: Rational) -> Fraction:
    """max (row·x̄)² over |S x̄| ≤ 1, S upper triangular: |S⁻ᵀ row|²."""
    y: list[Fraction] = []
    for i in range(len(S)):
        known = sum((S[j, i] * y[j] for j in range(i)), Fraction(0))
        y.append((row[i] - known) / S[i, i])
    return sum((entry**2 for entry in y), Fraction(0))


def root_above(value: Fraction) -> Fraction:
    """A rational at least √value, closer than 2^(2 - ROOT_BITS)."""
    whole = -((-value.numerator << 2 * ROOT_BITS) // value.denominator)
    return Fraction(isqrt(whole) + 1, 1 << ROOT_BITS)


def norm_above(M: Rational) -> Fraction:
    """A rational at least the largest singular value of M."""
    square = M @ M.T
    return root_above(_largest_eigenvalue(square)) if square.any() else Fraction(0)


def _ball(names: tuple[str, ...]) -> Polynomial:
    """1 - |z|²."""
    n = len(names)
    exponents = np.vstack([np.zeros((1, n), dtype=np.int64), 2 * np.eye(n, dtype=np.int64)])
    return Polynomial(exponents, np.r_[1.0, -np.ones(n)], names)


def _largest_eigenvalue(M: Rational) -> Fraction:
    """A rational at least the largest eigenvalue of M ⪰ 0; the trace where no less is proved."""
    estimate = Fraction(float(np.linalg.eigvalsh(M.astype(np.float64))[-1]) * EIGENVALUE_ROOM)
    shifted = [[estimate * int(i == j) - M[i, j] for j in range(len(M))] for i in range(len(M))]
    trace: Fraction = np.trace(M)
    return estimate if estimate < trace and is_positive_definite(shifted) else trace


def _multinomial(exponent: Sequence[int]) -> int:
    return factorial(sum(exponent)) // prod(map(factorial, exponent))
