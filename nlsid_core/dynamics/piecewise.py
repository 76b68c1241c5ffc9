"""`PiecewisePolynomial`: a function of time in Bernstein form, piece by piece.

On piece k, with s = (t - t_k)/(t_{k+1} - t_k) and r = 1 - s, the value is
Σ_i C(d,i) s^i r^(d-i) control[k, i]. The control points are all there is: what is stored,
evaluated and proved is the same function, exactly.
"""

from dataclasses import dataclass
from math import comb

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, keep
from nlsid_core.errors import DataError, ShapeError

MAX_DEGREE = 3  # what the checker restricts to sub-intervals exactly
ROUNDING = 1e-12  # of an entry's largest value: what a hundred roundings may make of no jump


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """t: (K,) s, increasing knots. control: (K-1, d+1, *shape), d ≤ 3, arrays read-only.

    Raises ShapeError or DataError on sizes that do not fit, NaN, or knots that do not increase.
    """

    t: FloatArray
    control: FloatArray

    def __post_init__(self) -> None:
        t, control = (np.array(part, dtype=np.float64) for part in (self.t, self.control))
        if t.ndim != 1 or len(t) < 2 or control.ndim < 2 or len(control) != len(t) - 1:
            raise ShapeError(
                f"knots {t.shape} and control points {control.shape} do not fit: expected (K,) "
                "with K >= 2 and (K-1, degree+1, ...)"
            )
        if not 1 <= control.shape[1] <= MAX_DEGREE + 1:
            raise ShapeError(f"degree {control.shape[1] - 1}: a piece has degree 0 to {MAX_DEGREE}")
        for name, values in (("knots", t), ("control points", control)):
            if not np.isfinite(values).all():
                raise DataError(f"{name} hold NaN or infinity")
        back = np.flatnonzero(np.diff(t) <= 0)
        if len(back):
            k = int(back[0])
            raise DataError(
                f"time grid does not increase after knot {k}: {t[k]:.9g} s, then {t[k + 1]:.9g} s"
            )
        keep(self, {"t": t, "control": control})

    @property
    def degree(self) -> int:
        """The degree d of the pieces."""
        return int(self.control.shape[1]) - 1

    def __call__(self, t: ArrayLike) -> FloatArray:
        """Values (..., *shape) at times t (...) in s; at a knot, of the piece that begins there.

        Times outside the knots take the nearest piece's polynomial.
        """
        t = np.asarray(t, dtype=np.float64)
        if t.ndim == 0:
            place = int(self.piece(t))
            s = float((t - self.t[place]) / (self.t[place + 1] - self.t[place]))
            return bernstein(self.control[place], s)
        flat = np.atleast_1d(t).ravel()
        k = self.piece(flat)
        s = (flat - self.t[k]) / (self.t[k + 1] - self.t[k])
        powers = np.array(
            [
                comb(self.degree, i) * s**i * (1 - s) ** (self.degree - i)
                for i in range(self.degree + 1)
            ]
        )
        values = np.einsum("in,ni...->n...", powers, self.control[k])
        return np.asarray(values.reshape(t.shape + self.control.shape[2:]))

    def piece(self, t: ArrayLike) -> FloatArray:
        """The index of the piece each time lies in; a knot belongs to the piece after it."""
        found = np.searchsorted(self.t, np.asarray(t), side="right") - 1
        return np.minimum(np.maximum(found, 0), len(self.t) - 2)

    def derivative(self) -> "PiecewisePolynomial":
        """The time derivative, exact within each piece but for rounding."""
        if self.degree == 0:
            return PiecewisePolynomial(self.t, 0 * self.control)
        h = np.diff(self.t).reshape(-1, *[1] * (self.control.ndim - 1))
        return PiecewisePolynomial(self.t, self.degree * np.diff(self.control, axis=1) / h)

    def ends(self) -> FloatArray:
        """(K, *shape) values at the knots, exact; the last from the left."""
        return np.concatenate([self.control[:, 0], self.control[-1:, -1]])

    def halved(self, chosen: ArrayLike) -> "PiecewisePolynomial":
        """The same function, but for rounding, with a knot more in the middle of chosen pieces.

        chosen: (K-1,) True for those pieces. Source: de Casteljau's algorithm.
        """
        marked: list[bool] = np.asarray(chosen, dtype=bool).tolist()
        t, pieces = [float(self.t[0])], []
        for k, (control, half) in enumerate(zip(self.control, marked, strict=True)):
            if half:
                points, first, last = control, [control[0]], [control[-1]]
                while len(points) > 1:
                    points = (points[:-1] + points[1:]) / 2
                    first.append(points[0])
                    last.append(points[-1])
                t.append(float(self.t[k] + self.t[k + 1]) / 2)
                pieces += [np.array(first), np.array(last[::-1])]
            else:
                pieces.append(control)
            t.append(float(self.t[k + 1]))
        return PiecewisePolynomial(np.array(t), np.array(pieces))

    def joined(self) -> "PiecewisePolynomial":
        """The same function without jumps that are no larger than rounding."""
        first, last = self.control[1:, 0], self.control[:-1, -1]
        jump = np.abs(first - last)
        size = np.abs(self.control).max(axis=(0, 1), initial=0.0)
        small = (jump > 0) & (jump <= ROUNDING * size)
        if not small.any():
            return self
        control = self.control.copy()
        control[1:, 0] = np.where(small, last, first)
        return PiecewisePolynomial(self.t, control)

    def is_continuous(self) -> bool:
        """True if every piece begins exactly where the one before ends."""
        return bool((self.control[1:, 0] == self.control[:-1, -1]).all())

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {"t": self.t.tolist(), "control": self.control.tolist()}

    @classmethod
    def from_document(
        cls, document: Json, shape: tuple[int | None, ...], *, source: str
    ) -> "PiecewisePolynomial":
        """Raises DocumentError if the document does not hold values of `shape`."""
        return cls(
            files.array(document, "t", (None,), source=source),
            files.array(document, "control", (None, None, *shape), source=source),
        )


def cubic_through(t: ArrayLike, values: ArrayLike, rates: ArrayLike) -> PiecewisePolynomial:
    """The piecewise cubic with these values and rates (both (K, *shape)) at the knots."""
    t, values, rates = (np.asarray(part, dtype=np.float64) for part in (t, values, rates))
    if values.shape != rates.shape or len(values) != len(t):
        raise ShapeError(f"t {t.shape}, values {values.shape} and rates {rates.shape} do not fit")
    third = (np.diff(t) / 3).reshape(-1, *[1] * (values.ndim - 1))
    start, end = values[:-1], values[1:]
    control = [start, start + third * rates[:-1], end - third * rates[1:], end]
    return PiecewisePolynomial(t, np.stack(control, axis=1))


def linear_through(t: ArrayLike, values: ArrayLike) -> PiecewisePolynomial:
    """The piecewise linear function with these values (K, *shape) at the knots."""
    values = np.asarray(values, dtype=np.float64)
    return PiecewisePolynomial(np.asarray(t), np.stack([values[:-1], values[1:]], axis=1))


def constant_on(t: ArrayLike, values: ArrayLike) -> PiecewisePolynomial:
    """The piecewise constant function with these values (K-1, *shape)."""
    return PiecewisePolynomial(np.asarray(t), np.asarray(values, dtype=np.float64)[:, None])


def bernstein(control: FloatArray, s: float) -> FloatArray:
    """One piece's value at s in [0, 1]: control (d+1, *shape) to (*shape), exact at both ends."""
    d = len(control) - 1
    total = sum((comb(d, i) * s**i * (1 - s) ** (d - i) * control[i] for i in range(d + 1)), 0.0)
    return np.asarray(total)
