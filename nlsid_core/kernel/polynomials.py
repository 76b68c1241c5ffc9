"""Exact polynomials in s and x: dictionaries of packed integers over one denominator.

A monomial of x is one integer, its key: six bits an exponent, the total degree being tracked and
kept below 64, so that exponents never run into each other. Above them a key has a secret that is
linear in the exponents, so that no file can choose keys whose hashes are equal. A coefficient is a
polynomial in s, packed into one integer by s = 2^width (Kronecker substitution). `norm` bounds the
sum of the absolute values of all its integers, and below 2^(width - 1) the packing can be undone:
`coefficients` refuses to otherwise, and `at_width` tries a larger width.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from itertools import pairwise
from math import comb, lcm
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


@dataclass(frozen=True)
class Polynomial:
    """Σ terms[monomial] / denominator; degree in x, order in s, norm: upper bounds."""

    ring: "Ring"
    terms: dict[int, int]
    denominator: int
    degree: int
    order: int
    norm: int

    def __add__(self, other: Scalar) -> "Polynomial":
        return self.ring.weighted([(1, self), (1, self.ring.made(other))])

    def __sub__(self, other: Scalar) -> "Polynomial":
        return self.ring.weighted([(1, self), (-1, self.ring.made(other))])

    def __rsub__(self, other: Scalar) -> "Polynomial":
        return self.ring.weighted([(-1, self), (1, self.ring.made(other))])

    def __mul__(self, other: Scalar) -> "Polynomial":
        if isinstance(other, Polynomial):
            return self.ring.times(self, other)
        return self.ring.weighted([(other, self)])

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
        return value if isinstance(value, Polynomial) else self.bernstein([Fraction(value)])

    def bernstein(self, points: Sequence[Fraction], level: int = 0, index: int = 0) -> Polynomial:
        """Σ_j B_j(r) points[j] with r = (index + s) / 2^level."""
        d = len(points) - 1
        common = lcm(*(point.denominator for point in points))
        row = [point.numerator * (common // point.denominator) for point in points]
        whole = [0] * (d + 1)
        for k in range(d + 1):  # row[0] C(d, k) multiplies r^k, here times 2^(level d)
            power = comb(d, k) * row[0] << level * (d - k)
            for j in range(k + 1):
                whole[j] += power * comb(k, j) * index ** (k - j)
            row = [after - before for before, after in pairwise(row)]
        packed = sum(c << (self.width * k) for k, c in enumerate(whole))
        terms = {0: packed} if packed else {}
        return Polynomial(self, terms, common << level * d, 0, d, sum(map(abs, whole)))

    def weighted(self, parts: Sequence[tuple[Fraction | int, Polynomial]]) -> Polynomial:
        """Σ weight part."""
        common = lcm(*(p.denominator * weight.denominator for weight, p in parts))
        terms: dict[int, int] = {}
        norm = degree = order = 0
        for weight, p in parts:
            factor = weight.numerator * (common // (p.denominator * weight.denominator))
            if factor:
                norm += abs(factor) * p.norm
                degree, order = max(degree, p.degree), max(order, p.order)
                for key, value in p.terms.items():
                    terms[key] = terms.get(key, 0) + value * factor
        return Polynomial(self, terms, common, degree, order, norm)

    def sum(self, parts: Sequence[Polynomial]) -> Polynomial:
        """The sum of the parts."""
        return self.weighted([(1, p) for p in parts])

    def dot(self, a: Sequence[Scalar], b: Sequence[Polynomial]) -> Polynomial:
        """Σ_i a[i] b[i]."""
        pairs = [(p, q) for p, q in zip(a, b, strict=True) if p]
        return self.weighted(
            [(1, p * q) if isinstance(p, Polynomial) else (p, q) for p, q in pairs]
        )

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

        return lambda p: self.weighted([(c, power(bytes(e))) for e, c in p])

    def substituted(self, ps: Sequence[Terms], values: Sequence[Polynomial]) -> list[Polynomial]:
        """Each of ps with a polynomial in the place of each variable."""
        return list(map(self.substitution(values), ps))

    def times(self, p: Polynomial, q: Polynomial) -> Polynomial:
        """p q."""
        degree, norm = p.degree + q.degree, p.norm * q.norm
        if degree > MAX_DEGREE or norm.bit_length() > MAX_WIDTH:
            raise Rejected(f"a product beyond degree {MAX_DEGREE} or too long", "too_large")
        terms: dict[int, int] = {}
        for left, a in p.terms.items():
            for right, b in q.terms.items():
                key = left + right
                terms[key] = terms.get(key, 0) + a * b
            if len(terms) > MAX_TERMS:
                raise Rejected(f"a polynomial of more than {MAX_TERMS} terms", "too_large")
        denominator = p.denominator * q.denominator
        return Polynomial(self, terms, denominator, degree, p.order + q.order, norm)

    def coefficients(self, p: Polynomial, cut: int = 0) -> dict[int, list[int]]:
        """Each monomial's whole coefficients of s^0 … s^order, over p.denominator.

        cut: bytes that are cut off each, which rounds down.
        """
        needed = p.norm.bit_length() + 1
        if needed > self.width:
            raise TooNarrow(-(-needed // STEP) * STEP)
        size, count = self.width // 8, p.order + 1
        return {
            key: unpacked(value, size, count, cut=cut) for key, value in p.terms.items() if value
        }


def packed(row: Sequence[int], width: int) -> int:
    """Σ_k row[k] 256^(width k): lanes of `width` bytes, signed."""
    half = 1 << (8 * width - 1)
    lanes = b"".join([(entry + half).to_bytes(width, "little") for entry in row])
    return int.from_bytes(lanes, "little") - _halves(width, len(row))


def unpacked(line: int, width: int, count: int, first: int = 0, cut: int = 0) -> list[int]:
    """The row of `packed` from `first` on, without `cut` bytes of each entry.

    Every entry has to be below half of its lane.
    """
    half = 1 << (8 * (width - cut) - 1)
    lanes = (line + _halves(width, count)).to_bytes(width * count, "little")
    starts = range(width * first, width * count, width)
    return [int.from_bytes(lanes[i + cut : i + width], "little") - half for i in starts]


@lru_cache(maxsize=64)
def _halves(width: int, count: int) -> int:
    """Half of the range of each of `count` lanes of `width` bytes."""
    return int.from_bytes((bytes(width - 1) + b"\x80") * count, "little")


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
