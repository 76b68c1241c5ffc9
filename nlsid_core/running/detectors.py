"""What robots are commonly watched with, to compare a funnel with: CUSUM, 3σ and a box.

A detector is a statistic of the residuals at every sample, and alarms where it exceeds a threshold.
Thresholds are set as a funnel's level is: the largest value on the calibration trials, residuals
times the safety factor. So each has the same bound on false alarms, 1/(m + 1) for factor 1.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from nlsid_core.arrays import FloatArray

DRIFT = 0.5  # standard deviations a sample that CUSUM forgives: half a shift of one


@dataclass(frozen=True, eq=False)
class Residuals:
    """One run, sample by sample: innovation and tracking error, each (N, p) in the outputs' units.

    The tracking error is the measured output minus the nominal's.
    """

    innovation: FloatArray
    error: FloatArray


class CusumMeter:
    """Both one-sided sums S⁺ = max(0, S ± z - drift) of several outputs, sample by sample.

    Source: E. S. Page, Continuous Inspection Schemes, Biometrika 41 (1954).
    """

    def __init__(self, outputs: int, drift: float = DRIFT) -> None:
        self._drift, self._sums = drift, [0.0] * (2 * outputs)

    def update(self, z: Sequence[float]) -> float:
        """The largest sum after z (p,), in standard deviations."""
        drift, sums = self._drift, self._sums
        for j, now in enumerate(z):
            sums[2 * j] = max(0.0, sums[2 * j] + now - drift)
            sums[2 * j + 1] = max(0.0, sums[2 * j + 1] - now - drift)
        return max(sums)


def cusum(z: FloatArray) -> FloatArray:
    """The largest sum of a `CusumMeter` at every sample of z (N, p)."""
    meter = CusumMeter(z.shape[1])
    return np.array([meter.update(now) for now in z.tolist()])


def largest(z: FloatArray) -> FloatArray:
    """The largest |z_j| at every sample of z (N, p)."""
    return np.asarray(np.abs(z).max(axis=1))


# Each: the part of the residuals, and the statistic of it in standard deviations.
DETECTORS: Final[Mapping[str, tuple[str, Callable[[FloatArray], FloatArray]]]] = {
    "CUSUM": ("innovation", cusum),
    "3σ": ("innovation", largest),
    "box": ("error", largest),
}


@dataclass(frozen=True, eq=False)
class Detector:
    """One of DETECTORS with its threshold; deviation: (p,) one standard deviation, in units."""

    name: str
    deviation: FloatArray
    threshold: float

    @classmethod
    def calibrated(cls, name: str, runs: Sequence[Residuals], factor: float) -> "Detector":
        """Alarms only above the largest statistic of these runs, their residuals times `factor`."""
        part, _ = DETECTORS[name]
        everything = np.concatenate([getattr(run, part) for run in runs])
        deviation = np.maximum(everything.std(axis=0), np.finfo(float).tiny)
        silent = cls(name, deviation, np.inf)
        scaled = [Residuals(factor * run.innovation, factor * run.error) for run in runs]
        return cls(name, deviation, max(float(silent.statistic(run).max()) for run in scaled))

    def statistic(self, run: Residuals) -> FloatArray:
        """(N,) what is held against the threshold."""
        part, of = DETECTORS[self.name]
        return of(getattr(run, part) / self.deviation)

    def alarm(self, run: Residuals) -> int | None:
        """The first sample of the run with an alarm."""
        above = np.flatnonzero(self.statistic(run) > self.threshold)
        return int(above[0]) if len(above) else None

    def quieter(self, runs: Sequence[Residuals], alarms: int) -> "Detector":
        """The threshold raised, if need be, until at most so many of these runs have an alarm."""
        peaks = sorted((float(self.statistic(run).max()) for run in runs), reverse=True)
        least = peaks[alarms] if alarms < len(peaks) else 0.0
        return Detector(self.name, self.deviation, max(self.threshold, least))
