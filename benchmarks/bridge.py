"""From recordings of a robot in MuJoCo to a proved funnel, held against 1000 runs of that robot.

python -m benchmarks.bridge --robot pendulum|arm [--runs N] [--seeds N] [--json]

Beside the figures: what was measured first on these robots, and what is promised. --seeds repeats
all of it on that many seeds and gives medians. `benchmarks.bridge_forms` compares the forms of the
disturbance, `benchmarks.bridge_live` is the same through ROS.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, replace

import numpy as np

from bags.chain.plants import PERIOD, ROBOTS, Robot
from bags.chain.simulation import Push, record_repeats, run_policy
from benchmarks.machine import describe
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.design import SampledTracking
from nlsid_core.design.sampled.design import (
    TrackingDesign,
    assume,
    design_state_funnel,
    frame,
)
from nlsid_core.design.sampled.motion import Feedback, plan_motion, track, tvlqr
from nlsid_core.identification.states import free_run_error, identify_states
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.proofs import check
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Status

START = 0.97  # of the inlet's level, on which the runs start
COMMISSIONING = 30  # runs the assumption is measured on
LEVEL_OF_COMMISSIONING = 0.25  # of the undisturbed inlet's level, at most, where they start
VALIDATION = 4  # excitations of 60 s that choose the class
HEAVIER = 1.3


@dataclass(frozen=True, eq=False)
class Task:
    """What one robot is identified with and has to do; SI units, seconds.

    unseen: of the peak, the excitation of the free run, so that it stays where the data was; it is
    repeated at the whole peak. input_weight: against the state's, in units of the data box.
    """

    peak: tuple[float, ...]
    unseen: float
    goal: tuple[float, ...]
    steps: int
    push: tuple[float, ...]
    push_at: int
    safety_factor: float
    input_weight: float
    before: dict[str, str]


TASKS = {
    "pendulum": Task(
        peak=(8.0,),
        unseen=1.0,
        goal=(0.6, 0.0),
        steps=150,
        push=(60.0,),
        push_at=30,
        safety_factor=1.3,
        input_weight=0.2,
        before={"free_run_percent": "0.55", "design_seconds": "<= 30", "tube_floor_mrad": "7"},
    ),
    "arm": Task(
        peak=(4.6, 2.3),
        unseen=0.8,
        goal=(0.18, 0.22, 0.0, 0.0),
        steps=100,
        push=(10.0, 0.0),
        push_at=30,
        safety_factor=1.2,
        input_weight=0.3,
        before={
            "free_run_percent": "3.2-5.5",
            "design_seconds": "<= 90",
            "tube_floor_mrad": "-",
        },
    ),
}
PROMISED = {
    "inlet_volume_kept": ">= .9 / .8",
    "nominal_flagged_percent": "<= 3",
    "left_with_assumption_kept": "0",
    "outside_before_flagged": "0",
    "push_detect_ms": "<= 30",
    "push_lead_ms": "> 0",
    "mass_flagged_percent": "100",
    "mass_detect_ms": "<= 100",
}


@dataclass(frozen=True, eq=False)
class Made:
    """A proved funnel, its feedback, seconds of design and exact check, and processor seconds."""

    design: TrackingDesign
    feedback: Feedback
    commissioning: Dataset
    design_seconds: float
    check_seconds: float
    cpu_seconds: float


@dataclass(frozen=True)
class Outcome:
    """Of one run: the first sample not inside, the first outside (None: never), and why."""

    flagged: int | None
    outside: int | None
    assumption_kept: bool


def measure(robot: Robot, runs: int, seed: int) -> dict[str, float | int | bool | str | None]:
    """The whole chain once; errors in %, times in the unit of their name."""
    task = TASKS[robot.name]
    peak = np.array(task.peak)
    train = record_repeats(robot, peak=peak, groups=4, repeats=4, seconds=60.0, seed=seed)
    validation, test, full = (
        record_repeats(robot, peak=size, groups=groups, repeats=1, seconds=60.0, seed=other)
        for size, groups, other in (
            (peak, VALIDATION, seed + 100),
            (task.unseen * peak, 1, seed + 200),
            (peak, 1, seed + 200),
        )
    )
    started = time.perf_counter()
    fit = identify_states(train, validation)
    identify_seconds = time.perf_counter() - started
    made = designed(robot, task, fit.model, seed)
    kept, floor = compared(made.design, made.feedback)
    figures: dict[str, float | int | bool | str | None] = {
        "robot": robot.name,
        "degree": int(np.max(fit.model.exponents.sum(axis=1))),
        "free_run_percent": free_run_error(fit.model, test),
        "full_peak_free_run_percent": free_run_error(fit.model, full),
        "full_peak_in_box_percent": free_run_error(fit.model, full, in_box=True),
        "validation_percent": fit.error,
        "identify_seconds": identify_seconds,
        "funnel_seconds": made.design_seconds,
        "check_seconds": made.check_seconds,
        "design_seconds": made.design_seconds + made.check_seconds,
        "design_cpu_seconds": made.cpu_seconds,
        "box_left_percent": outside_box(fit.model, test),
        "full_peak_box_left_percent": outside_box(fit.model, full),
        "proved": True,  # `designed` raises otherwise
        "inlet_volume_kept": kept,
        "tube_floor_mrad": floor,
        "assumed_bound": made.design.funnel.assumption.bound,
        "runs": runs,
    }
    return figures | monitored(robot, task, made.design, runs, seed)


def outside_box(model: MeasuredState, dataset: Dataset) -> float:
    """% of samples outside the box of the model's data, where it claims nothing."""
    y = np.concatenate([trial.y for trial in dataset])
    outside = (y < model.x_range[:, 0]) | (y > model.x_range[:, 1])
    return 100.0 * float(outside.any(axis=1).mean())


def designed(robot: Robot, task: Task, model: MeasuredState, seed: int) -> Made:
    """The funnel with its exact proof, and how long both took."""
    x, u = plan_motion(model, np.zeros(len(model)), task.goal, steps=task.steps)
    feedback = tvlqr(model, x, u, input_weight=task.input_weight)
    policy = track(model, x, u, feedback)
    norms = frame(model, policy, feedback)
    rng = np.random.default_rng([seed, 10])
    radii = np.sqrt(LEVEL_OF_COMMISSIONING) * norms.cap[0] * rng.uniform(size=COMMISSIONING)
    commissioning = [
        run_policy(
            robot,
            model,
            policy,
            seed=seed + 20_000 + i,
            start=policy.x[0] + np.linalg.solve(norms.S[0], radius * direction(rng, len(model))),
        )
        for i, radius in enumerate(radii)
    ]
    runs = Dataset(tuple(commissioning))
    assumption = assume(model, policy, feedback, runs, safety_factor=task.safety_factor)
    started, cpu = time.perf_counter(), time.process_time()
    design = design_state_funnel(SampledTracking(model, policy, feedback, assumption=assumption))
    design_seconds = time.perf_counter() - started
    with tempfile.TemporaryDirectory() as name:
        proof = design.save(name)[-1]
        started_check = time.perf_counter()
        check(proof)
        check_seconds = time.perf_counter() - started_check
    return Made(design, feedback, runs, design_seconds, check_seconds, time.process_time() - cpu)


def compared(design: TrackingDesign, feedback: Feedback) -> tuple[float, float]:
    """Inlet volume over that without disturbance; the tube's narrowest in mrad, from a small start.

    Small: the part of the inlet that the disturbance itself fills. Narrowest: in the second half of
    the motion, when the start is forgotten.
    """
    assumption = design.funnel.assumption
    ideal = design_state_funnel(
        SampledTracking(
            design.model,
            design.policy,
            feedback,
            assumption=replace(assumption, bound=0.0, measured=0.0),
        )
    )
    small = design_state_funnel(
        SampledTracking(
            design.model, design.policy, feedback, assumption=assumption, start=assumption.bound
        )
    )
    ratio = float(design.funnel.inlet[0] / ideal.funnel.inlet[0])
    widths = small.funnel.half_widths[:, 0]
    width = float(np.min(widths[len(widths) // 2 :]))
    return ratio ** len(design.model), 1e3 * width


def monitored(
    robot: Robot, task: Task, design: TrackingDesign, runs: int, seed: int
) -> dict[str, float | int | None]:
    """What the monitor says of runs as they should be, pushed, and with more mass.

    None where nothing happened that could be timed: no run left the tube, or none was flagged.
    """
    push = Push(np.array(task.push), task.push_at, 2)
    few = max(1, runs // 5)
    rng = np.random.default_rng([seed, 30])
    nominal = [outcome(robot, design, rng, seed + 30_000 + i) for i in range(runs)]
    pushed = [outcome(robot, design, rng, seed + 40_000 + i, push=push) for i in range(few)]
    heavy = [outcome(robot, design, rng, seed + 50_000 + i, mass=HEAVIER) for i in range(few)]
    everything = nominal + pushed + heavy
    to_ms = 1e3 * PERIOD
    after_push = [o.flagged - task.push_at for o in pushed if o.flagged is not None]
    leads = [
        o.outside - o.flagged for o in pushed if o.outside is not None and o.flagged is not None
    ]
    mass_times = [o.flagged for o in heavy if o.flagged is not None]
    return {
        "nominal_flagged_percent": 100.0 * sum(o.flagged is not None for o in nominal) / runs,
        "left_with_assumption_kept": sum(o.assumption_kept for o in everything),
        "outside_before_flagged": sum(
            o.outside is not None and (o.flagged is None or o.flagged > o.outside)
            for o in everything
        ),
        "pushed_runs": few,
        "push_flagged_percent": 100.0 * len(after_push) / few,
        "push_detect_ms": to_ms * max(after_push) if after_push else None,
        "push_left_tube": len(leads),
        "push_lead_ms": to_ms * min(leads) if leads else None,
        "mass_flagged_percent": 100.0 * len(mass_times) / few,
        "mass_detect_ms": to_ms * float(np.median(mass_times)) if mass_times else None,
    }


def outcome(
    robot: Robot,
    design: TrackingDesign,
    rng: np.random.Generator,
    seed: int,
    *,
    push: Push | None = None,
    mass: float = 1.0,
) -> Outcome:
    """One run from 0.97 of the inlet's level, as the monitor reads it."""
    funnel, policy = design.funnel, design.policy
    size = np.sqrt(START) * funnel.inlet[0]
    start = policy.x[0] + np.linalg.solve(funnel.S[0], size * direction(rng, len(design.model)))
    run = run_policy(
        robot, design.model, policy, seed=seed, start=start, push=push, mass_scale=mass
    )
    monitor = Monitor(design.model, policy, funnel)
    flagged = outside = None
    kept = False
    for k in range(len(run)):
        reading = monitor.update(float(run.t[k]), run.y[k], run.u[k])
        if reading.status is not Status.INSIDE and flagged is None:
            flagged = k
        if reading.status is Status.OUTSIDE and outside is None:
            outside, kept = k, "assumption was kept" in reading.reason
    return Outcome(flagged, outside, kept)


def direction(rng: np.random.Generator, n: int) -> FloatArray:
    """A random unit vector."""
    z = rng.standard_normal(n)
    return np.asarray(z / np.linalg.norm(z))


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", choices=sorted(TASKS), required=True)
    parser.add_argument("--runs", type=int, default=1000, help="as they should be; a fifth each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1, help="how many, from --seed on")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    robot = ROBOTS[arguments.robot]
    print(f"{robot.name} in MuJoCo, {describe()}\n")
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    columns = [measure(robot, arguments.runs, seed) for seed in seeds]
    first = TASKS[robot.name].before | PROMISED
    titles = [f"seed {seed}" for seed in seeds]
    print(f"{'':28s}{'before or promised':>23s}{'median':>10s}", *[f"{t:>9s}" for t in titles])
    for key in columns[0]:
        values = [column[key] for column in columns]
        numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
        median = f"{np.median(numbers):.4g}" if numbers else ""
        shown = [f"{_shown(value):>9s}" for value in values]
        print(f"{key:28s}{first.get(key, ''):>23s}{median:>10s}", *shown)
    if arguments.json:
        print(json.dumps(columns[0] if len(columns) == 1 else columns))


def _shown(value: float | bool | str | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
