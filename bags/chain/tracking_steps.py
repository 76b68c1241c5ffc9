"""The steps for a measured state and its motion: each takes files and writes what it made."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bags.chain.steps import read_signals_of
from bags.chain.tracking_config import TrackingConfig
from bags.designs import documents
from bags.pictures.report import report_available
from nlsid_core import files
from nlsid_core.data.trajectory import Dataset
from nlsid_core.design import SampledTracking, design
from nlsid_core.design.sampled.design import TrackingDesign, assume
from nlsid_core.design.sampled.motion import Feedback, plan_motion, track, tvlqr
from nlsid_core.errors import DataError
from nlsid_core.identification.states import StateFit, identify_states
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.progress import Progress


def identify_state_bags(bags: Sequence[Path], config: TrackingConfig, out: Path) -> StateFit:
    """Bags in, model.json and free_run.png in `out`; DataError if no class describes the data.

    This picture and those of the other steps are drawn where the extra `report` is installed.
    """
    data, options = read_signals_of(bags, config), config.identification
    validation = data.select(options.validation)
    fit = identify_states(data.without(options.validation), validation, degrees=options.degrees)
    files.write_document(out / documents.MODEL, fit.model.document())
    if report_available():
        from bags.pictures import plots, tubes  # matplotlib only where something is drawn

        plots.write_png(out / documents.FREE_RUN_PLOT, tubes.draw_free_run(fit.model, validation))
    return fit


def plan_tracking(fit: StateFit, config: TrackingConfig, out: Path) -> SampledPolicy:
    """A fitted model in, policy.json in `out`: a motion in the data's box, and its feedback."""
    model, motion = fit.model, config.motion
    steps = round(motion.duration / model.period)
    x, u = plan_motion(model, motion.start, motion.goal, steps=steps)
    policy = track(model, x, u, feedback_of(model, x, u, config))
    files.write_document(out / documents.POLICY, policy.document())
    return policy


def design_tracking_funnel(
    folder: Path, runs: Sequence[Path], config: TrackingConfig, *, progress: Progress
) -> TrackingDesign:
    """model.json, policy.json, commissioning bags in; funnel.json and funnel.proof.json.

    Raises DataError, Infeasible or CertificateRejected, saying what is in the way.
    """
    given = documents.load_unproved(folder)
    model, policy = given.model, given.policy
    feedback = feedback_of(model, policy.x, policy.u, config)
    if not np.array_equal(feedback.K, policy.K):
        raise DataError("policy.json was made with other weights than this configuration's")
    recorded, factor = read_signals_of(runs, config), config.disturbance.safety_factor
    assumption = assume(model, policy, feedback, recorded, safety_factor=factor)
    made = design(SampledTracking(model, policy, feedback, assumption), progress=progress)
    made.save(folder)
    return made


def widest_start(made: TrackingDesign, runs: Dataset) -> float:
    """How far out of the inlet's boundary, 1, the runs started at most."""
    first = [trial.y[0] - made.policy.x[0] for trial in runs]
    return max(made.funnel.norm(0, x_bar) / float(made.funnel.inlet[0]) for x_bar in first)


def feedback_of(
    model: StateModel, x: np.ndarray, u: np.ndarray, config: TrackingConfig
) -> Feedback:
    """The time-varying LQR of the configured weights around a motion (x, u)."""
    motion = config.motion
    return tvlqr(model, x, u, state_weight=motion.state_weight, input_weight=motion.input_weight)
