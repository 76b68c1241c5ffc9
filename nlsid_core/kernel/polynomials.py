"""Exact polynomials in s and x: dictionaries of packed integers over one denominator.

A monomial of x is one integer, its key: six bits an exponent, the total degree being tracked and
kept below 64, so that exponents never run into each other. Above them a key has a secret that is
linear in the exponents, so that no file can choose keys whose hashes are equal. A coefficient is a
polynomial in s, packed into one integer by s = 2^width (Kronecker substitution). `norm` bounds the
sum of the absolute values of all its integers, and below 2^(width - 1) the packing can be undone:
`coefficients` refuses to otherwise, and `at_width` tries a larger width.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from math import comb, lcm
from operator import mul
from secrets import randbits
from typing import TypeVar, Union

from .files import MAX_DEGREE, Rejected, Terms, limit

BITS = 6  # of an exponent: 2^BITS - 1 is MAX_DEGREE, of all exponents together
SECRET = 61  # bits of a variable's secret: Python's hash of a whole number is modulo 2^61 - 1
MAX_TERMS = 10**6  # of one polynomial
STEP, MAX_WIDTH = 64, 16384  # bits of a width: a multiple of the first

Scalar = Union["Polynomial", Fraction, int]
Case = TypeVar("Case")


class TooNarrow(Exception):  # noqa: N818 - a signal to try again
    """The width of a ring does not hold a result; its argument is the width that does."""


@dataclass(eq=False)
class Polynomial:
    """Σ terms[monomial] / denominator; degree in x, order in s, norm: upper bounds."""

    ring: "Ring"
    terms: dict[int, int]
    denominator: int
    degree: int
    order: int
    norm: int

    def __add__(self, other: Scalar) -> "Polynomial":
        return self.ring.sum([self, self.ring.made(other)])

    def __sub__(self, other: Scalar) -> "Polynomial":
        return self.ring.dot([1, -1], [self, self.ring.made(other)])

    def __rsub__(self, other: Scalar) -> "Polynomial":
        return self.ring.dot([-1, 1], [self, self.ring.made(other)])

    def __mul__(self, other: Scalar) -> "Polynomial":
        return self.ring.dot([other], [self])

    __rmul__ = __mul__


@dataclass(frozen=True, eq=False)
class Ring:
    """Polynomials in s and in x0 … x(count - 1), packed at one width, with keys of its own."""

    count: int
    width: int

    @cached_property
    def keys(self) -> list[int]:
        """The key of each variable."""
        high = BITS * self.count
        return [(1 << BITS * i) + (randbits(SECRET) << high) for i in range(self.count)]

    @property
    def variables(self) -> list[Polynomial]:
        """x0 … x(count - 1)."""
        return [Polynomial(self, {key: 1}, 1, 1, 0, 1) for key in self.keys]

    def key(self, exponents: Sequence[int]) -> int:
        """The integer that stands for a monomial of x."""
        return sum(e * key for e, key in zip(exponents, self.keys, strict=True) if e)

    def exponents(self, key: int) -> tuple[int, ...]:
        """The exponents of the monomial that `key` stands for."""
        return tuple((key >> (BITS * i)) & MAX_DEGREE for i in range(self.count))

    def monomial(self, exponents: Sequence[int]) -> Polynomial:
        """x^exponents."""
        return Polynomial(self, {self.key(exponents): 1}, 1, sum(exponents), 0, 1)

    def made(self, value: Scalar) -> Polynomial:
        """A polynomial, or a number as one."""
        if isinstance(value, Polynomial):
            return value
        whole, denominator = value.as_integer_ratio()
        return Polynomial(self, {0: whole} if whole else {}, denominator, 0, 0, abs(whole))

    def bernstein(self, points: Sequence[Fraction], level: int = 0, index: int = 0) -> Polynomial:
        """Σ_j B_j(r) points[j] with r = (index + s) / 2^level."""
        common = lcm(*(point.denominator for point in points))
        weights = [point.numerator * (common // point.denominator) for point in points]
        d = len(points) - 1
        basis, norms = _bernstein(d, level, index, self.width)
        packed, norm = sum(map(mul, weights, basis)), sum(map(mul, map(abs, weights), norms))
        return Polynomial(self, {0: packed} if packed else {}, common << level * d, 0, d, norm)

    def derivative(self, p: Polynomial) -> Polynomial:
        """dp/ds."""
        terms = {
            key: sum(i * c << self.width * (i - 1) for i, c in enumerate(row) if i)
            for key, row in self.coefficients(p)
        }
        return replace(p, terms=terms, order=max(0, p.order - 1), norm=p.order * p.norm)

    def sum(self, parts: Sequence[Polynomial]) -> Polynomial:
        """The sum of the parts."""
        return self.dot([1] * len(parts), parts)

    def dot(self, a: Sequence[Scalar], b: Sequence[Polynomial]) -> Polynomial:
        """Σ_i a[i] b[i]; numbers that are 0 leave no trace."""
        pairs = [(self.made(p), q) for p, q in zip(a, b, strict=True) if p]
        common = lcm(*[p.denominator * q.denominator for p, q in pairs])
        terms: dict[int, int] = {}
        degree = order = norm = 0
        for p, q in pairs:
            factor = common // (p.denominator * q.denominator)
            degree, order = max(degree, p.degree + q.degree), max(order, p.order + q.order)
            norm += factor * p.norm * q.norm
            if degree > MAX_DEGREE or norm.bit_length() > MAX_WIDTH:
                raise Rejected(f"a product beyond degree {MAX_DEGREE} or too long", "too_large")
            for left, value in p.terms.items():
                weight = factor * value
                for right, entry in q.terms.items():
                    key = left + right
                    terms[key] = terms.get(key, 0) + weight * entry
                if len(terms) > MAX_TERMS:
                    raise Rejected(f"a polynomial of more than {MAX_TERMS} terms", "too_large")
        return Polynomial(self, terms, common, degree, order, norm)

    def product(self, M: Sequence[Sequence[Scalar]], p: Sequence[Polynomial]) -> list[Polynomial]:
        """M p."""
        return [self.dot(row, p) for row in M]

    def form(self, M: Sequence[Sequence[Scalar]], y: Sequence[Polynomial]) -> Polynomial:
        """y'M y."""
        return self.dot(y, self.product(M, y))

    def substitution(self, values: Sequence[Polynomial]) -> Callable[[Terms], Polynomial]:
        """What puts a polynomial in the place of each variable; powers are made once."""
        powers: dict[bytes, Polynomial] = {bytes(len(values)): self.made(1)}

        def power(exponents: bytes) -> Polynomial:
            if exponents not in powers:
                last = max(j for j, e in enumerate(exponents) if e)
                lower = bytes([*exponents[:last], exponents[last] - 1, *exponents[last + 1 :]])
                powers[exponents] = values[last] * power(lower)
            return powers[exponents]

        return lambda p: self.dot([c for _, c in p], [power(bytes(e)) for e, _ in p])

    def substituted(self, ps: Sequence[Terms], values: Sequence[Polynomial]) -> list[Polynomial]:
        """Each of ps with a polynomial in the place of each variable."""
        return list(map(self.substitution(values), ps))

    def coefficients(self, p: Polynomial) -> Iterator[tuple[int, list[int]]]:
        """Each monomial, and its whole coefficients of s^0, s^1 … over p.denominator.

        They go on to the last that is not 0.
        """
        if p.norm.bit_length() >= self.width:
            raise TooNarrow((p.norm.bit_length() // STEP + 1) * STEP)
        half = 1 << self.width - 1
        mask = 2 * half - 1
        for key, value in p.terms.items():
            row = []
            while value:
                row.append(((value + half) & mask) - half)
                value = (value - row[-1]) >> self.width
            yield key, row

    def bernstein_coefficients(self, p: Polynomial, width: int) -> Iterator[tuple[int, int]]:
        """Each monomial, and Σ_k C(order, k) b_k 2^(width k), b_k of its Bernstein coefficients."""
        for key, row in self.coefficients(p):
            lanes = 0
            for i, coefficient in enumerate(row):  # of s^i (s + (1 - s))^(order - i)
                lanes += (lanes << width) + (coefficient << width * i)
            for _ in range(p.order + 1 - len(row)):
                lanes += lanes << width
            yield key, lanes


@lru_cache(maxsize=64)
def _bernstein(d: int, level: int, index: int, width: int) -> tuple[list[int], list[int]]:
    """2^(level d) B_j(r), r = (index + s) / 2^level, packed, and bounds of their norms."""
    r, top = index + (1 << width), 1 << level
    shares = [comb(d, j) for j in range(d + 1)]
    return (
        [share * r**j * (top - r) ** (d - j) for j, share in enumerate(shares)],
        [share * (index + 1) ** j * (top - index + 1) ** (d - j) for j, share in enumerate(shares)],
    )


def at_width(count: int, cases: Iterable[Case], decide: Callable[[Ring, Case], None]) -> None:
    """Decide each case in a ring of `count` variables, wider from the first that needs it on."""
    ring = Ring(count, STEP)
    for case in cases:
        while True:
            try:
                decide(ring, case)
                break
            except TooNarrow as found:
                (width,) = found.args
                ring = Ring(count, limit(width, MAX_WIDTH, "bits of a coefficient"))
