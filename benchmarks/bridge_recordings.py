"""Real recordings of measured states: what could be proved, what was refused, and why.

python -m benchmarks.bridge_recordings --data DIR [--json]

DIR/schunk_arm: 6 joints at 250 Hz, each joint as a robot of its own, the others its disturbance.
DIR/emps: a slide with dry friction at 1 kHz, taken at 100 Hz, its rate from central differences.
No excitation was repeated in either, so the fits are least squares. Held-out trials measure
the disturbance: its response needs any run of the robot, not one of the policy.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import logging
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from bags.chain import tracking_steps
from bags.chain.joint_bags import write_joint_bag
from bags.chain.tracking_config import TrackingConfig
from bags.designs import documents
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import NlsidError
from nlsid_core.progress import silent
from nlsid_core.proofs import check

TRIALS = 30  # of Schunk's 100: 20 to fit, 5 to choose the degrees, 5 to commission
SCHUNK_PERIOD, EMPS_PERIOD = 0.004, 0.01
REFUSE_ABOVE = 25.0  # % in free run
STAGES = ("identify", "plan", "measure and prove")


@dataclass(frozen=True)
class Result:
    """How far one robot came: free-run error in %, the stage that refused (empty: proved), why."""

    robot: str
    error: float
    refused_at: str
    said: str


def schunk(data: Path, out: Path) -> list[Path]:
    """The first trials as bags."""
    bags = []
    for index in range(1, TRIALS + 1):
        folder = data / "schunk_arm" / "Robot" / f"measurement_{index}"
        y = np.loadtxt(folder / "trajectory.csv", delimiter=",")
        u = np.loadtxt(folder / "input.csv", delimiter=",")
        bags.append(_bag(out, f"trial_{index:02d}", y[: len(u)], u, SCHUNK_PERIOD))
    return bags


def emps(data: Path, out: Path) -> list[Path]:
    """Both recordings in stretches of 6 s, as bags."""
    bags = []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        table = loadmat(data / "emps" / f"{name}.mat")
        position, voltage = (np.ravel(table[key]) for key in ("qm", "vir"))
        force = voltage * float(np.ravel(table["gtau"])[0])
        rate = np.gradient(position, 1e-3)
        samples = len(force) // 10
        y = np.stack([position, rate], axis=1)[::10][:samples]
        u = force[: 10 * samples].reshape(samples, 10).mean(axis=1)[:, None]
        for k in range(samples // 600):
            part = slice(600 * k, 600 * (k + 1))
            bags.append(_bag(out, f"{name.lower()}_{k}", y[part], u[part], EMPS_PERIOD))
    return bags


def robots(data: Path, folder: Path) -> Iterator[tuple[list[Path], TrackingConfig, int, int]]:
    """Bags, configuration, and how many bags fit and validate, per robot."""
    bags = schunk(data, folder / "schunk")
    for joint in range(6):
        yield bags, _config(f"Schunk joint {joint + 1}", joint, SCHUNK_PERIOD, bags[20:25]), 20, 5
    bags = emps(data, folder / "emps")
    yield bags, _config("EMPS slide", 0, EMPS_PERIOD, bags[3:4]), 3, 1


def attempt(
    bags: list[Path], config: TrackingConfig, fitted: int, validating: int, out: Path
) -> Result:
    """All steps; the first refusal ends it."""
    error, stage = float("nan"), STAGES[0]
    try:
        used = bags[: fitted + validating]
        fit = tracking_steps.identify_state_bags(used, config, out)
        error, stage = fit.error, STAGES[1]
        model = fit.model
        middle = np.mean(model.x_range, axis=1)
        far = model.x_range[0, 0] + 0.55 * np.ptp(model.x_range[0])
        motion = {"start": (middle[0], 0.0), "goal": (far, 0.0)}
        config = config.model_copy(update={"motion": config.motion.model_copy(update=motion)})
        tracking_steps.plan_tracking(out / documents.MODEL, config, out)
        stage = STAGES[2]
        tracking_steps.design_tracking_funnel(
            out, bags[fitted + validating :], config, progress=silent
        )
        verdict = check(out / documents.FUNNEL_PROOF)
    except NlsidError as refusal:
        return Result(config.robot, error, stage, str(refusal))
    return Result(config.robot, error, "", str(verdict))


def _bag(out: Path, name: str, y: np.ndarray, u: np.ndarray, period: float) -> Path:
    t = np.arange(len(y)) * period
    return write_joint_bag(out, Trajectory(t=t, y=y, u=u, name=name))


def _config(robot: str, joint: int, period: float, validation: list[Path]) -> TrackingConfig:
    states = [
        {"name": kind, "unit": unit, "path": f"/joint_states:{field}[{joint}]"}
        for kind, unit, field in (("position", "", "position"), ("rate", "1/s", "velocity"))
    ]
    effort = {"name": "effort", "unit": "", "path": f"/joint_commands:effort[{joint}]"}
    return TrackingConfig.model_validate(
        {
            "robot": robot,
            "signals": {"states": states, "inputs": [effort]},
            "grid": {"period": period, "max_gap": 2.5 * period},
            "identification": {
                "validation": [bag.name for bag in validation],
                "refuse_above": REFUSE_ABOVE,
                "biased_without_repeats": True,
            },
            "motion": {"start": (0.0, 0.0), "goal": (0.0, 0.0), "duration": 200 * period},
        }
    )


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    logging.getLogger("bags").setLevel(logging.ERROR)
    results = []
    with tempfile.TemporaryDirectory() as name:
        for index, (bags, config, fitted, validating) in enumerate(
            robots(arguments.data, Path(name))
        ):
            out = Path(name) / f"out_{index}"
            results.append(attempt(bags, config, fitted, validating, out))
    for result in results:
        stage = f"refused at {result.refused_at}" if result.refused_at else "proved"
        print(f"{result.robot} (free run {result.error:.3g} %), {stage}: {result.said}\n")
    if arguments.json:
        print(json.dumps({r.robot: r.refused_at or "proved" for r in results}))


if __name__ == "__main__":
    main()
