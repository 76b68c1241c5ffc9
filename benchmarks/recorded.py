"""Recorded data that is not shipped, as datasets; scores of models, and whether they are proved."""

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import CertificateRejected
from nlsid_core.proofs import check

RUBBERY = (
    "81_throttle_ramps",
    "80_circles_rubbery_floor",
    "91_free_driving_16_sept_2024",
    "free_driving_steer_rate_testing_16_sept_2024",
    "circles_27_sept_2024_fast_ramp",
)  # folders of the DART car's drives


def heat_exchanger(folder: Path) -> tuple[FloatArray, FloatArray]:
    """(flow [1], temperature [°C]), 4000 samples of 1 s (DaISy 97-002)."""
    table = np.loadtxt(folder / "exchanger.dat")
    return table[:, 1], table[:, 2]


def wiener_hammerstein(folder: Path) -> tuple[FloatArray, FloatArray]:
    """(u, y) in V, 188 000 samples at 51.2 kHz (SYSID 2009 benchmark)."""
    path = folder / "WienerHammerBenchmark.csv"
    table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1))
    return table[:, 0], table[:, 1]


def f1tenth_car(folder: Path) -> Mapping[int, tuple[FloatArray, FloatArray]]:
    """By number of the measurement: commands (steering, speed) and motion, 40 Hz."""
    found = {}
    for number in range(1, 42):
        path = folder / "F1tenthCar" / f"measurement_{number}"
        u = np.loadtxt(path / "input.csv", delimiter=",")
        motion = np.loadtxt(path / "trajectory.csv", delimiter=",")
        found[number] = u, motion[: len(u)]
    return found


def dart(folder: Path) -> Mapping[str, NDArray[Any]]:
    """By file, the drives on the rubbery floor: tables with titles (Lyons et al. 2024)."""
    found = {}
    for name in RUBBERY:
        for file in sorted((folder / name).glob("*.csv")):
            table = np.genfromtxt(file, delimiter=",", names=True, encoding="utf-8-sig")
            found[file.stem] = table[np.diff(table["vicon_time"], prepend=0.0) > 0.0]
    return found


def emps(folder: Path, name: str = "DATA_EMPS") -> Mapping[str, FloatArray]:
    """The slide's signals at 1 kHz, by their names there (Janot et al. 2019)."""
    table = loadmat(folder / f"{name}.mat")
    return {key: table[key].ravel() for key in ("qg", "qm", "vir")}


def kuka(folder: Path, signals: tuple[str, str]) -> Mapping[str, tuple[FloatArray, FloatArray]]:
    """By letter of the trajectory: two of its signals, (joints, N) each, 250 Hz."""
    found = {}
    for letter in "ABC":
        path = folder / f"2020-10-21_10s_FF_{letter}_08ms.mat"
        recorded = loadmat(path, squeeze_me=True, struct_as_record=False)["rec"]
        found[letter] = getattr(recorded, signals[0]), getattr(recorded, signals[1])
    return found


def schunk(folder: Path, numbers: Iterable[int]) -> Mapping[int, tuple[FloatArray, FloatArray]]:
    """By number of the measurement: six torques and six velocities, (N, 6) each, 250 Hz."""
    found = {}
    for number in numbers:
        path = folder / "Robot" / f"measurement_{number}"
        u = np.loadtxt(path / "input.csv", delimiter=",")
        found[number] = u, np.loadtxt(path / "trajectory.csv", delimiter=",")[: len(u), 6:]
    return found


def block_means(u: FloatArray, y: FloatArray, period: float, count: int, name: str) -> Trajectory:
    """A trial of the means over blocks of `count` samples."""
    N = len(y) // count * count
    u, y = (v[:N].reshape(N // count, count, -1).mean(axis=1) for v in (u, y))
    return Trajectory(t=period * count * np.arange(len(y)), y=y, u=u, name=name)


def single(name: str, u: FloatArray, y: FloatArray, period: float) -> Dataset:
    """One trajectory as a dataset."""
    t = period * np.arange(len(y), dtype=np.float64)
    return Dataset((Trajectory(t=t, y=y, u=u, name=name),))


def percent(y: FloatArray, simulated: FloatArray) -> float:
    """100·‖y - ŷ‖/‖y - mean(y)‖."""
    return float(100.0 * np.linalg.norm(y - simulated) / np.linalg.norm(y - y.mean()))


def proved(model: Any, proof: Any) -> bool:
    """What the exact checker says of the files of a model and its proof."""
    with tempfile.TemporaryDirectory() as folder:
        files.write_document(Path(folder) / "model.json", model.document())
        path = Path(folder) / "model.proof.json"
        files.write_document(path, proof.document(model, "model.json"))
        return is_proved(path)


def is_proved(path: Path) -> bool:
    """What the exact checker says of a proof file."""
    try:
        check(path)
    except CertificateRejected:
        return False
    return True
