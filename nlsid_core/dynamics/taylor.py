"""Dynamics that are not polynomial: cubic Taylor models along a motion, with remainders bounded.

A Taylor model is a polynomial in d, x = c + r d, and a bound of what it leaves out for every
d in [-1, 1]^k: +, -, ·, /, sin and cos carry both along, rounding included.
Source: Makino and Berz, "Taylor models and other validated functional inclusion methods", 2003.
Assumes IEEE 754 double precision, and sin and cos right to a few units in the last place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import cos, frexp, inf, nextafter, sin
from typing import Any

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray
from nlsid_core.dynamics.vector_field import VectorField, variable_names
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.polynomial import Polynomial
from nlsid_core.polynomial.maps import monomials

DEGREE = 3  # what L-steps take
EXPANSION = (
    "cubic Taylor models with a remainder bounded in float64 arithmetic that counts every rounding "
    "and trusts sin and cos to a few units in the last place"
)
ROUNDING = 2.0**-50  # relative, of one operation on coefficients: 8 units, where 1 to 4 are made
SUMMED = 1 + 2.0**-40  # covers the roundings of a sum of bounds
GRID = 2.0**-12  # of the centres, so that powers of x - c have short exact coefficients
NEGLIGIBLE = 1e-12  # of a row's size: such coefficients go to its remainder


@dataclass(frozen=True, eq=False)
class TaylorModel:
    """Σ coefficients·d^exponents ± error; k: how many d. coefficients: (M,), degree 0 to 3."""

    k: int
    coefficients: FloatArray
    error: float

    @classmethod
    def variable(cls, k: int, j: int, centre: float, radius: float) -> "TaylorModel":
        """centre + radius·d_j, exact."""
        coefficients = np.zeros(len(_exponents(k)))
        coefficients[0] = centre
        coefficients[1 + _place_of_unit(k, j)] = radius
        return cls(k, coefficients, 0.0)

    @property
    def size(self) -> float:
        """A bound of its absolute value."""
        return (float(np.abs(self.coefficients).sum()) + self.error) * SUMMED

    def __add__(self, other: Any) -> "TaylorModel":
        if not isinstance(other, TaylorModel):
            if not _is_number(other):
                return NotImplemented
            shifted = self.coefficients.copy()
            shifted[0] += other
            lost = 0.0 if other == 0 else ROUNDING * abs(shifted[0])
            return self._made(shifted, self.error, lost)
        total = self.coefficients + other.coefficients
        both = (self.coefficients != 0) & (other.coefficients != 0)
        return self._made(total, self.error + other.error, ROUNDING * np.abs(total[both]).sum())

    def __mul__(self, other: Any) -> "TaylorModel":
        if not isinstance(other, TaylorModel):
            if not _is_number(other):
                return NotImplemented
            return self._scaled(float(other), _is_power_of_two(float(other)))
        table, kept = _products(self.k)
        outer = np.outer(self.coefficients, other.coefficients)
        weighted = np.bincount(table[kept], outer[kept], len(self.coefficients))
        total = weighted.astype(np.float64)
        size = np.abs(outer)
        error = self.error * other.size + other.error * self.size
        return self._made(
            total, error + float(size[~kept].sum()), len(total) * ROUNDING * float(size.sum())
        )

    def __truediv__(self, other: Any) -> "TaylorModel":
        if isinstance(other, TaylorModel):
            return self * other.reciprocal()
        return self._scaled(1 / float(other), _is_power_of_two(float(other)))

    def __rtruediv__(self, other: Any) -> "TaylorModel":
        return self.reciprocal().__mul__(other)

    def __neg__(self) -> "TaylorModel":
        return TaylorModel(self.k, -self.coefficients, self.error)

    def __sub__(self, other: Any) -> "TaylorModel":
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> "TaylorModel":
        return (-self).__add__(other)

    def __pow__(self, power: int) -> "TaylorModel":
        if power not in (2, 3):
            raise DataError(f"a Taylor model to the power {power}: 2 and 3 are known")
        return self * self if power == 2 else self * self * self

    __radd__ = __add__
    __rmul__ = __mul__

    def sin(self) -> "TaylorModel":
        """Its sine; np.sin calls this."""
        c = float(self.coefficients[0])
        return self._composed([sin(c), cos(c), -sin(c) / 2, -cos(c) / 6], abs(sin(c)), 1 / 24)

    def cos(self) -> "TaylorModel":
        """Its cosine; np.cos calls this."""
        c = float(self.coefficients[0])
        return self._composed([cos(c), -sin(c), -cos(c) / 2, sin(c) / 6], abs(cos(c)), 1 / 24)

    def reciprocal(self) -> "TaylorModel":
        """One over it. Raises DataError if it may be zero on the box."""
        c = float(self.coefficients[0])
        least = (abs(c) - (self.size - abs(c)) * SUMMED) / SUMMED
        if least <= 0:
            raise DataError(f"division by a value that may be zero in the box around {c:.3g}")
        series = [1 / c, -1 / c**2, 1 / c**3, -1 / c**4]
        return self._composed(series, inf, 0.0, fourth=1 / least**5)

    def _composed(
        self, series: list[float], value: float, weight: float, *, fourth: float | None = None
    ) -> "TaylorModel":
        """Σ series_i δ^i, δ = self - c, and what is left: its fourth power times `fourth`, which

        for sin and cos is weight·min(1, value + |δ|), the largest fourth derivative over 4!.
        """
        delta = self - float(self.coefficients[0])
        b = delta.size
        left = (weight * min(1.0, value + b) if fourth is None else fourth) * b**4
        result = delta * series[3] + series[2]
        for term in (series[1], series[0]):
            result = result * delta + term
        lost = ROUNDING * sum(abs(term) * b**i for i, term in enumerate(series))
        return TaylorModel(self.k, result.coefficients, (result.error + left + lost) * SUMMED)

    def _scaled(self, factor: float, exact: bool) -> "TaylorModel":
        scaled = factor * self.coefficients
        lost = 0.0 if exact else ROUNDING * float(np.abs(scaled).sum())
        return self._made(scaled, abs(factor) * self.error, lost)

    def _made(self, coefficients: FloatArray, error: float, lost: float) -> "TaylorModel":
        total = error + float(lost)
        return TaylorModel(self.k, coefficients, total * SUMMED)


def expand(
    rate: Callable[..., Any], centre: ArrayLike, radius: ArrayLike, *, states: int
) -> tuple[tuple[Polynomial, ...], FloatArray]:
    """Cubics in x0.., u0.. and (n,) bounds of |rate - cubic| wherever |(x, u) - centre| ≤ radius.

    rate: rate(x, u) with +, -, ·, /, np.sin and np.cos only. centre, radius: (n + m,); the centre
    is rounded to multiples of 2^-12 by the caller. Raises DataError if rate divides by what may be
    zero there, ShapeError if it does not return n rates.
    """
    centre, radius = (np.asarray(part, dtype=np.float64) for part in (centre, radius))
    k = len(centre)
    z = np.empty(k, dtype=object)
    z[:] = [TaylorModel.variable(k, j, centre[j], radius[j]) for j in range(k)]
    rows = list(rate(z[:states], z[states:]))
    if len(rows) != states:
        raise ShapeError(f"the rate has {len(rows)} entries for {states} states")
    names = variable_names(states, k - states, 0)
    done = [_in_states(row, k, centre, radius, names) for row in rows]
    return tuple(p for p, _ in done), np.array([bound for _, bound in done])


def taylor_field(
    rate: Callable[..., Any], t: ArrayLike, x: ArrayLike, u: ArrayLike, *, radius: ArrayLike
) -> VectorField:
    """rate(x, u) as a cubic per interval of a motion, and what it leaves out as bounded w.

    t: (K,) s; x: (K, n), u: (K, m) the motion there. radius: (n + m,) how far (x, u) may be from
    the motion's range on an interval: `valid` states those boxes, so a funnel is proved to stay in
    them. Every state whose rate is not an exact cubic has a w in [-1, 1], scaled to its bound.
    """
    t, x, u = (np.asarray(part, dtype=np.float64) for part in (t, x, u))
    n, m = x.shape[1], u.shape[1]
    z = np.hstack([x, u])
    centres = np.round((z[:-1] + z[1:]) / 2 / GRID) * GRID
    radii = np.asarray(radius, dtype=np.float64) + np.abs(np.diff(z, axis=0)) / 2 + GRID
    expanded = [expand(rate, c, r, states=n) for c, r in zip(centres, radii, strict=True)]
    bounds = np.array([bound for _, bound in expanded])
    rows = np.flatnonzero(bounds.any(axis=0)).tolist()
    names = ("t", *variable_names(n, m, len(rows)))
    pieces = []
    for cubics, bound in expanded:
        equations = [p.over(names) for p in cubics]
        for place, i in enumerate(rows):
            unit = np.zeros((1, len(names)), dtype=np.int64)
            unit[0, 1 + n + m + place] = 1
            equations[i] = equations[i] + Polynomial(unit, np.array([bound[i]]), names).exact()
        pieces.append(tuple(equations))
    valid = [
        (j, nextafter(centre[j] - reach[j], inf), nextafter(centre[j] + reach[j], -inf), span)
        for span, (centre, reach) in enumerate(zip(centres, radii, strict=True))
        for j in range(n + m)
    ]
    return VectorField(
        tuple(pieces), n, m, t[1:-1], np.tile([-1.0, 1.0], (len(rows), 1)), np.array(valid),
        EXPANSION if rows else "",
    )  # fmt: skip


def _in_states(
    row: Any, k: int, centre: FloatArray, radius: FloatArray, names: tuple[str, ...]
) -> tuple[Polynomial, float]:
    """The model's polynomial in (x, u) with exact coefficients, and the bound of the rest."""
    if not isinstance(row, TaylorModel):
        return Polynomial(np.zeros((1, k), int), np.array([float(row)]), names).exact(), 0.0
    exponents, left = _exponents(k), Fraction(row.error)
    total = Polynomial(np.zeros((0, k), int), np.zeros(0), names).exact()
    shifted = [
        Polynomial(np.vstack([np.eye(k, dtype=int)[j], np.zeros(k, int)]),
                   np.array([1.0, -centre[j]]), names).exact()
        for j in range(k)
    ]  # fmt: skip
    for exponent, value in zip(exponents.tolist(), row.coefficients.tolist(), strict=True):
        if abs(value) <= NEGLIGIBLE * row.size:
            left += abs(Fraction(value))
            continue
        scale = Fraction(1)
        for r, e in zip(radius.tolist(), exponent, strict=True):
            scale *= Fraction(r) ** e
        rounded = Fraction(float(Fraction(value) / scale))
        left += abs(rounded * scale - Fraction(value))
        term = Polynomial(np.zeros((1, k), int), np.array([float(rounded)]), names).exact()
        for j in np.repeat(np.arange(k), exponent).tolist():
            term = term * shifted[j]
        total = total + term
    return total, nextafter(float(left), inf) if left else 0.0


@lru_cache(maxsize=16)
def _exponents(k: int) -> IntArray:
    return monomials(k, range(DEGREE + 1))


@lru_cache(maxsize=64)
def _place_of_unit(k: int, j: int) -> int:
    return int(np.flatnonzero(monomials(k, [1])[:, j])[0])


@lru_cache(maxsize=16)
def _products(k: int) -> tuple[IntArray, Any]:
    """(M, M) the monomial of each product, and which of them have degree 3 at most."""
    rows = _exponents(k)
    sums = rows[:, None] + rows[None]
    kept = sums.sum(axis=-1) <= DEGREE
    places = {row.tobytes(): i for i, row in enumerate(rows)}
    table = np.zeros(kept.shape, dtype=np.int64)
    table[kept] = [places[row.tobytes()] for row in sums[kept]]
    return table, kept


def _is_power_of_two(value: float) -> bool:
    """True if a product with it, or its inverse, is exact; or if it is zero."""
    return abs(frexp(value)[0]) in (0.0, 0.5)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating))
