"""Static maps of a scalar x with free numbers p (J,).

Each has values f(x), slopes f'(x), both (N,), and moves ∂f(x)/∂p (J, N); those that are piecewise
linear say where they bend (knots).
"""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.models import PiecewiseLinear, Spline

APART = 1e-9  # of their range: knots nearer than that are one


@dataclass(frozen=True, eq=False)
class Smooth:
    """A cubic spline with the coefficients p (intervals + 3,), linear beyond its knots."""

    low: float
    spacing: float
    intervals: int

    def spline(self, p: FloatArray) -> Spline:
        """The map."""
        return Spline(self.low, self.spacing, p)

    def values(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f(x)."""
        return self.spline(p)(x)

    def slopes(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f'(x)."""
        return self.spline(p).slope(x)

    def moves(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """The B-splines at x."""
        index, weights = self.spline(p).weights(x)
        basis = np.zeros((len(p), len(x)))
        for r, weight in enumerate(weights):
            basis[index + r, np.arange(len(x))] = weight
        return basis

    def knots(self, _p: FloatArray) -> FloatArray:
        """The ends of its cubics."""
        return self.low + self.spacing * np.arange(self.intervals + 1)


@dataclass(frozen=True, eq=False)
class Knotted:
    """Linear between equally spaced knots, and on beyond: rows (K + 1, J) give its values there."""

    low: float
    spacing: float
    rows: FloatArray

    def _place(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The interval of x, and the position in it."""
        position = (x - self.low) / self.spacing
        i = np.clip(np.floor(position), 0, len(self.rows) - 2).astype(np.intp)
        return i, position - i

    def values(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f(x)."""
        i, s = self._place(x)
        at_knots = self.rows @ p
        return np.asarray(at_knots[i] + np.diff(at_knots)[i] * s)

    def slopes(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f'(x)."""
        return np.asarray(np.diff(self.rows @ p)[self._place(x)[0]] / self.spacing)

    def moves(self, _p: FloatArray, x: FloatArray) -> FloatArray:
        """The rows between the knots."""
        i, s = self._place(x)
        return np.asarray((self.rows[i] + s[:, None] * (self.rows[i + 1] - self.rows[i])).T)

    def knots(self, _p: FloatArray) -> FloatArray:
        """All of them."""
        return self.low + self.spacing * np.arange(len(self.rows))


def rising(low: float, high: float, intervals: int) -> Knotted:
    """Maps whose numbers are the slopes of the intervals, zero at the first knot."""
    spacing = (high - low) / intervals
    return Knotted(low, spacing, spacing * np.tri(intervals + 1, intervals, -1))


class Top:
    """min(x, top), p = [top]."""

    def values(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f(x)."""
        return np.asarray(np.minimum(x, p[0]))

    def slopes(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f'(x)."""
        return np.asarray((x <= p[0]).astype(np.float64))

    def moves(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """∂f/∂top."""
        return np.asarray((x > p[0]).astype(np.float64)[None])

    def knots(self, p: FloatArray) -> FloatArray:
        """The top."""
        return p[:1]

    def before(self, p: FloatArray, after: FloatArray) -> FloatArray:
        """Points below the top."""
        return np.asarray(after[after < p[0]])


class DeadZone:
    """rest + x - min(max(x, -half), half), p = [half, rest]: sticking below `half`."""

    def values(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f(x)."""
        return np.asarray(p[1] + x - np.clip(x, -p[0], p[0]))

    def slopes(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f'(x)."""
        return np.asarray((np.abs(x) > p[0]).astype(np.float64))

    def moves(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """∂f/∂[half, rest]."""
        return np.array([-np.sign(x) * (np.abs(x) > p[0]), np.ones(len(x))])

    def knots(self, p: FloatArray) -> FloatArray:
        """Where it sticks."""
        return np.array([-p[0], p[0]])

    def before(self, p: FloatArray, after: FloatArray) -> FloatArray:
        """Points outside the dead zone."""
        away = after[after != p[1]] - p[1]
        return np.asarray(away + np.copysign(p[0], away))


@dataclass(frozen=True, eq=False)
class Limited:
    """f(limit(x)), p those of f and then those of the limit."""

    f: Knotted
    limit: Top | DeadZone
    size: int  # numbers of f

    def _split(self, p: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The numbers of f, those of the limit, and the limited x."""
        own, of_limit = p[: self.size], p[self.size :]
        return own, of_limit, self.limit.values(of_limit, x)

    def values(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """f(limit(x))."""
        own, _, inside = self._split(p, x)
        return self.f.values(own, inside)

    def slopes(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """Its slope."""
        own, of_limit, inside = self._split(p, x)
        return self.f.slopes(own, inside) * self.limit.slopes(of_limit, x)

    def moves(self, p: FloatArray, x: FloatArray) -> FloatArray:
        """Its derivatives in the numbers of f, and of the limit."""
        own, of_limit, inside = self._split(p, x)
        through = self.f.slopes(own, inside) * self.limit.moves(of_limit, x)
        return np.concatenate([self.f.moves(own, inside), through])

    def knots(self, p: FloatArray) -> FloatArray:
        """Those of the limit, and those of f where it lets them through."""
        of_limit = p[self.size :]
        through = self.limit.before(of_limit, self.f.knots(p[: self.size]))
        return np.concatenate([through, self.limit.knots(of_limit)])


Limit = Top | DeadZone
Map = Smooth | Knotted | Limit | Limited


def as_piecewise_linear(f: Map, p: FloatArray) -> PiecewiseLinear:
    """The map, one interval longer on each side."""
    knots = np.sort(f.knots(p))
    apart = np.diff(knots, prepend=-np.inf) > APART * max(1.0, float(np.ptp(knots)))
    knots = np.concatenate([[knots[0] - 1.0], knots[apart], [knots[-1] + 1.0]])
    return PiecewiseLinear(knots, f.values(p, knots))
