"""`Nominal`: the motion a funnel is built around, x₀ and u₀ as piecewise cubics on common knots."""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics.piecewise import PiecewisePolynomial
from nlsid_core.dynamics.taylor import Rates
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import DataError, ShapeError

SAMPLES = 9  # per interval, where a defect is looked for


@dataclass(frozen=True, eq=False)
class Nominal:
    """x: states (n,), continuous; u: inputs (m,); the same knots.

    Raises ShapeError or DataError if they do not fit together.
    """

    x: PiecewisePolynomial
    u: PiecewisePolynomial

    def __post_init__(self) -> None:
        if len(self.x.control.shape) != 3 or len(self.u.control.shape) != 3:
            raise ShapeError("nominal states and inputs should be vectors")
        if not np.array_equal(self.x.t, self.u.t):
            raise DataError("nominal states and inputs should have the same knots")
        if not self.x.is_continuous():
            raise DataError("the nominal states should be continuous")

    @property
    def t(self) -> FloatArray:
        """(K,) knots in s."""
        return self.x.t

    def defect(self, field: VectorField | Rates) -> tuple[float, float, int]:
        """The largest |f(t, x₀, u₀) - ẋ₀| sampled, its interval's start (s), and the state."""
        gaps = self.gaps(field)
        k, i = np.unravel_index(int(gaps.argmax()), gaps.shape)
        return float(gaps[k, i]), float(self.t[k]), int(i)

    def gaps(self, field: VectorField | Rates) -> FloatArray:
        """(K-1, n) the largest |f(t, x₀, u₀) - ẋ₀| over fine samples of every interval."""
        rate, gaps = self.x.derivative(), np.zeros((len(self.t) - 1, self.x.control.shape[2]))
        for k, (start, end) in enumerate(zip(self.t[:-1], self.t[1:], strict=True)):
            for t in np.linspace(start, end, SAMPLES, endpoint=k == len(gaps) - 1):
                gap = np.abs(field(t, self.x(t)[None], self.u(t)[None])[0] - rate(t))
                gaps[k] = np.maximum(gaps[k], gap)
        return gaps
