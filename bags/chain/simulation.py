"""Recordings of simulated robots: repeats of an excitation, and runs of a tracking policy."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bags.chain.joint_bags import write_joint_bag
from bags.chain.plants import PERIOD, Plant
from bags.chain.tracking_config import SimulationConfig, TrackingConfig
from bags.chain.tracking_steps import feedback_of
from bags.designs import documents
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.design.sampled.design import frame
from nlsid_core.errors import DataError
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.running.observer import StateObserver

TONES = 40  # sines of an excitation
LOWEST, HIGHEST = 0.05, 1.5  # Hz: slower than the robots swing, and faster
SOURCE = {"source": "MuJoCo"}  # custom data of the bags


def simulate_excitations(config: TrackingConfig, out: Path) -> list[Path]:
    """Bags of the configured simulated robot under repeated excitations, in `out`."""
    repeats = record_repeats(_simulated(config))
    return [write_joint_bag(out, run, custom=SOURCE) for run in repeats]


def simulate_runs(design: Path, config: TrackingConfig, out: Path) -> list[Path]:
    """Commissioning bags: the policy of the folder `design` on the simulated robot, in `out`."""
    options = _simulated(config)
    given = documents.load_unproved(design)
    model, policy = given.model, given.policy
    norms = frame(model, policy, feedback_of(model, policy.x, policy.u, config))
    rng = np.random.default_rng([options.seed, 1])
    written = []
    for index in range(options.runs):
        z = rng.standard_normal(len(model))
        radius = options.spread * norms.cap[0] * rng.uniform() / np.linalg.norm(z)
        start = policy.x[0] + np.linalg.solve(norms.S[0], radius * z)
        plant = Plant(options.robot, np.random.default_rng(int(rng.integers(2**31))))
        y, u = run_policy(plant, model, policy, start)
        name = f"{options.robot}_run_{index}"
        written.append(write_joint_bag(out, _trajectory(y, u, name), custom=SOURCE))
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


def record_repeats(options: SimulationConfig) -> Iterator[Trajectory]:
    """Excitations from rest, each repeated with new sensor noise."""
    samples = round(options.seconds / PERIOD)
    for group in range(options.groups):
        rng = np.random.default_rng([options.seed, group])
        u = multisine(rng, samples, np.array(options.peak))
        for repeat in range(options.repeats):
            plant = Plant(options.robot, np.random.default_rng([options.seed, group, repeat]))
            y = np.empty((len(u), 2 * plant.joints))
            for k, torque in enumerate(u):
                y[k] = plant.measure()
                plant.step(torque)
            name = f"{options.robot}_{group}_{repeat}"
            yield _trajectory(y, u, name, f"excitation_{group}")


def run_policy(
    plant: Plant, model: StateModel, policy: SampledPolicy, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One run of the policy on the robot: N + 1 samples of the state, and of the torques.

    The estimate starts at `start`, the robot a measurement error from it.
    """
    plant.reset(start)
    plant.reset(2 * start - plant.measure())
    observer = StateObserver(model, policy.L)
    y, u = np.empty((len(policy) + 1, len(model))), np.zeros((len(policy) + 1, plant.joints))
    for k in range(len(policy) + 1):
        y[k] = plant.measure() if k else start
        x = observer.update(y[k], u[k - 1] if k else None)
        if k < len(policy):
            u[k] = policy(k, x)
            plant.step(u[k])
    return y, u


def _trajectory(y: FloatArray, u: FloatArray, name: str, group: str = "") -> Trajectory:
    return Trajectory(t=np.arange(len(y)) * PERIOD, y=y, u=u, name=name, group=group)


def _simulated(config: TrackingConfig) -> SimulationConfig:
    options = config.simulation
    if options is None:
        raise DataError(f"{config.robot} is not simulated: its configuration has no 'simulation'")
    joints = Plant(options.robot, np.random.default_rng()).joints
    if len(options.peak) != joints:
        raise DataError(f"peak: {options.robot} has {joints} joints, not {len(options.peak)}")
    return options
