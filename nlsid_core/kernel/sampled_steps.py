"""One step of a closed loop around a nominal, exactly: its polynomials, and what bounds them.

Coordinates are stated: x̄ = T z, and for an implicit model v̄⁺ = T⁺w. Sizes are |S x̄| before the
step and |S⁺x̄⁺| after it. A part p_m = Σ c_e z^e of degree m obeys |p_m(z)| <= γ|z|^m, and so does
the symmetric m-linear map that it comes from, if γ²I - Σ c_e c_e' Π e_i!/m! ⪰ 0. Hence
    |p(z + w) - p(z)| <= Σ_m γ_m ((|z| + |w|)^m - |z|^m) <= μ|w|.                  (`stretch`)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import factorial, prod

from .exact import Matrix, combined, product, semidefinite, transposed
from .files import Rejected, Terms
from .polynomials import BITS, Polynomial, Ring


@dataclass(frozen=True)
class Sample:
    """A sample of a policy and the next state, with the shapes of both and A of the response."""

    x: list[Fraction]
    u: list[Fraction]
    K: Matrix
    x_next: list[Fraction]
    S: Matrix
    S_next: Matrix
    A: Matrix


def explicit_step(f: Sequence[Terms], at: Sample, T: Matrix, ring: Ring) -> list[Polynomial]:
    """S⁺(f(x + Tz, u - K T z) - x⁺)."""
    moved = ring.substituted(f, _state_and_input(at, T, ring))
    return ring.product(at.S_next, [p - c for p, c in zip(moved, at.x_next, strict=True)])


def implicit_step(
    a: Sequence[Terms], at: Sample, T: Matrix, T_next: Matrix, period: Fraction, ring: Ring
) -> tuple[list[Polynomial], list[Polynomial]]:
    """S⁺x̄⁺ and h = v⁺ - v - period/2 (a(q, v, u) + a(q⁺, v⁺, u)), in z, then w.

    v⁺ = v_{k+1} + T⁺w and q⁺ = q + period/2 (v + v⁺).
    """
    d, half = len(T_next), period / 2
    here = _state_and_input(at, T, ring)
    q, v, u = here[:d], here[d : 2 * d], here[2 * d :]
    moved = ring.product(T_next, ring.variables[2 * d :])
    rate = [p + c for p, c in zip(moved, at.x_next[d:], strict=True)]
    place = [p + half * (s + r) for p, s, r in zip(q, v, rate, strict=True)]
    pulls = ring.substituted(a, here), ring.substituted(a, [*place, *rate, *u])
    h = [r - s - half * (b + c) for r, s, b, c in zip(rate, v, *pulls, strict=True)]
    after = [p - c for p, c in zip([*place, *rate], at.x_next, strict=True)]
    return ring.product(at.S_next, after), h


def linear_part(p: Sequence[Polynomial], ring: Ring) -> Matrix:
    """The coefficients of degree 1: a row for each polynomial."""
    keys = [1 << (BITS * i) for i in range(ring.count)]
    return [[Fraction(q.terms.get(key, 0), q.denominator) for key in keys] for q in p]


def prove_curvature(
    p: Sequence[Polynomial], gammas: Sequence[Fraction], ring: Ring, least: int
) -> None:
    """Raise Rejected unless gammas bound the parts of p of degree least, least + 1, and so on."""
    sizes: dict[int, Matrix] = {}
    for key in set().union(*(q.terms for q in p)):
        e = ring.exponents(key)
        c, m = [Fraction(q.terms.get(key, 0), q.denominator) for q in p], sum(e)
        outer = [[a * b for b in c] for a in c]
        share = Fraction(prod(map(factorial, e)), factorial(m))
        sizes[m] = combined(sizes.get(m, [[Fraction(0)] * len(c)] * len(c)), outer, share)
    if max(sizes, default=0) >= least + len(gammas):
        raise Rejected("curvature: a bound for every degree is needed")
    for m, gamma in enumerate(gammas, start=least):
        if m in sizes:
            _at_most_square(sizes[m], gamma, f"curvature bound on degree {m}")


def stretch(gammas: Sequence[Fraction], size: Fraction, step: Fraction, least: int) -> Fraction:
    """μ with |p(z + w) - p(z)| <= μ|w| for |z| <= size, |w| <= step; degrees from `least` on."""
    far, total = size + step, Fraction(0)
    for m, gamma in enumerate(gammas, start=least):
        total += gamma * sum((far**i * size ** (m - 1 - i) for i in range(m)), Fraction(0))
    return total


def prove_norm(M: Matrix, bound: Fraction, what: str) -> None:
    """Raise Rejected unless |M v| <= bound |v| for every v."""
    _at_most_square(product(M, transposed(M)), bound, what)


def prove_inverse(M: Matrix, bound: Fraction, what: str) -> None:
    """Raise Rejected unless |z| <= bound |M z| for every z."""
    MM = product(transposed(M), M)
    scaled = [[bound**2 * e - (i == j) for j, e in enumerate(row)] for i, row in enumerate(MM)]
    semidefinite(scaled, what)


def _at_most_square(MM: Matrix, bound: Fraction, what: str) -> None:
    semidefinite(
        [[bound**2 * (i == j) - e for j, e in enumerate(row)] for i, row in enumerate(MM)], what
    )


def _state_and_input(at: Sample, T: Matrix, ring: Ring) -> list[Polynomial]:
    """x + T z and u - K T z."""
    feedback = [[-entry for entry in row] for row in product(at.K, T)]
    moved = ring.product([*T, *feedback], ring.variables[: len(T)])
    return [p + c for p, c in zip(moved, [*at.x, *at.u], strict=True)]
