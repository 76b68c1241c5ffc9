"""Recorded data that is not shipped: read from a folder given by --data, as datasets."""

from pathlib import Path

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory


def heat_exchanger(folder: Path) -> tuple[FloatArray, FloatArray]:
    """(flow [1], temperature [°C]), 4000 samples of 1 s (DaISy 97-002)."""
    table = np.loadtxt(folder / "exchanger.dat")
    return table[:, 1], table[:, 2]


def wiener_hammerstein(folder: Path) -> tuple[FloatArray, FloatArray]:
    """(u, y) in V, 188 000 samples at 51.2 kHz (SYSID 2009 benchmark)."""
    path = folder / "WienerHammerBenchmark.csv"
    table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1))
    return table[:, 0], table[:, 1]


def single(name: str, u: FloatArray, y: FloatArray, period: float) -> Dataset:
    """One trajectory as a dataset."""
    t = period * np.arange(len(y), dtype=np.float64)
    return Dataset((Trajectory(t=t, y=y, u=u, name=name),))


def percent(y: FloatArray, simulated: FloatArray) -> float:
    """100·‖y - ŷ‖/‖y - mean(y)‖."""
    return float(100.0 * np.linalg.norm(y - simulated) / np.linalg.norm(y - y.mean()))
