"""Exact polynomials in s and x: dictionaries of packed integers over one denominator.

A monomial of x is one integer, six bits an exponent; the total degree is tracked and kept below 64,
so exponents never run into each other. A coefficient is a polynomial in s, packed into one integer
by s = 2^width (Kronecker substitution). `norm` bounds the sum of the absolute values of all its
integers, and below 2^(width - 1) the packing can be undone: `digits` refuses to otherwise, and
`at_width` tries a larger width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache, lru_cache
from itertools import pairwise
from math import comb, lcm
from typing import TypeVar, Union

from .files import MAX_DEGREE, Rejected, Terms

BITS = 6  # of an exponent: 2^BITS - 1 is MAX_DEGREE, of all exponents together
MAX_WORK = 10**8  # products of short coefficients in one claim: half a minute
MAX_TERMS = 10**6  # of one polynomial: a few hundred MB
MAX_HELD = 2**31  # bytes of the results of one ring, about
TERM = 128  # bytes of a term without its digits
LONG = 18  # a product of integers whose bits multiply to 2^18 counts twice
CALL = 16  # products that a sum or a product of polynomials counts at the least
WIDTHS = (64, 128, 192, 256, 384, 512, 768, 1024, 2048, 4096, 16384)

MOST_WORK = 4 * 10**7  # the same of a claim without pieces: seconds
FREE_OF_S = 1024  # a width for polynomials in x alone: nothing is packed, so it costs nothing

Scalar = Union["Polynomial", Fraction, int]
Built = TypeVar("Built")


class TooNarrow(Exception):  # noqa: N818 - a signal to try again
    """The width of a ring does not hold a result."""


@dataclass
class Work:
    """How many products of coefficients a claim may still take; the width of its last ring."""

    left: int = MAX_WORK
    width: int = WIDTHS[0]

    def spend(self, amount: int, what: str = "") -> None:
        """Raise Rejected when it is used up."""
        self.left -= amount
        if self.left < 0:
            raise Rejected(what or "the claim takes more products to decide than are spent on one")


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


@dataclass(frozen=True)
class Ring:
    """Polynomials in s and in x0 … x(count - 1), packed at one width."""

    count: int
    width: int
    work: Work
    held: list[int] = field(default_factory=lambda: [0], compare=False)

    @property
    def variables(self) -> list[Polynomial]:
        """x0 … x(count - 1)."""
        return [Polynomial(self, {1 << (BITS * i): 1}, 1, 1, 0, 1) for i in range(self.count)]

    def key(self, exponents: Sequence[int]) -> int:
        """The integer that stands for a monomial of x."""
        if len(exponents) != self.count or min(exponents, default=0) < 0:
            raise Rejected(f"a monomial should have {self.count} exponents of 0 or more")
        if sum(exponents) > MAX_DEGREE:
            raise Rejected(f"degree {sum(exponents)} is above {MAX_DEGREE}")
        return sum(e << (BITS * i) for i, e in enumerate(exponents))

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
                self.work.spend(len(p.terms) * long(self.bits(p), factor.bit_length()))
                for key, value in p.terms.items():
                    terms[key] = terms.get(key, 0) + value * factor
        self.work.spend(CALL + len(parts))
        self._hold(len(terms), self.width * order + norm.bit_length())
        return Polynomial(self, terms, common, degree, order, norm)

    def sum(self, parts: Sequence[Polynomial]) -> Polynomial:
        """The sum of the parts."""
        return self.weighted([(1, p) for p in parts])

    def dot(self, a: Sequence[Scalar], b: Sequence[Polynomial]) -> Polynomial:
        """Σ_i a[i] b[i]."""
        return self.weighted(
            [
                (1, p * q) if isinstance(p, Polynomial) else (p, q)
                for p, q in zip(a, b, strict=True)
                if p
            ]
        )

    def product(self, M: Sequence[Sequence[Scalar]], p: Sequence[Polynomial]) -> list[Polynomial]:
        """M p."""
        return [self.dot(row, p) for row in M]

    def form(self, M: Sequence[Sequence[Scalar]], y: Sequence[Polynomial]) -> Polynomial:
        """y'M y."""
        return self.dot(y, self.product(M, y))

    def substituted(self, ps: Sequence[Terms], values: Sequence[Polynomial]) -> list[Polynomial]:
        """Each of ps with a polynomial in the place of each variable."""

        @cache
        def power(exponents: tuple[int, ...]) -> Polynomial:
            last = max((j for j, e in enumerate(exponents) if e), default=None)
            if last is None:
                return self.made(1)
            lower = (*exponents[:last], exponents[last] - 1, *exponents[last + 1 :])
            return values[last] * power(lower)

        return [self.weighted([(c, power(e)) for e, c in p]) for p in ps]

    def times(self, p: Polynomial, q: Polynomial) -> Polynomial:
        """p q."""
        degree = p.degree + q.degree
        if degree > MAX_DEGREE:
            raise Rejected(f"degree {degree} is above {MAX_DEGREE}")
        norm = p.norm * q.norm
        if norm.bit_length() > WIDTHS[-1]:
            raise Rejected(f"coefficients of more than {WIDTHS[-1]} bits")
        bits = self.bits(p), self.bits(q)
        self.work.spend(CALL + len(p.terms) * len(q.terms) * long(*bits))
        most = min(MAX_TERMS, (MAX_HELD - self.held[0]) // (TERM + sum(bits) // 7))
        terms: dict[int, int] = {}
        for left, a in p.terms.items():
            for right, b in q.terms.items():
                key = left + right
                terms[key] = terms.get(key, 0) + a * b
            if len(terms) > most:
                raise Rejected(f"a polynomial of more than {most} terms")
        self._hold(len(terms), sum(bits))
        return Polynomial(
            self, terms, p.denominator * q.denominator, degree, p.order + q.order, norm
        )

    def bits(self, p: Polynomial) -> int:
        """How long its packed coefficients are at most."""
        return self.width * p.order + p.norm.bit_length()

    def _hold(self, terms: int, bits: int) -> None:
        self.held[0] += terms * (TERM + bits // 7)
        if self.held[0] > MAX_HELD or terms > MAX_TERMS:
            raise Rejected("the claim takes too much memory to decide")

    def digits(self, p: Polynomial) -> dict[int, bytes]:
        """Each monomial's whole coefficients of s^0 … s^order, over p.denominator.

        width / 8 bytes each, the lowest first, with half of the range added.
        """
        if p.norm >> (self.width - 1):
            raise TooNarrow
        size = self.width // 8
        halves = _halves(size, p.order + 1)
        return {
            key: (value + halves).to_bytes(size * (p.order + 1), "little")
            for key, value in p.terms.items()
            if value
        }


def long(a: int, b: int) -> int:
    """How many products of short integers one of a and b bits counts as."""
    return 1 + ((a + 64) * (b + 64) >> LONG)


def packed(row: Sequence[int], width: int) -> int:
    """Σ_k row[k] 256^(width k): lanes of `width` bytes, signed."""
    half = 1 << (8 * width - 1)
    lanes = b"".join([(entry + half).to_bytes(width, "little") for entry in row])
    return int.from_bytes(lanes, "little") - _halves(width, len(row))


def unpacked(line: int, width: int, count: int, first: int = 0) -> list[int]:
    """The row of `packed` from `first` on, if every entry is below half of its lane."""
    half = 1 << (8 * width - 1)
    lanes = (line + _halves(width, count)).to_bytes(width * count, "little")
    starts = range(width * first, width * count, width)
    return [int.from_bytes(lanes[i : i + width], "little") - half for i in starts]


@lru_cache(maxsize=64)
def _halves(width: int, count: int) -> int:
    """Half of the range of each of `count` lanes of `width` bytes."""
    return int.from_bytes((bytes(width - 1) + b"\x80") * count, "little")


def at_width(count: int, work: Work, build: Callable[[Ring], Built]) -> Built:
    """What `build` returns in the narrowest of WIDTHS, from the work's on, that holds it."""
    for width in WIDTHS:
        if width >= work.width:
            try:
                result = build(Ring(count, width, work))
            except TooNarrow:
                continue
            work.width = width
            return result
    raise Rejected(f"coefficients of more than {WIDTHS[-1]} bits")
