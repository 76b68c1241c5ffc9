"""Cubic B-splines on uniform knots, continued linearly beyond them."""

from dataclasses import dataclass

import numpy as np

from nlsid_core._types import FloatArray, IntArray
from nlsid_core.errors import DataError, ShapeError

# Rows: the four pieces that overlap on an interval, columns: powers 0 … 3 of its coordinate.
_PIECES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0


@dataclass(frozen=True, eq=False)
class Spline:
    """f(x) = Σ c_j B((x - start)/step - j) on [start, start + step·(len(c) - 3)], C¹ and linear
    outside. f' is everywhere a convex combination of (c_{j+1} - c_j)/step.

    Raises ShapeError or DataError on parts that do not fit.
    """

    start: float
    step: float
    c: FloatArray

    def __post_init__(self) -> None:
        c = np.array(self.c, dtype=np.float64)
        c.setflags(write=False)
        object.__setattr__(self, "c", c)
        if c.ndim != 1 or len(c) < 4:
            raise ShapeError(f"a cubic spline has at least 4 coefficients; shape is {c.shape}")
        if not (np.isfinite(c).all() and np.isfinite([self.start, self.step]).all()):
            raise DataError("a spline's numbers should be finite")
        if self.step <= 0.0:
            raise DataError(f"knots should increase; their step is {self.step}")

    @property
    def end(self) -> float:
        """The last knot."""
        return self.start + self.step * (len(self.c) - 3)

    def slopes(self) -> FloatArray:
        """(len(c) - 1,): f' lies between the least and the largest of these, for every x."""
        return np.diff(self.c) / self.step

    def __call__(self, x: FloatArray) -> FloatArray:
        """Values, the shape of x."""
        first, weights = self.weights(x)
        return np.asarray(np.sum(self.c[first[..., None] + np.arange(4)] * weights, axis=-1))

    def derivative(self, x: FloatArray) -> FloatArray:
        """f'(x), the shape of x."""
        first, s, _ = self._locate(x)
        powers = np.stack([np.zeros_like(s), np.ones_like(s), 2 * s, 3 * s**2], axis=-1)
        weights = powers @ _PIECES.T / self.step
        return np.asarray(np.sum(self.c[first[..., None] + np.arange(4)] * weights, axis=-1))

    def weights(self, x: FloatArray) -> tuple[IntArray, FloatArray]:
        """Index of the first of four coefficients at each x, and their four weights."""
        first, s, beyond = self._locate(x)
        powers = np.stack([np.ones_like(s), s, s**2, s**3], axis=-1)
        slopes = np.stack([np.zeros_like(s), np.ones_like(s), 2 * s, 3 * s**2], axis=-1)
        return first, (powers + beyond[..., None] * slopes) @ _PIECES.T

    def _locate(self, x: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Interval, coordinate in it (0 … 1), and how many steps x lies beyond the knots."""
        position = (np.asarray(x, dtype=np.float64) - self.start) / self.step
        inside = np.clip(position, 0.0, len(self.c) - 3)
        first = np.minimum(inside.astype(np.int64), len(self.c) - 4)
        return first, inside - first, position - inside
