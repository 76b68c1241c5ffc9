"""`Spline`: a cubic spline on equally spaced knots, linear beyond them.

On the interval from low + i·spacing on, with s in [0, 1] the position in it,
    f(x) = Σ_{r=0..3} coefficients[i + r] b_r(s),
b_r the uniform cubic B-splines. f' is the quadratic B-spline with coefficients
(c_{j+1} - c_j)/spacing, so every slope of f is a convex combination of these.
Source: de Boor, "A Practical Guide to Splines", chapters IX and X.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, freeze
from nlsid_core.errors import DataError, DocumentError, ShapeError

# Coefficients of 1, s, s², s³ in the four uniform cubic B-splines, times 6.
B_SPLINES = np.array(
    [[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True, eq=False)
class Spline:
    """low: the first knot; spacing > 0 between knots; coefficients (K + 3,) on K intervals.

    Raises ShapeError or DataError on numbers that do not fit or are not finite.
    """

    low: float
    spacing: float
    coefficients: FloatArray

    def __post_init__(self) -> None:
        freeze(self, "spline", {"coefficients": (None,)})
        if len(self.coefficients) < 4:
            raise ShapeError(f"{len(self.coefficients)} coefficients; should be K + 3, K >= 1")
        if not np.isfinite([self.low, self.spacing]).all():
            raise DataError("a spline's numbers should be finite")
        if self.spacing <= 0:
            raise DataError(f"knot spacing {self.spacing} should be positive")

    @property
    def intervals(self) -> int:
        """The number of intervals K between the knots."""
        return len(self.coefficients) - 3

    @property
    def high(self) -> float:
        """The last knot."""
        return self.low + self.intervals * self.spacing

    def weights(self, x: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """First coefficient index (N,) and weights (4, N): f(x) = Σ_r weights[r] c[index + r]."""
        index, s, beyond = self._position(x)
        basis = B_SPLINES / 6.0
        return index, basis @ np.stack(
            [np.ones_like(s), s + beyond, s * (s + 2.0 * beyond), s * s * (s + 3.0 * beyond)]
        )

    def __call__(self, x: FloatArray) -> FloatArray:
        """f(x), the shape of x."""
        index, s, beyond = self._position(np.ravel(x))
        c0, c1, c2, c3 = self._powers[:, index]
        slope = (3.0 * c3 * s + 2.0 * c2) * s + c1
        values = ((c3 * s + c2) * s + c1) * s + c0 + beyond * slope
        return np.asarray(values.reshape(np.shape(x)))

    def slope(self, x: FloatArray) -> FloatArray:
        """f'(x), the shape of x."""
        index, s, _ = self._position(np.ravel(x))
        _, c1, c2, c3 = self._powers[:, index]
        slopes = ((3.0 * c3 * s + 2.0 * c2) * s + c1) / self.spacing
        return np.asarray(slopes.reshape(np.shape(x)))

    @cached_property
    def _powers(self) -> FloatArray:
        """(4, K): coefficients of 1, s, s², s³ on each interval."""
        windows = np.lib.stride_tricks.sliding_window_view(self.coefficients, 4)
        return np.asarray((windows @ (B_SPLINES / 6.0)).T)

    def _position(self, x: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
        """Interval, position s in [0, 1] in it, and how far beyond the knots, in spacings."""
        position = (x - self.low) / self.spacing
        index = np.clip(np.floor(position), 0, self.intervals - 1)
        position -= index
        s = np.clip(position, 0.0, 1.0)
        return index.astype(np.intp), s, position - s

    def document(self) -> Json:
        """The JSON form."""
        return {
            "low": self.low,
            "spacing": self.spacing,
            "coefficients": self.coefficients.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str) -> "Spline":
        """Raises DocumentError if parts are missing or unknown, ShapeError or DataError."""
        strangers = set(document) - {"low", "spacing", "coefficients"}
        if strangers:
            raise DocumentError(f"{source}: unknown member '{min(strangers)}'")
        return cls(
            low=files.number(document, "low", source=source),
            spacing=files.number(document, "spacing", source=source),
            coefficients=files.array(document, "coefficients", (None,), source=source),
        )
