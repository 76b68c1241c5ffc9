"""Public data sets: what `nlsid learn` chooses, what it promises, and what it reaches on test data.

python -m benchmarks.nonlinear --data DIR [--only FOLDER ...] [--json] [--out FILE]

DIR holds exchanger, wh2009, emps, kuka_kr300, schunk_arm, f1tenth and dart. Every choice is made as
`nlsid init` makes it, at its defaults, by training data that are held out; the model is then fitted
to all of them and simulated once over the test data. Trials are as the owners divide them.

promised, promised_spread and test are in % of what the outputs vary by in the data that are judged,
as `nlsid learn` prints them: of simulations from starts that are found on the first samples, which
are not scored. score is what publications state, over all samples but those that they skip.
seconds: of processor time, of the choice and of the fit.
"""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bags.setup.ladder import STAGES, choose
from benchmarks import recorded
from benchmarks.machine import parser, tell
from benchmarks.recorded import block_means, single
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import NlsidError
from nlsid_core.identification.choosing import Choice, HeldOut, fitted
from nlsid_core.identification.prediction import Model, simulate_started

PERCENT = "%"


@dataclass(frozen=True, eq=False)
class PublicSet:
    """How one set is divided and scored.

    unit: of the score, the root mean square over all outputs and scored samples; "%" is that of
    the test outputs' spread. skipped: samples at the start of each trial that are not scored.
    published: figures with their sources. integrated: the score is of the sum of the output times
    the sample time, from the measured start. factor: from the output's unit to the score's.
    """

    name: str
    folder: str
    load: Callable[[Path], tuple[Dataset, Dataset]]
    unit: str
    published: dict[str, float]
    skipped: int = 0
    integrated: bool = False
    factor: float = 1.0

    def score(self, outputs: Sequence[FloatArray], data: Dataset, *, skipped: int) -> float:
        """The error of simulated outputs (N, n_y), the first `skipped` samples left out."""
        left, measured = [], []
        for trial, simulated in zip(data, outputs, strict=True):
            error = simulated - trial.y
            if self.integrated:
                error = np.cumsum(np.where(np.arange(len(error)) >= skipped, error[:, 0], 0.0))
                error = data.period * error[:, None]
            left.append(error[skipped:])
            measured.append(trial.y[skipped:])
        with np.errstate(over="ignore", invalid="ignore"):
            rms = float(np.sqrt(np.mean(np.square(np.concatenate(left)))))
        spread = float(np.std(np.concatenate(measured)))
        scaled = 100.0 * rms / spread if self.unit == PERCENT else self.factor * rms
        return scaled if np.isfinite(scaled) else float("inf")


def exchanger(folder: Path) -> tuple[Dataset, Dataset]:
    """The first 1500 of 4000 samples; scored on all."""
    flow, temperature = recorded.heat_exchanger(folder)
    train, test = (
        single(f"{p}", flow[p], temperature[p], 1.0) for p in (slice(0, 1500), slice(0, 4000))
    )
    return train, test


def wh2009(folder: Path) -> tuple[Dataset, Dataset]:
    """Samples 5001-100000, and the official test samples 105201-184000."""
    u, y = recorded.wiener_hammerstein(folder)
    parts = (slice(5000, 100_000), slice(105_200, 184_000))
    train, test = (single(f"{p}", u[p], y[p], 1 / 51_200) for p in parts)
    return train, test


def emps(folder: Path) -> tuple[Dataset, Dataset]:
    """Motor voltage to the velocity of the slide at 100 Hz; the pulses are the test."""
    trials = []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        table = recorded.emps(folder, name)
        q, vir = table["qm"][::10], table["vir"]
        voltage = vir[: len(vir) // 10 * 10].reshape(-1, 10).mean(axis=1)
        velocity = np.diff(q)[: len(voltage)] / 0.01  # what the sum of gives the position again
        trials.append((voltage[: len(velocity)], velocity))
    (u, y), (u_test, y_test) = trials
    return single("swept", u, y, 0.01), single("pulses", u_test, y_test, 0.01)


def kuka_first(folder: Path) -> tuple[Dataset, Dataset]:
    """The first joint's torque to velocity: trajectories A and B, C to test."""
    signals = ("act_torque_abs_nm", "act_vel_mot_deg_per_s")
    *train, test = (
        block_means(torque[0], np.deg2rad(velocity[0]), 4e-3, 2, letter)
        for letter, (torque, velocity) in recorded.kuka(folder, signals).items()
    )
    return Dataset(tuple(train)), Dataset((test,))


def schunk_first(folder: Path) -> tuple[Dataset, Dataset]:
    """The first joint: trials 1-80, 81-100 to test."""
    trials = [
        block_means(u[:, 0], y[:, 0], 4e-3, 2, str(number))
        for number, (u, y) in recorded.schunk(folder, range(1, 101)).items()
    ]
    return Dataset(tuple(trials[:80])), Dataset(tuple(trials[80:]))


def f1tenth(folder: Path) -> tuple[Dataset, Dataset]:
    """Commanded to measured speed; the test trials of the shipped configuration."""
    trials = {
        number: Trajectory(t=0.025 * np.arange(len(u)), y=motion[:, 3], u=u[:, 1], name=str(number))
        for number, (u, motion) in recorded.f1tenth_car(folder).items()
    }
    test = [5, 11, 16, 22, 27, 33, 38, 41]
    train = [trial for number, trial in trials.items() if number not in test]
    return Dataset(tuple(train)), Dataset(tuple(trials[number] for number in test))


def dart(folder: Path) -> tuple[Dataset, Dataset]:
    """Steering times speed, and speed, to the yaw rate at 20 Hz on the rubbery floor."""
    trials = []
    for name, drive in recorded.dart(folder).items():
        at = drive["vicon_time"] - drive["vicon_time"][0]
        t = np.arange(0.2, at[-1] - 0.2, 0.05)
        pose = [drive["vicon_x"], drive["vicon_y"], np.unwrap(drive["vicon_yaw"])]
        moved = [np.interp(t + 0.1, at, c) - np.interp(t - 0.1, at, c) for c in pose]
        speed = np.hypot(moved[0], moved[1]) / 0.2
        u = np.column_stack([np.interp(t - 0.1, at, drive["steering"]) * speed, speed])
        trials.append(Trajectory(t=t, y=moved[2] / 0.2, u=u, name=name))
    train = [trial for k, trial in enumerate(trials) if k % 3 < 2]
    return Dataset(tuple(train)), Dataset(tuple(trials[2::3]))


SETS = (
    PublicSet(
        "exchanger",
        "exchanger",
        exchanger,
        PERCENT,
        {
            "thesis, 5th iterate, 2 lags": 13.7,
            "3 lags": 11.4,
            "4 lags": 9.7,
            "nlarx": 26.4,
        },
    ),
    PublicSet(
        "wh2009",
        "wh2009",
        wh2009,
        "mV",
        {
            "SUBNET": 0.241,
            "block cascades": 0.28,
            "PNLSS": 0.42,
        },
        skipped=50,
        factor=1e3,
    ),
    PublicSet("EMPS", "emps", emps, "mm", {"lowest read": 2.64}, integrated=True, factor=1e3),
    PublicSet("KUKA, joint 1", "kuka_kr300", kuka_first, "rad/s", {}),
    PublicSet("Schunk, joint 1", "schunk_arm", schunk_first, "rad/s", {}),
    PublicSet("F1TENTH speed", "f1tenth", f1tenth, PERCENT, {}),
    PublicSet("DART yaw rate", "dart", dart, "rad/s", {}),
)


def fitted_to_all(choice: Choice) -> Model:
    """The model of what the rule takes, or of the next one that has a model of all data."""
    data = choice.held_out.data
    for row in choice.ranked:
        try:
            return fitted(data, row.attempt, data).model
        except NlsidError as reason:
            print(f"    {row.attempt}, fitted to all data: {reason}", flush=True)
    raise AssertionError("nothing that was tried has a model of all data")


def measure(case: PublicSet, folder: Path) -> dict[str, Any]:
    """The promised keys of one set."""
    train, test = case.load(folder / case.folder)
    started = time.process_time()
    choice = choose(HeldOut.of(train), STAGES)
    chosen = time.process_time() - started
    for row in choice.rows:
        print(f"    {row.percent:8.3g} %  {row.attempt}  {row.refusal[:60]}", flush=True)
    model = fitted_to_all(choice)
    seconds, promise = time.process_time() - started, choice.promise
    outputs = simulate_started(model, list(test), choice.held_out.start)
    spread = np.concatenate([trial.y for trial in test]).std(axis=0)
    judge = replace(choice.held_out, spread=spread)
    reached = 100.0 * math.sqrt(judge.error(model, list(test)))
    return {
        "promised": promise.percent,
        "promised_spread": [promise.low, promise.high],
        "held_out": promise.on,
        "test": reached,
        "kept": promise.low <= reached <= promise.high,
        "score": case.score(outputs, test, skipped=case.skipped),
        "unit": case.unit,
        "published": case.published,
        "chosen": str(choice.best.attempt),
        "seconds_choosing": chosen,
        "seconds": seconds,
    }


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__, data=True)
    options.add_argument("--out", type=Path, help="a file for the results, as they come")
    folders = [case.folder for case in SETS]
    options.add_argument("--only", nargs="+", choices=folders, default=folders, help="these sets")
    arguments = options.parse_args()
    rows = {}
    for case in (case for case in SETS if case.folder in arguments.only):
        print(case.name, flush=True)
        if not (arguments.data / case.folder).is_dir():
            print(f"    no folder {case.folder}")
            continue
        rows[case.name] = measure(case, arguments.data)
        if arguments.out is not None:
            files.write_atomically(arguments.out, (json.dumps(rows, indent=1) + "\n").encode())
    tell(rows, as_json=arguments.json)


if __name__ == "__main__":
    main()
