"""The steps for a measured state and its motion: each takes files and writes what it made."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bags.chain.joint_bags import write_joint_bag
from bags.chain.plants import ROBOTS, Robot
from bags.chain.simulation import record_repeats, run_policy
from bags.chain.tracking_config import SimulationConfig, TrackingConfig
from bags.designs import documents
from bags.designs.design import SampledDesign
from bags.designs.documents import Proved
from bags.monitoring.catching import Breaking, breaking
from bags.monitoring.replay import replay_messages
from bags.monitoring.watch import WAITING
from bags.pictures.report import report_available
from bags.signals.grid import read_dataset
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import SampledTracking, design
from nlsid_core.design.sampled.design import TrackingDesign, assume, frame
from nlsid_core.design.sampled.motion import Feedback, follow_motion, plan_motion, track, tvlqr
from nlsid_core.errors import CertificateMismatch, DataError
from nlsid_core.identification.states import StateFit, identify_states
from nlsid_core.models.measured_state import MeasuredState, read_measured_state
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.progress import Progress
from nlsid_core.running.assumption import disturbance_of, meter_of
from nlsid_core.running.monitor import OVER
from nlsid_core.running.reading import Reading


def read_states(bags: Sequence[Path], config: TrackingConfig) -> Dataset:
    """The configured states (as y) and inputs of bags, with their names and units."""
    signals = config.signals
    data = read_dataset(
        bags,
        responses=[signal.path for signal in signals.states],
        excitations=[signal.path for signal in signals.inputs],
        grid=config.grid.rules(config.clock),
    )
    labelled = [
        replace(
            trial,
            y_names=tuple(signal.name for signal in signals.states),
            y_units=tuple(signal.unit for signal in signals.states),
            u_names=tuple(signal.name for signal in signals.inputs),
            u_units=tuple(signal.unit for signal in signals.inputs),
        )
        for trial in data
    ]
    return Dataset(tuple(labelled))


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


def identify_state_bags(bags: Sequence[Path], config: TrackingConfig, out: Path) -> StateFit:
    """Bags in, model.json and free_run.png in `out`; DataError if no class describes the data.

    This picture and those of the other steps are drawn where the extra `report` is installed.
    """
    data, options = read_states(bags, config), config.identification
    validation = data.select(options.validation)
    fit = identify_states(
        data.without(options.validation),
        validation,
        degrees=options.degrees,
        refuse_above=options.refuse_above,
        biased_without_repeats=options.biased_without_repeats,
        implicit=options.implicit,
    )
    files.write_document(out / documents.MODEL, fit.model.document())
    if report_available():
        from bags.pictures import plots, tracking_plots  # matplotlib only where something is drawn

        drawn = tracking_plots.draw_free_run(fit.model, validation)
        plots.write_png(out / documents.FREE_RUN_PLOT, drawn)
    return fit


def plan_tracking(model_path: Path, config: TrackingConfig, out: Path) -> SampledPolicy:
    """model.json in, policy.json and motion.png in `out`: a motion in the data's box."""
    model, motion = load_state_model(model_path), config.motion
    if motion.samples is not None:
        x, u = follow_motion(model, _read_samples(motion.samples, model))
    else:
        assert motion.start is not None
        assert motion.goal is not None
        assert motion.duration is not None  # the configuration has checked that
        steps = round(motion.duration / model.period)
        x, u = plan_motion(model, motion.start, motion.goal, steps=steps)
    policy = track(model, x, u, _feedback(model, x, u, config))
    files.write_document(out / documents.POLICY, policy.document())
    if report_available():
        from bags.pictures import plots, tracking_plots

        plots.write_png(out / documents.MOTION_PLOT, tracking_plots.draw_motion(model, policy))
    return policy


def simulate_runs(design: Path, config: TrackingConfig, out: Path) -> list[Path]:
    """Commissioning bags: the policy of the folder `design` on the simulated robot, in `out`."""
    robot, options = _simulated(config)
    model, policy = _load_pair(design)
    norms = frame(model, policy, _feedback(model, policy.x, policy.u, config))
    rng = np.random.default_rng([options.seed, 1])
    written = []
    for index in range(options.runs):
        z = rng.standard_normal(len(model))
        radius = options.spread * norms.cap[0] * rng.uniform() / np.linalg.norm(z)
        start = policy.x[0] + np.linalg.solve(norms.S[0], radius * z)
        seed = int(rng.integers(2**31))
        run = run_policy(robot, model, policy, seed=seed, start=start)
        run = replace(run, name=f"{robot.name}_run_{index}")
        written.append(write_joint_bag(out, run, custom={"source": "MuJoCo"}))
    return written


def design_tracking_funnel(
    folder: Path, runs: Sequence[Path], config: TrackingConfig, *, progress: Progress
) -> TrackingDesign:
    """model.json, policy.json, commissioning bags in; funnel.json, funnel.proof.json, funnel.png.

    Raises DataError, Infeasible or CertificateRejected, saying what is in the way.
    """
    model, policy = _load_pair(folder)
    feedback = _feedback(model, policy.x, policy.u, config)
    if not np.array_equal(feedback.K, policy.K):
        raise DataError("policy.json was made with other weights than this configuration's")
    options, recorded = config.disturbance, read_states(runs, config)
    assumption = assume(
        model,
        policy,
        feedback,
        recorded,
        form=options.form,
        safety_factor=options.safety_factor,
        rate=options.rate,
    )
    problem = SampledTracking(model, policy, feedback, assumption)
    made = design(problem, progress=progress)
    made.save(folder)
    if report_available():
        from bags.pictures import plots, tracking_plots

        drawn = tracking_plots.draw_funnel(model, policy, made.funnel, recorded)
        plots.write_png(folder / documents.FUNNEL_PLOT, drawn)
    return made


def widest_start(made: TrackingDesign, runs: Dataset) -> float:
    """How far out of the inlet's boundary, 1, the runs started at most."""
    first = [trial.y[0] - made.policy.x[0] for trial in runs]
    radius = float(made.funnel.inlet[0])
    return max(made.funnel.norm(0, x_bar) / radius for x_bar in first)


def what_breaks(made: TrackingDesign, runs: Dataset) -> Breaking:
    """By fault, how many of these runs' copies that have it break the proof's assumption."""
    meter = meter_of(made.funnel)

    def used(run: Trajectory) -> float:
        sizes = disturbance_of(made.model, made.policy, run, meter)
        return float(np.max(sizes)) / made.funnel.assumption.bound

    return breaking(runs, used)


def replay_run(proved: Proved[SampledDesign], bag: Path) -> list[Reading]:
    """Every sample of one bag held against the funnel, message by message as they are live.

    Runs begin where a controller announced them in the bag; without an announcement the first
    state is sample 0. What was before a run, and after its end, is left out.
    """
    said = [entry.reading for entry in replay_messages(proved.design, bag)]
    return [r for r in said if not r.reason.startswith((WAITING, OVER))]


def load_state_model(path: Path) -> MeasuredState:
    """Read a model file; DocumentError says what is wrong with it."""
    return read_measured_state(files.load_document(path), source=path.name)


def _read_samples(path: Path, model: MeasuredState) -> FloatArray:
    """(N + 1, n) from a CSV file headed by the states' names; DataError says what is wrong."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    names = [signal.name for signal in model.x]
    if not rows or [name.strip() for name in rows[0]] != names:
        raise DataError(f"{path}: the first row should be {','.join(names)}; it is {rows[:1]}")
    try:
        return np.array([[float(value) for value in row] for row in rows[1:] if row])
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def _load_pair(folder: Path) -> tuple[MeasuredState, SampledPolicy]:
    model = load_state_model(folder / documents.MODEL)
    policy = SampledPolicy.from_document(
        files.load_document(folder / documents.POLICY), source=documents.POLICY
    )
    if policy.model != files.digest(model.document()):
        raise CertificateMismatch(f"{documents.POLICY} was made for another model")
    return model, policy


def _feedback(
    model: MeasuredState, x: np.ndarray, u: np.ndarray, config: TrackingConfig
) -> Feedback:
    motion = config.motion
    return tvlqr(model, x, u, state_weight=motion.state_weight, input_weight=motion.input_weight)


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
