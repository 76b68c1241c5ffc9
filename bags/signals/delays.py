"""The delay between a command and the response to it."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError

RELATED: Final = 0.3  # correlation of command and response below which they may be unrelated


@dataclass(frozen=True)
class Delay:
    """seconds: by which the response follows the command. correlation: there, -1 to 1."""

    seconds: float
    correlation: float


def correlation(y: FloatArray, u: FloatArray) -> FloatArray:
    """Σ_t y(t + k) u(t) at the lags k = 0 … N-1 of two signals (N,)."""
    size = 2 * len(y)  # so long that nothing comes round
    found: FloatArray = np.fft.irfft(np.fft.rfft(y, size) * np.fft.rfft(u, size).conj(), size)
    return found[: len(y)]


def delay(command: FloatArray, response: FloatArray, period: float, max_delay: float) -> Delay:
    """The delay (N,) samples `period` s apart show: where command and response correlate most.

    Of two signals on one grid the normalised cross-correlation about their means, over delays from
    0 to `max_delay` s, refined by a parabola through its peak. A lag in the response counts as
    part of the delay. Raises DataError if either is constant or `max_delay` leaves no overlap.

    Source: C. Knapp, G. Carter, IEEE Trans. ASSP 24 (1976) 320, the unweighted correlator.
    """
    most = min(round(max_delay / period), len(command) - 2)
    if most < 1 or len(command) != len(response):
        raise DataError(f"{len(command)} samples leave no delay of up to {max_delay:g} s to find")
    u, y = command - command.mean(), response - response.mean()
    if not (u @ u > 0 and y @ y > 0):
        raise DataError("a constant signal has no delay")
    overlap = len(u) - np.arange(most + 1)
    found = correlation(y, u)[: most + 1] * (len(u) / overlap)
    found = found / np.sqrt((u @ u) * (y @ y))
    k = int(np.argmax(np.abs(found)))
    shift = 0.0
    if 0 < k < len(found) - 1:
        before, here, after = np.abs(found[k - 1 : k + 2])
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return Delay((k + shift) * period, float(np.clip(found[k], -1.0, 1.0)))
