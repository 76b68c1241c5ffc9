"""The noise of the outputs, as banded a covariance as the residual shows.

Source: E. Parzen, Mathematical Considerations in the Estimation of Spectra, Technometrics 3 (1961).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import SolverError
from nlsid_core.identification.methods.banded import Diagonals, shift

MOST_NOISE_LAGS = 200
WHITE = 1e-3  # of the noise, so that no frequency is taken for free of it


@dataclass(frozen=True, eq=False)
class Noise:
    """Correlation (n_y, lags + 1) of each output's noise with itself k samples ago: 1 at k = 0."""

    correlation: FloatArray

    @classmethod
    def of(cls, residuals: Sequence[FloatArray], lags: int) -> "Noise":
        """Of residuals (N, n_y), one for each trial, by sample correlations under Parzen's window.

        SolverError if an output has no residual.
        """
        powers = np.stack([_products(residuals, k) for k in range(lags + 1)], axis=1)
        if not (np.isfinite(powers).all() and (powers[:, 0] > 0.0).all()):
            raise SolverError("the residual of an output is zero, so it has no correlation")
        x = np.arange(lags + 1) / (lags + 1)
        window = np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * (1 - x) ** 3)
        correlation = (1.0 - WHITE) * window * powers / powers[:, :1]
        correlation[:, 0] = 1.0
        return cls(correlation)

    def covariance(self, row: FloatArray) -> Diagonals:
        """Σ by diagonals, of rows whose number in their trial is `row` (N,), n_y of each together.

        Trials have nothing to do with each other, nor have outputs.
        """
        n_y = len(self.correlation)
        inside, made = np.repeat(row, n_y), {}
        for k, values in enumerate(self.correlation.T):
            diagonal = np.tile(values, len(row)) * (inside >= k)
            made[k * n_y] = diagonal
            made[-k * n_y] = shift(diagonal, -k * n_y)
        return made


def _products(residuals: Sequence[FloatArray], k: int) -> FloatArray:
    """(n_y,): Σ r(t) r(t - k) over all trials; 0 of one that is shorter."""
    parts = [np.sum(r[k:] * r[: max(len(r) - k, 0)], axis=0) for r in residuals]
    return np.asarray(np.sum(parts, axis=0))
