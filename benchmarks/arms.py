"""Real arms and drives, torque or voltage in, velocity out: what a stable model can and cannot say.

python -m benchmarks.arms --data DIR [--json]

DIR holds schunk_arm, emps and kuka_kr300. There is no target: these machines hold still under small
forces (stick-slip), carry gravity and integrate velocity to position, none of which a contracting
model of velocity describes. The table says how far it gets: one step ahead well, in simulation no.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from benchmarks.machine import describe
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.identification import Polynomial, identify, validate

LAGS = 3
SCHUNK_TEST = range(81, 101)
DECIMATION = {"emps": 10, "kuka": 2, "schunk": 2}  # to about 100-250 Hz


def trial(name: str, u: FloatArray, y: FloatArray, period: float, decimation: int) -> Trajectory:
    """One recording: block means over `decimation` samples."""
    N = len(y) // decimation * decimation
    means = [signal[:N].reshape(-1, decimation).mean(axis=1) for signal in (u, y)]
    t = period * decimation * np.arange(len(means[0]), dtype=np.float64)
    return Trajectory(t=t, y=means[1], u=means[0], name=name)


def emps(folder: Path) -> tuple[Dataset, Dataset]:
    """Motor voltage to slide velocity; identification and pulse recordings (Janot et al. 2019)."""
    parts = []
    for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"):
        table = loadmat(folder / name)
        velocity = np.gradient(table["qm"].ravel(), 1e-3)
        parts.append(
            Dataset((trial(name, table["vir"].ravel(), velocity, 1e-3, DECIMATION["emps"]),))
        )
    return parts[0], parts[1]


def kuka(folder: Path, joint: int) -> tuple[Dataset, Dataset]:
    """Motor torque to motor velocity of one joint; trajectories A, B against C."""
    trials = []
    for letter in "ABC":
        path = folder / f"2020-10-21_10s_FF_{letter}_08ms.mat"
        recording = loadmat(path, squeeze_me=True, struct_as_record=False)["rec"]
        torque, velocity = recording.act_torque_abs_nm, recording.act_vel_mot_deg_per_s
        trials.append(
            trial(letter, torque[joint], np.deg2rad(velocity[joint]), 4e-3, DECIMATION["kuka"])
        )
    return Dataset(tuple(trials[:2])), Dataset((trials[2],))


def schunk(folder: Path, joint: int) -> tuple[Dataset, Dataset]:
    """Motor torque to joint velocity of one joint; trials 1-80 against 81-100."""
    trials = []
    for number in range(1, 101):
        path = folder / "Robot" / f"measurement_{number}"
        torque = np.loadtxt(path / "input.csv", delimiter=",")[:, joint]
        velocity = np.loadtxt(path / "trajectory.csv", delimiter=",")[: len(torque), 6 + joint]
        trials.append(trial(str(number), torque, velocity, 4e-3, DECIMATION["schunk"]))
    dataset = Dataset(tuple(trials))
    test = [str(number) for number in SCHUNK_TEST]
    return dataset.without(test), dataset.select(test)


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the three recordings")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    machines = {"EMPS": emps(arguments.data / "emps")}
    machines |= {f"KUKA {j + 1}": kuka(arguments.data / "kuka_kr300", j) for j in range(6)}
    machines |= {f"Schunk {j + 1}": schunk(arguments.data / "schunk_arm", j) for j in range(6)}
    print(f"{LAGS} lags, test error [%], {describe()}\n")
    print(f"{'':10s}{'least squares':>22s}{'robust simulation error':>26s}")
    print(f"{'':10s}{'simulated':>12s}{'1 ahead':>10s}{'simulated':>12s}{'1 ahead':>10s}"
          f"{'20 ahead':>10s}{'rate':>9s}{'white':>7s}{'s':>7s}")  # fmt: skip
    keys: dict[str, dict[str, float | bool]] = {}
    for name, (train, test) in machines.items():
        started = time.perf_counter()
        fit = identify(train, Polynomial(LAGS), allow_unproved=True)
        seconds = time.perf_counter() - started
        naive, ours = (validate(fit[method].model, test) for method in ("least_squares", "rse"))
        proof = fit["rse"].proof
        rate = f"{proof.rate:.5f}" if proof else "-"
        print(
            f"{name:10s}{naive.simulation_percent:12.1f}{naive.prediction_percent[1]:10.2f}"
            f"{ours.simulation_percent:12.1f}{ours.prediction_percent[1]:10.2f}"
            f"{ours.prediction_percent[20]:10.1f}{rate:>9s}{ours.one_step.white!s:>7s}{seconds:7.2f}"
        )
        keys[name] = {
            "ls_simulation": naive.simulation_percent,
            "simulation": ours.simulation_percent,
            "one_ahead": ours.prediction_percent[1],
            "proved": proof is not None,
            "white": ours.one_step.white,
        }
    white = sum(bool(entry["white"]) for entry in keys.values())
    better = sum(entry["simulation"] < entry["ls_simulation"] for entry in keys.values())
    print(
        f"\n{white} of {len(keys)} residuals are white; the robust model simulates better on "
        f"{better}. Least squares predicts one\nsample better and drifts sooner. Friction that "
        "reverses with the velocity's sign, and gravity, which depends on\na position that these "
        "models forget, are outside the class: a proof says that a model forgets its start, not\n"
        "that it is right. An error near 100 % is no better than the mean."
    )
    if arguments.json:
        print(json.dumps(keys))


if __name__ == "__main__":
    main()
