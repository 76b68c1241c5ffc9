"""Recordings of simulated robots: repeats of an excitation, and runs of a tracking policy."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from bags.chain.joint_bags import write_joint_bag
from bags.chain.plants import PERIOD, ROBOTS, Plant, Robot
from bags.chain.tracking_config import SimulationConfig, TrackingConfig
from bags.chain.tracking_steps import feedback_of
from bags.designs import documents
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design.sampled.design import frame
from nlsid_core.errors import DataError
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.running.observer import StateObserver

TONES = 40  # sines of an excitation
LOWEST, HIGHEST = 0.05, 1.5  # Hz: slower than the robots swing, and faster


def simulate_excitations(config: TrackingConfig, out: Path) -> list[Path]:
    """Bags of the configured simulated robot under repeated excitations, in `out`."""
    robot, options = _simulated(config)
    data = record_repeats(
        robot,
        peak=np.array(options.peak),
        groups=options.groups,
        repeats=options.repeats,
        seconds=options.seconds,
        seed=options.seed,
    )
    return [write_joint_bag(out, trial, custom={"source": "MuJoCo"}) for trial in data]


def simulate_runs(design: Path, config: TrackingConfig, out: Path) -> list[Path]:
    """Commissioning bags: the policy of the folder `design` on the simulated robot, in `out`."""
    robot, options = _simulated(config)
    given = documents.load_unproved(design)
    model, policy = given.model, given.policy
    norms = frame(model, policy, feedback_of(model, policy.x, policy.u, config))
    rng = np.random.default_rng([options.seed, 1])
    written = []
    for index in range(options.runs):
        z = rng.standard_normal(len(model))
        radius = options.spread * norms.cap[0] * rng.uniform() / np.linalg.norm(z)
        start = policy.x[0] + np.linalg.solve(norms.S[0], radius * z)
        run = run_policy(robot, model, policy, seed=int(rng.integers(2**31)), start=start)
        run = replace(run, name=f"{robot.name}_run_{index}")
        written.append(write_joint_bag(out, run, custom={"source": "MuJoCo"}))
    return written


def multisine(rng: np.random.Generator, samples: int, peak: FloatArray) -> FloatArray:
    """(samples, n) sums of sines of random frequency and phase, each with its `peak` (n,)."""
    t = np.arange(samples)[:, None] * PERIOD
    columns = []
    for size in peak:
        frequency = rng.uniform(LOWEST, HIGHEST, TONES)
        wave = np.sin(2 * np.pi * (frequency * t + rng.uniform(0, 1, TONES))).sum(axis=1)
        columns.append(size * wave / np.abs(wave).max())
    return np.stack(columns, axis=1)


def record_repeats(
    robot: Robot, *, peak: FloatArray, groups: int, repeats: int, seconds: float, seed: int
) -> Dataset:
    """`groups` excitations from rest, each `repeats` times with new sensor noise."""
    runs = []
    for group in range(groups):
        u = multisine(np.random.default_rng([seed, group]), round(seconds / PERIOD), peak)
        for repeat in range(repeats):
            plant = Plant(robot, np.random.default_rng([seed, group, repeat]))
            y = np.empty((len(u), 2 * robot.joints))
            for k, torque in enumerate(u):
                y[k] = plant.measure()
                plant.step(torque)
            name = f"{robot.name}_{group}_{repeat}"
            runs.append(_trajectory(robot, y, u, name, f"excitation_{group}"))
    return Dataset(tuple(runs))


def run_policy(
    robot: Robot,
    model: StateModel,
    policy: SampledPolicy,
    *,
    seed: int,
    start: FloatArray | None = None,
) -> Trajectory:
    """One run of the policy on the robot; N + 1 samples.

    The estimate starts at `start` (default: the nominal), the robot a measurement error from it.
    """
    plant = Plant(robot, np.random.default_rng(seed))
    first = policy.x[0] if start is None else start
    plant.reset(first)
    plant.reset(2 * first - plant.measure())
    observer = StateObserver(model, policy.L)
    y, u = np.empty((len(policy) + 1, len(model))), np.zeros((len(policy) + 1, robot.joints))
    for k in range(len(policy) + 1):
        y[k] = plant.measure() if k else first
        x = observer.update(y[k], u[k - 1] if k else None)
        if k < len(policy):
            u[k] = policy(k, x)
            plant.step(u[k])
    return _trajectory(robot, y, u, f"{robot.name}_run_{seed}", "")


def _trajectory(robot: Robot, y: FloatArray, u: FloatArray, name: str, group: str) -> Trajectory:
    n = robot.joints
    content = hashlib.sha256(y.tobytes() + u.tobytes()).hexdigest()
    return Trajectory(
        t=np.arange(len(y)) * PERIOD,
        y=y,
        u=u,
        y_names=tuple(f"{kind}_{i}" for kind in ("angle", "rate") for i in range(n)),
        u_names=tuple(f"torque_{i}" for i in range(n)),
        y_units=("rad",) * n + ("rad/s",) * n,
        u_units=("N m",) * n,
        name=name,
        group=group,
        digest=f"sha256:{content}",
    )


def _simulated(config: TrackingConfig) -> tuple[Robot, SimulationConfig]:
    options = config.simulation
    if options is None:
        raise DataError(f"{config.robot} is not simulated: its configuration has no 'simulation'")
    if options.robot not in ROBOTS:
        raise DataError(f"no simulated robot '{options.robot}'; there are: {', '.join(ROBOTS)}")
    robot = ROBOTS[options.robot]
    if len(options.peak) != robot.joints:
        raise DataError(f"peak: {robot.name} has {robot.joints} joints, not {len(options.peak)}")
    return robot, options
