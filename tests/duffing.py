"""A Duffing oscillator, x'' + d x' + x + x³ = u, sampled with u held: a spring that stiffens."""

import hashlib

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory

PERIOD, BAND = 0.3, 0.25  # s; of the sampling frequency, up to which the input has power
NOISE = 0.01  # of the spread of x
SUBSTEPS = 10


def position(u: FloatArray, damping: float) -> FloatArray:
    """x (N,) from rest by Runge and Kutta's method of order four."""
    h, x, outputs = PERIOD / SUBSTEPS, np.zeros(2), []

    def rate(x: FloatArray, force: float) -> FloatArray:
        return np.array([x[1], force - damping * x[1] - x[0] - x[0] ** 3])

    for force in u.tolist():
        outputs.append(x[0])
        for _ in range(SUBSTEPS):
            k1 = rate(x, force)
            k2 = rate(x + h / 2 * k1, force)
            k3 = rate(x + h / 2 * k2, force)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, force))
    return np.array(outputs)


def multisine(samples: int, amplitude: float, rng: np.random.Generator) -> FloatArray:
    """(N,) of this rms value, random phases."""
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    lines = np.arange(1, int(BAND * samples))
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=len(lines)))
    u = np.fft.irfft(spectrum, samples)
    return np.asarray(amplitude * u / u.std())


def trials(
    amplitudes: list[float], *, samples: int = 600, damping: float = 0.2, seed: int = 0
) -> Dataset:
    """One trial of each amplitude."""
    rng, made = np.random.default_rng(seed), []
    for i, amplitude in enumerate(amplitudes):
        u = multisine(samples, amplitude, rng)
        x = position(u, damping)
        y = x + NOISE * x.std() * rng.standard_normal(samples)
        name = f"{seed}, {i}: {amplitude}"
        digest = "sha256:" + hashlib.sha256(name.encode()).hexdigest()
        t = PERIOD * np.arange(samples)
        made.append(Trajectory(t=t, y=y, u=u, name=name, digest=digest))
    return Dataset(tuple(made))
