"""How far one step of a closed loop takes an ellipsoid: exact polynomials, and what bounds them.

Around a nominal, x̄ = T z, the step is g(z) = S⁺[f(x_k + Tz, u_k - K_k T z) - x_{k+1}], with all
floats taken as the rationals they are; T is a rounded inverse of S, and S T itself is used where
the two meet, so the rounding of T does not matter.
"""

from collections.abc import Sequence
from fractions import Fraction
from itertools import product as every
from math import comb, factorial, isqrt, prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import FloatArray
from nlsid_core.certificate.identity import Product, decide_gram, decide_identity, one
from nlsid_core.errors import CertificateRejected
from nlsid_core.polynomial import Gram, Polynomial, compose_affine, monomials

Rational: TypeAlias = NDArray[np.object_]
ROOT_BITS = 90  # of an upper bound of a square root, after the binary point


def rational(values: FloatArray) -> Rational:
    """The exact value of every entry."""
    exact = np.empty(values.shape, dtype=object)
    exact.ravel()[:] = [Fraction(entry) for entry in values.ravel().tolist()]
    return exact


def names_of(n: int) -> tuple[str, ...]:
    """The normalised coordinates z0 … z(n-1)."""
    return tuple(f"z{i}" for i in range(n))


def closed_loop(
    equations: NDArray[np.object_],
    *,
    x: FloatArray,
    u: FloatArray,
    K: FloatArray,
    x_next: FloatArray,
    T: FloatArray,
    S_next: FloatArray,
) -> list[Polynomial]:
    """The n polynomials g(z), exactly; `equations` are f in [x; u]."""
    exact_T = rational(T)
    inner = np.vstack([exact_T, -(rational(K) @ exact_T)])
    shift = np.concatenate([rational(x), rational(u)])
    f = compose_affine(equations, inner, shift, names=names_of(len(x)))
    rows: Rational = rational(S_next) @ (f - rational(x_next))
    return list(rows)


def scaled(g: Sequence[Polynomial], radius: float) -> list[Polynomial]:
    """g(radius·z), exactly."""
    powers = [Fraction(1)]
    while len(powers) <= max(p.degree for p in g):
        powers.append(powers[-1] * Fraction(radius))
    parts = []
    for p in g:
        factors = np.array([powers[d] for d in p.exponents.sum(axis=1)], dtype=object)
        parts.append(Polynomial(p.exponents, p.exact().coefficients * factors, p.names))
    return parts


def prove_reach(
    g: Sequence[Polynomial],
    ST: Rational,
    radius: float,
    reach: float,
    Q: NDArray[Any],
    sigma: NDArray[Any],
) -> float:
    """Prove that |S x̄| ≤ radius implies |S⁺ x̄⁺| ≤ reach, undisturbed; returns the margin.

    The identity, in z with x̄ = radius·T z, σ = w'Σw and v, w all monomials up to degree d, d - 1:
        reach² - |g(radius·z)|² - σ(z)(1 - |S T z|²) = v'Qv,   Q ⪰ 0, Σ ⪰ 0.
    Raises CertificateRejected with the reason.
    """
    n, degree = len(g), max(1, max(p.degree for p in g))
    names = names_of(n)
    basis, inner = (monomials(n, range(d)) for d in (degree + 1, degree))
    if len(Q) != len(basis) or len(sigma) != len(inner):
        raise CertificateRejected(f"Gram matrices of a step of degree {degree} have another size")
    multiplier = Gram(inner, sigma, names)
    decide_gram(multiplier, strict=False)
    target = [Product(one(names), one(names, Fraction(reach) ** 2))]
    target += [Product(p, p, sign=-1) for p in scaled(g, radius)]
    target.append(Product(multiplier, _ball(ST, names), sign=-1))
    return decide_identity(target, Gram(basis, Q, names), strict=False)


def curvature(g: Sequence[Polynomial], A_unit: Rational | None) -> dict[tuple[int, int], Fraction]:
    """c_jl with |g(z + w) - g(z) - A_unit w| ≤ Σ_jl c_jl |z|^j |w|^l, every l ≥ 1.

    c_jl² sums, over outputs and over monomials z^α w^β of degrees j and l, the squared coefficient
    over the multinomials of α and β (Cauchy-Schwarz: Σ_α multinomial(α) z^2α = |z|^2j).
    """
    squares: dict[tuple[int, int], Fraction] = {}
    for row, p in enumerate(g):
        for exponent, coefficient in p.terms():
            for beta in every(*(range(e + 1) for e in exponent)):
                if not any(beta):
                    continue
                alpha = tuple(e - b for e, b in zip(exponent, beta, strict=True))
                term = Fraction(coefficient) * prod(map(comb, exponent, beta))
                if A_unit is not None and sum(exponent) == 1:
                    continue  # the linear part is compared with A below
                key = (sum(alpha), sum(beta))
                size = term**2 / (_multinomial(alpha) * _multinomial(beta))
                squares[key] = squares.get(key, Fraction(0)) + size
        if A_unit is not None:
            for j, unit in enumerate(np.eye(len(g), dtype=np.int64).tolist()):
                gap = Fraction(p.coefficient(unit)) - A_unit[row, j]
                squares[0, 1] = squares.get((0, 1), Fraction(0)) + gap**2
    return {key: root_above(value) for key, value in squares.items() if value}


def response_error(
    c: dict[tuple[int, int], Fraction], inflation: Fraction, radius: float, bound: float
) -> Fraction:
    """Σ c_jl (κ·radius)^j (κ·bound)^l: what a response up to `bound` adds to one step's reach."""
    s, r = inflation * Fraction(radius), inflation * Fraction(bound)
    return sum((value * s**j * r**i for (j, i), value in c.items()), Fraction(0))


def inflation(ST: Rational) -> Fraction:
    """κ with |z| ≤ κ|S T z|: 1/(1 - |S T - I|)."""
    gap = sum(((ST[i, j] - int(i == j)) ** 2 for i, j in np.ndindex(ST.shape)), Fraction(0))
    distance = root_above(gap) if gap else Fraction(0)
    if distance >= 1:
        raise CertificateRejected("T is not an inverse of S")
    return 1 / (1 - distance)


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


def _ball(ST: Rational, names: tuple[str, ...]) -> Polynomial:
    """1 - |S T z|²."""
    square = ST.T @ ST
    unit = np.eye(len(names), dtype=np.int64)
    total = one(names, Fraction(1))
    exponents = [unit[i] + unit[j] for i, j in np.ndindex(square.shape)]
    difference: Polynomial = total - Polynomial(np.array(exponents), square.ravel(), names)
    return difference


def _multinomial(exponent: Sequence[int]) -> int:
    return factorial(sum(exponent)) // prod(map(factorial, exponent))
