"""`TaylorModel`: a cubic on a box and a bound of its error, carried through arithmetic.

For every d in [-1, 1]^k the value is within `error` of the cubic at d, rounding included.
Source: Makino and Berz, "Taylor models and other validated functional inclusion methods", 2003.
Assumes IEEE 754 double precision, and elementary functions right to a few units in the last place.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from math import atan2, cos, exp, frexp, pi, sin, sqrt, tan
from typing import Any

import numpy as np

from nlsid_core.arrays import BoolArray, FloatArray, IntArray, objects
from nlsid_core.errors import DataError

DEGREE = 3  # what L-steps take
BASE = 128  # of the digits that write a monomial: more than the variables of any box
ROUNDING = 2.0**-50  # relative, of one operation on coefficients: 8 units, where 1 to 4 are made
SUMMED = 1 + 2.0**-40  # covers the roundings of a sum of bounds
MAX_POWER = 64
CLEAR_OF_POLE = 1e-3  # rad; there the tangent is right to a SUMMED
MOST_FOURTH = {"tanh": 0.171, "arctan": 0.195}  # of |f⁗|/4! anywhere: their maxima, rounded up
CELLS = 256  # of a range, where the error of a cubic is looked at
GRID = np.linspace(-1.0, 1.0, CELLS + 1)
NODES = np.cos(np.pi * np.arange(1, 8, 2) / 8)  # Chebyshev's points, for a cubic
TO_POWERS = np.linalg.inv(np.vander(NODES, increasing=True))  # values there to coefficients
CANCELLED = 1e3  # Σ of the coefficients that change a cubic of a cubic into Chebyshev's and back
LEBESGUE = 64.0  # Σ|TO_POWERS| is 12.9: so much of the values' errors is in a cubic, with room


@dataclass(frozen=True, eq=False)
class TaylorModel:
    """Σ coefficients·d^keys ± error. keys: (M,) increasing, the first is 0, the constant.

    A key is three digits in BASE, the variables (1 is d_0) of a product, 0 for none, increasing.
    ridge: of a function of one form T of degree 1, |T| ≤ 1, that form and (4,) the cubic in it.
    """

    keys: IntArray
    coefficients: FloatArray
    error: float
    ridge: "tuple[TaylorModel, FloatArray] | None" = None

    @classmethod
    def variable(cls, j: int, centre: float, radius: float) -> "TaylorModel":
        """centre + radius·d_j, exact."""
        return cls(np.array([0, j + 1]), np.array([centre, radius]), 0.0)

    @property
    def centre(self) -> float:
        """The cubic at d = 0."""
        return float(self.coefficients[0])

    @property
    def size(self) -> float:
        """A bound of its absolute value."""
        return (float(np.abs(self.coefficients).sum()) + self.error) * SUMMED

    def __add__(self, other: Any) -> "TaylorModel":
        if not isinstance(other, TaylorModel):
            number = _number(other)
            if number is None:
                return NotImplemented
            shifted = self.coefficients.copy()
            shifted[0] += number
            lost = 0.0 if number == 0 else 2 * ROUNDING * (abs(shifted[0]) + abs(number))
            moved = self._made(self.keys, shifted, self.error, lost)
            return replace(moved, ridge=self._along(np.array([number, 0.0, 0.0, 0.0]), 1.0))
        keys, first, second = _union(self.keys.tobytes(), other.keys.tobytes())
        total = np.zeros(len(keys))
        total[first] = self.coefficients
        total[second] += other.coefficients
        lost = ROUNDING * float(np.abs(total).sum())
        return self._made(keys, total, self.error + other.error, lost)

    def __mul__(self, other: Any) -> "TaylorModel":
        if not isinstance(other, TaylorModel):
            number = _number(other)
            if number is None:
                return NotImplemented
            return self._scaled(number, _is_power_of_two(number))
        keys, home, kept = _products(self.keys.tobytes(), other.keys.tobytes())
        outer = np.multiply.outer(self.coefficients, other.coefficients).ravel()
        total = np.bincount(home, outer[kept], len(keys)).astype(np.float64)
        size = np.abs(outer)
        error = self.error * other.size + other.error * self.size
        lost = len(keys) * ROUNDING * float(size.sum())
        return self._made(keys, total, error + float(size[~kept].sum()), lost)

    def __truediv__(self, other: Any) -> "TaylorModel":
        if isinstance(other, TaylorModel):
            return self * other.reciprocal()
        number = _number(other)
        if number is None:
            return NotImplemented
        return self._scaled(1 / number, _is_power_of_two(number))

    def __rtruediv__(self, other: Any) -> "TaylorModel":
        return self.reciprocal().__mul__(other)

    def __neg__(self) -> "TaylorModel":
        turned = self._along(np.zeros(4), -1.0)
        return TaylorModel(self.keys, -self.coefficients, self.error, turned)

    def __pos__(self) -> "TaylorModel":
        return self

    def __sub__(self, other: Any) -> "TaylorModel":
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> "TaylorModel":
        return (-self).__add__(other)

    def __pow__(self, power: Any) -> "TaylorModel":
        number = None if isinstance(power, TaylorModel) else _number(power)
        if number in (0.5, -0.5):
            root = self.sqrt()
            return root if number == 0.5 else root.reciprocal()
        if number is None or not number.is_integer() or abs(number) > MAX_POWER:
            raise TypeError(f"power {power!r}: whole numbers up to {MAX_POWER} and 0.5 are known")
        square, left = (self if number >= 0 else self.reciprocal()), int(abs(number))
        result: TaylorModel | None = None
        while left:
            if left & 1:
                result = square if result is None else result * square
            left >>= 1
            square = square * square if left else square
        return self * 0.0 + 1.0 if result is None else result

    __radd__ = __add__
    __rmul__ = __mul__

    def __eq__(self, other: object) -> bool:
        raise TypeError("a comparison: which branch holds is not known on a whole box")

    __lt__ = __le__ = __gt__ = __ge__ = __ne__ = __eq__
    __hash__ = None  # type: ignore[assignment]

    def __bool__(self) -> bool:
        raise TypeError("a truth value: it is not known on a whole box")

    # NumPy calls these by name on the entries of an object array: np.sin becomes .sin().

    def sin(self) -> "TaylorModel":
        """Its sine."""
        c, b = self._around()
        return self._composed(np.sin, min(1.0, abs(sin(c)) + b) / 24)

    def cos(self) -> "TaylorModel":
        """Its cosine."""
        c, b = self._around()
        return self._composed(np.cos, min(1.0, abs(cos(c)) + b) / 24)

    def tan(self) -> "TaylorModel":
        """Its tangent. Raises DataError if the box reaches a pole."""
        c, b = self._around()
        from_pole = pi / 2 - abs((c + pi / 2) % pi - pi / 2)
        if b * SUMMED >= from_pole - CLEAR_OF_POLE:
            raise DataError(f"the tangent of a value that may be at a pole, {c:.3g} ± {b:.3g}")
        most = tan(pi / 2 - from_pole + b) * SUMMED
        return self._composed(np.tan, most * (1 + most**2) * (2 + 3 * most**2) / 3)

    def exp(self) -> "TaylorModel":
        """Its exponential."""
        c, b = self._around()
        return self._composed(np.exp, exp(c + b) / 24)

    def log(self) -> "TaylorModel":
        """Its natural logarithm. Raises DataError unless it is positive on the box."""
        return self._composed(np.log, 1 / (4 * self._positive("the logarithm of") ** 4))

    def sqrt(self) -> "TaylorModel":
        """Its root. Raises DataError unless it is positive on the box."""
        least = self._positive("the root of")
        return self._composed(np.sqrt, 5 / 128 / (sqrt(least) * least**3))

    def tanh(self) -> "TaylorModel":
        """Its hyperbolic tangent."""
        return self._composed(np.tanh, MOST_FOURTH["tanh"])

    def arctan(self) -> "TaylorModel":
        """Its arc tangent."""
        return self._composed(np.arctan, MOST_FOURTH["arctan"])

    def arctan2(self, other: Any) -> "TaylorModel":
        """The angle of (other, self). Raises DataError if the box reaches zero or the cut at π."""
        x = other if isinstance(other, TaylorModel) else self * 0.0 + other
        return _angle(self, x)

    def __abs__(self) -> "TaylorModel":
        c, b = self._around()
        if abs(c) >= b:
            return self if c >= 0 else -self
        most = self.size  # |s| is between s²/most and s²/most + most/4
        middle = self * self * (1 / most) + most / 8
        return self._made(middle.keys, middle.coefficients, middle.error, most / 8 * SUMMED)

    fabs = absolute = __abs__

    def square(self) -> "TaylorModel":
        """Its square."""
        return self * self

    def reciprocal(self) -> "TaylorModel":
        """One over it. Raises DataError if it may be zero on the box."""
        if self._around()[0] < 0:
            return -((-self).reciprocal())
        least = self._positive("division by", "may be zero")
        return self._composed(np.reciprocal, 1 / least**5)

    def _positive(self, what: str, otherwise: str = "may not be positive") -> float:
        """A positive lower bound, or DataError."""
        c, b = self._around()
        least = (c - b * SUMMED) / SUMMED
        if least <= 0:
            raise DataError(f"{what} a value that {otherwise} in the box around {c:.3g}")
        return least

    def _spread(self) -> float:
        """A bound of how far from its centre it is."""
        return (float(np.abs(self.coefficients[1:]).sum()) + self.error) * SUMMED

    def _around(self) -> tuple[float, float]:
        """c, b with all its values within b of c: where squares have a sign, c is not its centre.

        pd + qd² is between its values at d = ±1, and -p²/4q where |p| < 2|q|.
        """
        if self.ridge is not None:
            a = self.ridge[1]
            values = np.polynomial.polynomial.polyval(GRID, a)
            middle, half = float(values.max() + values.min()) / 2, float(np.ptp(values)) / 2
            over = float(abs(a[2]) + 3 * abs(a[3])) / CELLS**2 + ROUNDING * float(np.abs(a).sum())
            return middle, (half + over + self.error) * SUMMED
        squares, lines, others = _alone(self.keys.tobytes())
        q = self.coefficients[squares]
        if not q.any():
            return self.centre, self._spread()
        p = np.where(lines > 0, np.abs(self.coefficients[lines]), 0.0)
        inside = p < 2 * np.abs(q)
        vertex = np.divide(-(p**2), 4 * q, out=np.zeros_like(q), where=inside)
        low = np.where(inside & (q > 0), vertex, q - p)
        high = np.where(inside & (q < 0), vertex, q + p)
        c = self.centre + float((low + high).sum()) / 2
        rest = float((high - low).sum()) / 2 + float(np.abs(self.coefficients[others]).sum())
        return c, (rest + self.error) * SUMMED + (SUMMED - 1) * self.size

    def _composed(
        self, function: Callable[[FloatArray], FloatArray], fourth: float
    ) -> "TaylorModel":
        """function(self), whose fourth derivative is 24 `fourth` at most on all its values.

        A cubic p interpolates it at Chebyshev's points of [c - b, c + b]. The error e has four
        zeros, so |e'| ≤ 32 fourth b³ and |e''| ≤ 48 fourth b²; between two of CELLS + 1 points it
        is then at most 6 fourth b²h² above the larger of its values there, h = 2b/CELLS. Of a
        ridge, p is a polynomial in one form: what is above degree 3 is left out in Chebyshev's.
        """
        c, b = self._around()
        if b == 0:
            value = function(np.array([c]))
            return TaylorModel(np.array([0]), value, ROUNDING * float(np.abs(value)[0]))
        nodes, grid = function(c + b * NODES), function(c + b * GRID)
        a = TO_POWERS @ nodes
        gaps = np.abs(grid - np.polynomial.polynomial.polyval(GRID, a))
        between = 24 * fourth * b**4 / CELLS**2
        # Rounding: of the values, and of the points, which moves values by the slope.
        size = float(np.abs(grid).max())
        slope = float(np.abs(a) @ range(4))
        moved = (abs(c) / b + 1) * (slope + 32 * fourth * b**4)
        lost = ROUNDING * (LEBESGUE * size + moved)
        within = float(gaps.max()) + between + lost
        ridge = self._as_ridge()
        if ridge is None:
            delta = (self + -c) * (1 / b)
            found = ((delta * a[3] + a[2]) * delta + a[1]) * delta + a[0]
            return TaylorModel(found.keys, found.coefficients, (found.error + within) * SUMMED)
        form, inner = ridge
        inner = (inner - [c, 0, 0, 0]) / b
        outer = np.polynomial.Polynomial(a)(np.polynomial.Polynomial(inner))
        series = np.polynomial.chebyshev.poly2cheb(outer.coef)
        low = np.polynomial.chebyshev.cheb2poly(series[:4])
        kept: FloatArray = np.zeros(4)
        kept[: len(low)] = low
        within += float(np.abs(series[4:]).sum()) + slope * self.error / b
        within += CANCELLED * ROUNDING * float(np.abs(a) @ np.abs(inner).sum() ** np.arange(4))
        found = ((form * kept[3] + kept[2]) * form + kept[1]) * form + kept[0]
        error = (found.error + within) * SUMMED
        return TaylorModel(found.keys, found.coefficients, error, (form, kept))

    def _scaled(self, factor: float, exact: bool) -> "TaylorModel":
        scaled = factor * self.coefficients
        lost = 0.0 if exact else 2 * ROUNDING * float(np.abs(scaled).sum())
        made = self._made(self.keys, scaled, abs(factor) * self.error, lost)
        return replace(made, ridge=self._along(np.zeros(4), factor))

    def _along(self, shift: FloatArray, factor: float) -> "tuple[TaylorModel, FloatArray] | None":
        """The ridge of shift + factor·self."""
        return None if self.ridge is None else (self.ridge[0], factor * self.ridge[1] + shift)

    def _as_ridge(self) -> "tuple[TaylorModel, FloatArray] | None":
        """Its ridge; a form of degree 1 is one of itself."""
        if self.ridge is not None or self.keys[-1] >= BASE or len(self.keys) < 2:
            return self.ridge
        size = float(np.abs(self.coefficients[1:]).sum()) * SUMMED
        if size == 0:
            return None
        form = TaylorModel(self.keys, np.r_[0.0, self.coefficients[1:] / size], 0.0)
        return form, np.array([self.centre, size, 0.0, 0.0])

    def _made(
        self, keys: IntArray, coefficients: FloatArray, error: float, lost: float
    ) -> "TaylorModel":
        return TaylorModel(keys, coefficients, (error + float(lost)) * SUMMED)


def solve(A: Any, b: Any) -> Any:
    """x with Ax = b by elimination: what dynamics with a mass matrix write for np.linalg.solve.

    A: (n, n), b: (n,), of numbers, of arrays that hold one system per entry, or of Taylor models.
    Returns an array (n,) of the same kind. Rows are exchanged where entries are not arrays.
    """
    rows = [[*row, right] for row, right in zip(A, b, strict=True)]
    n = len(rows)
    for j in range(n):
        best = max(range(j, n), key=lambda i: (_magnitude(rows[i][j]), -i))
        rows[j], rows[best] = rows[best], rows[j]
        for i in range(j + 1, n):
            factor = rows[i][j] / rows[j][j]
            rows[i] = [p - factor * q for p, q in zip(rows[i], rows[j], strict=True)]
    found: list[Any] = [0.0] * n
    for j in reversed(range(n)):
        rest = rows[j][n]
        for i in range(j + 1, n):
            rest = rest - rows[j][i] * found[i]
        found[j] = rest / rows[j][j]
    if any(isinstance(entry, (TaylorModel, np.ndarray)) or not _known(entry) for entry in found):
        stacks = all(isinstance(entry, np.ndarray) for entry in found)
        return np.stack(found) if stacks else objects(found)
    return np.array(found)


def _known(entry: Any) -> bool:
    return isinstance(entry, (int, float, complex, np.number))


def _magnitude(entry: Any) -> float:
    if isinstance(entry, TaylorModel):
        return abs(entry.centre)
    return float(abs(entry)) if _known(entry) else 1.0


def _angle(y: TaylorModel, x: TaylorModel) -> TaylorModel:
    """arctan2(y, x), turned by the angle of the centre so that the division's value is small."""
    turn = atan2(y.centre, x.centre)
    c, s = cos(turn), sin(turn)
    ahead, aside = x * c + y * s, y * c - x * s
    angle = (aside * ahead.reciprocal()).arctan() + turn
    result = TaylorModel(angle.keys, angle.coefficients, (angle.error + 4 * ROUNDING) * SUMMED)
    if abs(result.centre) + result._spread() >= pi:
        raise DataError(f"arctan2 near its cut at ±pi, around {turn:.3g}: it jumps there")
    return result


def _digits(keys: IntArray) -> IntArray:
    """(M, 3) the variables of each monomial, counted from 1; 0 for none."""
    return np.stack([keys // BASE**2, keys // BASE % BASE, keys % BASE], axis=-1)


@lru_cache(maxsize=65536)
def variables_of(key: int) -> tuple[int, ...]:
    """The variables, counted from 0, of one monomial; twice where squared."""
    return tuple(int(d) - 1 for d in _digits(np.array(key)) if d)


@lru_cache(maxsize=4096)
def _alone(a: bytes) -> tuple[IntArray, IntArray, IntArray]:
    """Where squares d_j² are, where d_j is (0: nowhere), and where what is neither is."""
    keys = np.frombuffer(a, dtype=np.int64)
    digits = _digits(keys)
    squares = np.flatnonzero(
        (digits[:, 0] == 0) & (digits[:, 1] > 0) & (digits[:, 1] == digits[:, 2])
    )
    places = {key: k for k, key in enumerate(keys.tolist())}
    lines = np.array([places.get(j, 0) for j in digits[squares, 2].tolist()], dtype=np.int64)
    others = np.setdiff1d(np.arange(1, len(keys)), np.concatenate([squares, lines]))
    return squares, lines, others


@lru_cache(maxsize=4096)
def _union(a: bytes, b: bytes) -> tuple[IntArray, IntArray, IntArray]:
    first, second = np.frombuffer(a, dtype=np.int64), np.frombuffer(b, dtype=np.int64)
    keys = np.union1d(first, second)
    return keys, np.searchsorted(keys, first), np.searchsorted(keys, second)


@lru_cache(maxsize=4096)
def _products(a: bytes, b: bytes) -> tuple[IntArray, IntArray, BoolArray]:
    """The keys of the products, where each kept one adds to, and which have degree 3 at most."""
    first, second = (_digits(np.frombuffer(part, dtype=np.int64)) for part in (a, b))
    both = np.concatenate(
        np.broadcast_arrays(first[:, None, :], second[None, :, :]), axis=-1
    ).reshape(-1, 6)
    both = np.sort(both, axis=1)
    kept = both[:, 2] == 0
    written = both[kept, 3] * BASE**2 + both[kept, 4] * BASE + both[kept, 5]
    keys, home = np.unique(written, return_inverse=True)
    return keys, home.ravel(), kept


def _number(value: Any) -> float | None:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, (int, float, np.integer, np.floating)):
        return float(value)
    return None


def _is_power_of_two(value: float) -> bool:
    """True if a product with it, or its inverse, is exact; or if it is zero."""
    return abs(frexp(value)[0]) in (0.0, 0.5)
