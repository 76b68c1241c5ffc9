"""The four forms of the disturbance's bound, on one motion and the same commissioning runs.

python -m benchmarks.bridge_forms --robot pendulum|arm [--seed N] [--json]

Beside them, what was measured first: the narrowest half-width of the pendulum's angle from a small
start, and how much of the arm's undisturbed inlet is kept.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from dataclasses import asdict, dataclass

import numpy as np

from bags.chain.plants import ROBOTS, Robot
from bags.chain.simulation import record_repeats
from benchmarks.bridge import TASKS, VALIDATION, compared, designed
from benchmarks.machine import describe
from nlsid_core.design import SampledTracking
from nlsid_core.design.sampled.design import assume, design_state_funnel, frame
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.sampled import FORMS
from nlsid_core.identification.states import identify_states

FIRST_FLOOR = {"response": "7", "fading": "23", "energy": "30", "peak": "81"}  # mrad, pendulum
FIRST_KEPT = {"response": ".83", "fading": ".12", "energy": ".035", "peak": "0"}  # of the arm


@dataclass(frozen=True)
class Form:
    """What one form of the assumption gives: bound, floor in mrad, part of the inlet's volume."""

    bound: float
    floor_mrad: float | None
    inlet_volume_kept: float


def compared_forms(robot: Robot, seed: int) -> dict[str, Form]:
    """The four forms on one motion and the same commissioning runs."""
    task = TASKS[robot.name]
    peak = np.array(task.peak)
    train = record_repeats(robot, peak=peak, groups=4, repeats=4, seconds=60.0, seed=seed)
    validation = record_repeats(
        robot, peak=peak, groups=VALIDATION, repeats=1, seconds=60.0, seed=seed + 100
    )
    made = designed(robot, task, identify_states(train, validation).model, seed)
    model, policy, feedback = made.design.model, made.design.policy, made.feedback
    norms = frame(model, policy, feedback)
    linear = max(
        float(np.linalg.norm(S @ A @ T, 2))
        for S, A, T in zip(norms.S[1:], norms.A, norms.T[:-1], strict=True)
    )
    found = {}
    for form in FORMS:
        rate = (1.0 + linear**2) / 2 if form == "fading" else 1.0
        assumption = assume(
            model,
            policy,
            feedback,
            made.commissioning,
            form=form,
            rate=rate,
            safety_factor=task.safety_factor,
        )
        try:
            design = design_state_funnel(
                SampledTracking(model, policy, feedback, assumption=assumption)
            )
            kept, floor = compared(design, feedback)
            found[form] = Form(assumption.bound, floor, kept)
        except Infeasible:
            found[form] = Form(assumption.bound, None, 0.0)
    return found


def print_forms(robot: Robot, found: dict[str, Form]) -> None:
    """The forms side by side, beside what was measured first."""
    print(f"{'':28s}{'floor [mrad]':>20s}{'inlet volume kept':>22s}")
    print(f"{'form':18s}{'bound':>10s}" + f"{'here':>12s}{'first':>8s}" * 2)
    for form, value in found.items():
        floor = "-" if value.floor_mrad is None else f"{value.floor_mrad:.1f}"
        floor_first = FIRST_FLOOR[form] if robot.name == "pendulum" else "-"
        kept_first = FIRST_KEPT[form] if robot.name == "arm" else "-"
        print(
            f"{form:18s}{value.bound:10.4f}{floor:>12s}{floor_first:>8s}"
            f"{value.inlet_volume_kept:12.3f}{kept_first:>8s}"
        )


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", choices=sorted(TASKS), required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    robot = ROBOTS[arguments.robot]
    found = compared_forms(robot, arguments.seed)
    print(f"{robot.name} in MuJoCo, {describe()}\n")
    print_forms(robot, found)
    if arguments.json:
        print(json.dumps({form: asdict(value) for form, value in found.items()}))


if __name__ == "__main__":
    main()
