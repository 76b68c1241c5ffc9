"""Signals that excite a robot enough to identify it, and stay within what it may be asked.

Each is an array (N,) of inputs `period` s apart, between -1 and 1; `Shape` puts it between limits,
bounds its slew rate and fades it in and out. numpy.random is named in quotes only:
loading it would cost those who do not excite.
"""

import math
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError

PRBS_TAPS = {7: (7, 6), 9: (9, 5), 10: (10, 7), 11: (11, 9), 15: (15, 14)}  # maximal lengths


def multisine(
    samples: int, period: float, *, lowest: float, highest: float, rng: "np.random.Generator"
) -> FloatArray:
    """Equal sines at every harmonic of the length in [lowest, highest] Hz, with random phases."""
    harmonics = _harmonics(samples, period, lowest, highest)
    t = np.arange(samples) / samples
    phases = rng.uniform(0.0, 2.0 * np.pi, len(harmonics))
    signal = np.cos(2.0 * np.pi * np.outer(t, harmonics) + phases).sum(axis=1)
    return np.asarray(signal / np.abs(signal).max())


def chirp(samples: int, period: float, *, lowest: float, highest: float) -> FloatArray:
    """A sine whose frequency rises exponentially from lowest to highest Hz."""
    _harmonics(samples, period, lowest, highest)
    t = np.arange(samples) * period
    growth = math.log(highest / lowest) / (samples * period)
    phase = 2.0 * np.pi * lowest * np.expm1(growth * t) / growth if growth else lowest * t
    return np.asarray(np.sin(phase))


def prbs(samples: int, period: float, *, hold: float, order: int = 9) -> FloatArray:
    """A maximal-length pseudo-random binary sequence whose bits last `hold` s."""
    if order not in PRBS_TAPS:
        raise DataError(f"PRBS order {order}; it should be one of {', '.join(map(str, PRBS_TAPS))}")
    length = max(1, round(hold / period))
    first, second = PRBS_TAPS[order]
    register, bits = (1 << order) - 1, []
    for _ in range(-(-samples // length)):
        bits.append(1.0 if register & 1 else -1.0)
        new = (register >> (order - first) ^ register >> (order - second)) & 1
        register = register >> 1 | new << (order - 1)
    return np.repeat(bits, length)[:samples]


def steps(samples: int, period: float, *, hold: float, rng: "np.random.Generator") -> FloatArray:
    """Steps of `hold` s to random levels."""
    length = max(1, round(hold / period))
    return np.repeat(rng.uniform(-1.0, 1.0, -(-samples // length)), length)[:samples]


def _harmonics(samples: int, period: float, lowest: float, highest: float) -> FloatArray:
    duration = samples * period
    if not 0.0 < lowest < highest <= 0.5 / period:
        raise DataError(
            f"frequencies {lowest} to {highest} Hz: they should rise from above 0 to at most "
            f"{0.5 / period:g} Hz, half the sample rate"
        )
    harmonics = np.arange(math.ceil(lowest * duration), math.floor(highest * duration) + 1)
    if not len(harmonics):
        raise DataError(f"no harmonic of {duration:g} s lies in {lowest} to {highest} Hz")
    return harmonics.astype(np.float64)


@dataclass(frozen=True)
class Shape:
    """lowest, highest: of the input, in its unit. slew: its fastest change, in unit/s. fade: s of
    soft start and stop. rest: the input before and after.

    Raises DataError unless lowest <= rest <= highest, lowest < highest and slew > 0.
    """

    lowest: float
    highest: float
    slew: float
    fade: float = 1.0
    rest: float = 0.0

    def __post_init__(self) -> None:
        sensible = self.lowest <= self.rest <= self.highest and self.lowest < self.highest
        if not (sensible and self.slew > 0.0 and self.fade >= 0.0):
            raise DataError(
                f"limits [{self.lowest}, {self.highest}], slew {self.slew}/s, rest {self.rest}: "
                "set lowest < highest around rest, and slew above 0, to what the robot may do"
            )

    def __call__(self, signal: FloatArray, period: float) -> FloatArray:
        """A signal in [-1, 1] as inputs: centred between the limits, faded, slow enough.

        It ends at rest, however long that takes.
        """
        centre, half = (self.highest + self.lowest) / 2.0, (self.highest - self.lowest) / 2.0
        count = min(round(self.fade / period), len(signal) // 2)
        ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
        envelope = np.ones(len(signal))
        envelope[:count], envelope[len(signal) - count :] = ramp, ramp[::-1]
        wanted = self.rest + envelope * (centre + half * np.clip(signal, -1.0, 1.0) - self.rest)
        step = self.slew * period
        inputs, u = [], self.rest
        for target in wanted:
            u += min(max(float(target) - u, -step), step)
            inputs.append(u)
        while u != self.rest:
            u += min(max(self.rest - u, -step), step)
            inputs.append(u)
        return np.clip(inputs, self.lowest, self.highest)
