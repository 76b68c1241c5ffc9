"""Two arithmetics on arrays, one interface: `Exact` dyadic rationals, and `Ball`s that enclose.

A computation written once with +, -, * and `accumulate` is then carried out exactly in Python's
integers, or in floating point with a radius that bounds every rounding error made.
Source: Rump, "Verification methods", Acta Numerica 2010, for midpoint-radius arithmetic.
Assumes IEEE 754 double precision and rounding to nearest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import FloatArray
from nlsid_core.errors import Undecided

U = 2.0**-53  # unit roundoff
TINY = 2.0**-1070  # more than one underflow can lose
SLACK = 1 + 2.0**-48  # covers the roundings made in the radii: fewer than 16 each

Index: TypeAlias = Any


class Number(Protocol):
    """What both have; two numbers that meet are always of the same kind."""

    @classmethod
    def of(cls, array: FloatArray) -> "Number":
        """Floats, exactly."""

    @classmethod
    def rationals(cls, numbers: Sequence[Fraction], unit: int) -> "Number":
        """Rationals times `unit`."""

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> "Number":
        """Zeros of a shape."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""

    def __getitem__(self, index: Index) -> "Number": ...
    def __neg__(self) -> "Number": ...
    def __add__(self, other: Any) -> "Number": ...
    def __sub__(self, other: Any) -> "Number": ...
    def __mul__(self, other: Any) -> "Number": ...

    def accumulate(self, index: Index, other: Any) -> None:
        """self[index] += other; no position occurs twice in `index`."""

    def approximate(self) -> FloatArray:
        """Nearby floats."""


@dataclass(eq=False)
class Exact:
    """values · 2^-bits: Python integers in an object array."""

    values: NDArray[Any]
    bits: int

    @classmethod
    def of(cls, array: FloatArray) -> "Exact":
        """Floats as the rationals they are."""
        array = np.asarray(array, dtype=np.float64)
        mantissa, exponent = np.frexp(array)
        used = exponent[array != 0]
        bits = max(53 - int(used.min()), 0) if used.size else 0
        whole = [
            int(m) << (e + bits - 53) if m else 0
            for m, e in zip((mantissa * 2.0**53).ravel().tolist(), exponent.ravel().tolist(),
                            strict=True)
        ]  # fmt: skip
        values = np.empty(array.size, dtype=object)
        values[:] = whole
        return cls(values.reshape(array.shape), bits)

    @classmethod
    def rationals(cls, numbers: Sequence[Fraction], unit: int) -> "Exact":
        """Rationals times `unit`, which makes every denominator a power of two."""
        scaled = [Fraction(number) * unit for number in numbers]
        bits = max((q.denominator.bit_length() - 1 for q in scaled), default=0)
        values = np.empty(len(scaled), dtype=object)
        values[:] = [q.numerator << (bits - q.denominator.bit_length() + 1) for q in scaled]
        return cls(values, bits)

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> "Exact":
        """Zeros of a shape."""
        values = np.empty(shape, dtype=object)
        values.fill(0)
        return cls(values, 0)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.values.shape

    def __getitem__(self, index: Index) -> "Exact":
        return Exact(self.values[index], self.bits)

    def __neg__(self) -> "Exact":
        return Exact(-self.values, self.bits)

    def __add__(self, other: "Exact") -> "Exact":
        bits = max(self.bits, other.bits)
        return Exact(self._shifted(bits) + other._shifted(bits), bits)

    def __sub__(self, other: "Exact") -> "Exact":
        return self + -other

    def __mul__(self, other: "Exact") -> "Exact":
        return Exact(self.values * other.values, self.bits + other.bits)

    def accumulate(self, index: Index, other: "Exact") -> None:
        """self[index] += other; no position occurs twice in `index`."""
        if other.bits > self.bits:
            self.values, self.bits = self._shifted(other.bits), other.bits
        self.values[index] += other._shifted(self.bits)

    def approximate(self) -> FloatArray:
        """Nearest floats, or nearly so."""
        scale = 1 << self.bits
        return np.array([v / scale for v in self.values.ravel().tolist()]).reshape(self.shape)

    def _shifted(self, bits: int) -> NDArray[Any]:
        return self.values << (bits - self.bits) if bits > self.bits else self.values


@dataclass(eq=False)
class Ball:
    """Every number in it is within `radius` of `middle`."""

    middle: FloatArray
    radius: FloatArray

    @classmethod
    def of(cls, array: FloatArray) -> "Ball":
        """Floats, exactly."""
        array = np.asarray(array, dtype=np.float64)
        return cls(array, np.zeros_like(array))

    @classmethod
    def rationals(cls, numbers: Sequence[Fraction], unit: int) -> "Ball":
        """Rationals times `unit`, each enclosed."""
        scaled = [Fraction(number) * unit for number in numbers]
        try:
            middle = np.array([float(q) for q in scaled])
        except OverflowError as error:
            raise Undecided("a rational overflows float64; the exact mode decides") from error
        exact = [Fraction(m) == q for m, q in zip(middle.tolist(), scaled, strict=True)]
        return cls(middle, np.where(exact, 0.0, 2 * U * np.abs(middle) + TINY))

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> "Ball":
        """Zeros of a shape."""
        return cls(np.zeros(shape), np.zeros(shape))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.middle.shape

    def __getitem__(self, index: Index) -> "Ball":
        return Ball(self.middle[index], self.radius[index])

    def __neg__(self) -> "Ball":
        return Ball(-self.middle, self.radius)

    def __add__(self, other: "Ball") -> "Ball":
        middle = self.middle + other.middle
        return Ball(middle, (self.radius + other.radius + U * np.abs(middle)) * SLACK)

    def __sub__(self, other: "Ball") -> "Ball":
        return self + -other

    def __mul__(self, other: "Ball") -> "Ball":
        middle = self.middle * other.middle
        size = np.abs(other.middle)
        # A product that is not zero may underflow; one with an exact zero is an exact zero.
        lost = TINY * (self._occupied() & other._occupied())
        radius = self.radius * (size + other.radius) + np.abs(self.middle) * other.radius
        return Ball(middle, (radius + U * np.abs(middle) + lost) * SLACK)

    def accumulate(self, index: Index, other: "Ball") -> None:
        """self[index] += other; no position occurs twice in `index`."""
        total = self[index] + other
        self.middle[index], self.radius[index] = total.middle, total.radius

    def approximate(self) -> FloatArray:
        """The middles."""
        return self.middle

    def _occupied(self) -> NDArray[np.bool_]:
        return np.asarray((self.middle != 0) | (self.radius != 0))


Arithmetic: TypeAlias = type[Number]
