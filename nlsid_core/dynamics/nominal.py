"""`Nominal`: the motion a funnel is built around, x₀ and u₀ as piecewise cubics on common knots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.dynamics.piecewise import PiecewisePolynomial
from nlsid_core.dynamics.taylor import Rates
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import DataError, ShapeError

SAMPLES = 9  # per interval, where a defect is looked for


@dataclass(frozen=True, eq=False)
class Nominal:
    """A motion: states and inputs as cubics over time.

    x: states (n,), continuous; u: inputs (m,); the same knots. A jump of rounding is closed.

    Raises ShapeError or DataError if they do not fit together.
    """

    x: PiecewisePolynomial
    u: PiecewisePolynomial

    def __post_init__(self) -> None:
        if len(self.x.control.shape) != 3 or len(self.u.control.shape) != 3:
            raise ShapeError("nominal states and inputs should be vectors")
        if not np.array_equal(self.x.t, self.u.t):
            raise DataError("nominal states and inputs should have the same knots")
        for name in ("x", "u"):
            object.__setattr__(self, name, getattr(self, name).joined())
        if not self.x.is_continuous():
            jump = np.abs(self.x.control[1:, 0] - self.x.control[:-1, -1])
            k, i = np.unravel_index(int(jump.argmax()), jump.shape)
            raise DataError(
                f"the nominal states should be continuous: x{i} jumps by {jump[k, i]:.3g} at "
                f"{self.t[k + 1]:.6g} s"
            )

    @property
    def t(self) -> FloatArray:
        """(K,) knots in s."""
        return self.x.t

    def halved(self, chosen: ArrayLike) -> Nominal:
        """The same motion with a knot more in the middle of the chosen (K-1,) intervals."""
        return Nominal(self.x.halved(chosen), self.u.halved(chosen))

    def defect(self, field: VectorField | Rates) -> tuple[float, float, int]:
        """The largest |f(t, x₀, u₀) - ẋ₀| over fine samples, when (s), and in which state."""
        when, gaps = self._sampled(field)
        j, i = np.unravel_index(int(gaps.argmax()), gaps.shape)
        return float(gaps[j, i]), float(when[j]), int(i)

    def gaps(self, field: VectorField | Rates) -> FloatArray:
        """(K-1,) the largest of those within each interval."""
        gaps = self._sampled(field)[1][:-1]
        return np.asarray(gaps.reshape(len(self.t) - 1, -1).max(axis=1))

    def _sampled(self, field: VectorField | Rates) -> tuple[FloatArray, FloatArray]:
        """(S,) times and (S, n) |f(t, x₀, u₀) - ẋ₀| there."""
        share = np.arange(SAMPLES) / SAMPLES
        when = np.append((self.t[:-1, None] + np.diff(self.t)[:, None] * share).ravel(), self.t[-1])
        X, U = self.x(when)[:, None], self.u(when)[:, None]
        rates = [field(t, x, u)[0] for t, x, u in zip(when.tolist(), X, U, strict=True)]
        return when, np.abs(rates - self.x.derivative()(when))
