"""`identify_block_cascade`: datasets in, a stable block cascade with its proof out.

Random starts on a part of the data, then all of it; the number of phases and of knots are
chosen by the simulation error on validation data.
"""

from dataclasses import dataclass, replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, ShapeError
from nlsid_core.identification.fit import Step
from nlsid_core.identification.network.cascade_fit import MAX_RADIUS, Parameters, Trial, minimise
from nlsid_core.identification.network.cascade_starts import (
    best_start,
    mean_square,
    with_intervals,
    with_phases,
)
from nlsid_core.identification.network.options import FilterMapFilter, Network
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.models import BlockCascade
from nlsid_core.models.signal import signals_of
from nlsid_core.progress import Progress, silent

STEPS = 40
TOLERANCE = 1e-3  # relative gain of a step below which a choice of knots and phases is judged
FINAL_STEPS, FINAL_TOLERANCE = 40, 1e-5
START_SAMPLES = 10_000  # of each trial, for the starts
SMOOTHING = 1e-8  # of the spline
START_COEFFICIENTS = 15  # of f, at the start


@dataclass(frozen=True, eq=False)
class Choice:
    """What was fitted with a number of phases and of knots, and its rms errors in y's unit."""

    parameters: Parameters
    train_rms: float
    validation_rms: float

    def __str__(self) -> str:
        M = len(self.parameters.b1)
        phases = "1 phase" if M == 1 else f"{M} phases"
        return f"{phases}, {self.parameters.f.intervals} intervals"


def identify_block_cascade(
    train: Dataset,
    validation: Dataset,
    model_class: Network[FilterMapFilter],
    *,
    whole: Dataset | None = None,
    transient: int = 0,
    slowest: float = MAX_RADIUS,
    progress: Progress = silent,
) -> tuple[BlockCascade, StabilityProof, tuple[Step, ...]]:
    """A `BlockCascade` by simulation error, proved stable, and the rms errors of the choices.

    whole: trials to which what was chosen is fitted again (None: it stays fitted to `train`).
    transient: samples at the start of each trajectory that are simulated and not scored. slowest:
    radius of the filters' poles, at most.
    Raises ShapeError for several inputs or outputs, DataError on too little or constant data,
    Infeasible if the minimum found has no proof.
    """
    made = model_class.structure
    orders, phases, intervals, starts = made.orders, made.phases, made.intervals, made.starts
    scales = _scales(train)
    fitted, judged = (_trials(data, scales, transient, model_class) for data in (train, validation))
    needed = 2 * (sum(orders) + 2) + START_COEFFICIENTS
    if sum(len(trial.y) - trial.transient for trial in fitted) < needed:
        raise DataError(f"fewer than {needed} scored samples for orders {orders}; give more data")
    first = best_start(
        tuple(_shortened(trial, START_SAMPLES) for trial in fitted),
        orders,
        smoothing=SMOOTHING,
        starts=starts,
        rng=np.random.default_rng(model_class.seed),
        radius=slowest,
    )
    total = len(phases) * len(intervals) + 2
    progress(f"best of {starts} starts", 1 / total)
    single = minimise(
        fitted,
        with_intervals(first, fitted, intervals[0]),
        smoothing=SMOOTHING,
        steps=STEPS,
        tolerance=TOLERANCE,
        radius=slowest,
    ).parameters
    tried: list[Choice] = []
    for M in phases:
        base = single if M == 1 else with_phases(single, fitted, M)
        coarser = float("inf")
        for K in intervals:
            base = with_intervals(base, fitted, K)
            finer = _choice(base, fitted, judged, scales[1], radius=slowest)
            tried.append(finer)
            progress(f"{M} phases, {K} intervals", (len(tried) + 1) / total)
            if finer.validation_rms > coarser:
                break  # finer knots still would fit noise
            coarser, base = finer.validation_rms, finer.parameters
    history = [Step(str(choice), choice.validation_rms) for choice in tried]
    best = min(tried, key=lambda choice: choice.validation_rms)
    polished = _choice(
        best.parameters,
        fitted,
        judged,
        scales[1],
        steps=FINAL_STEPS,
        tolerance=FINAL_TOLERANCE,
        radius=slowest,
    )
    history.append(Step(f"{polished}, minimised further", polished.validation_rms))
    parameters = min(best, polished, key=lambda choice: choice.validation_rms).parameters
    if whole is not None:
        progress("fitted to all trials", 1.0 - 1.0 / total)
        all_trials = _trials(whole, scales, transient, model_class)
        refitted = _choice(
            with_intervals(parameters, all_trials, parameters.f.intervals),
            all_trials,
            all_trials,
            scales[1],
            steps=FINAL_STEPS,
            tolerance=FINAL_TOLERANCE,
            radius=slowest,
        )
        parameters = refitted.parameters
        history.append(Step("fitted to all trials, training error", refitted.train_rms))
    progress("minimised further", 1.0)
    model = _model(parameters, scales, train)
    proof = prove_stability(model)
    if proof is None:
        radius = max(float(np.abs(poles).max(initial=0.0)) for poles in model.poles)
        raise Infeasible(
            f"no proof for the minimum found (slowest pole {radius:.6f}); try lower orders, "
            "more starts or more data"
        )
    return model, proof, tuple(history)


def _choice(
    start: Parameters,
    fitted: tuple[Trial, ...],
    judged: tuple[Trial, ...],
    unit: float,
    *,
    radius: float,
    steps: int = STEPS,
    tolerance: float = TOLERANCE,
) -> Choice:
    found = minimise(
        fitted, start, smoothing=SMOOTHING, steps=steps, tolerance=tolerance, radius=radius
    )
    validation = mean_square(found.parameters, judged)
    return Choice(found.parameters, unit * found.cost**0.5, unit * validation**0.5)


def _scales(train: Dataset) -> tuple[float, float]:
    """Spread of the input and of the output over all trials."""
    first = train.trajectories[0]
    if first.u.shape[1] != 1 or first.y.shape[1] != 1:
        raise ShapeError(
            f"a block cascade has one input and one output; the data have {first.u.shape[1]} and "
            f"{first.y.shape[1]}"
        )
    u, y = (np.concatenate([getattr(t, key)[:, 0] for t in train]) for key in ("u", "y"))
    if np.ptp(u) == 0 or np.ptp(y) == 0:
        raise DataError("the input or the output is constant in all trials: nothing to identify")
    return float(u.std()), float(y.std())


def _trials(
    data: Dataset,
    scales: tuple[float, float],
    transient: int,
    model_class: Network[FilterMapFilter],
) -> tuple[Trial, ...]:
    from_rest = model_class.structure.begin == "rest"
    skipped = (
        transient if from_rest else max(transient, model_class.structure.orders[1])
    )  # given, not made
    for trajectory in data:
        if transient < 0 or len(trajectory) <= 3 * skipped:
            raise DataError(
                f"{trajectory.name or 'trajectory'}: {len(trajectory)} samples with a transient "
                f"of {skipped}; give more than three times as many"
            )
    return tuple(
        Trial(t.u[:, 0] / scales[0], t.y[:, 0] / scales[1], skipped, from_rest) for t in data
    )


def _shortened(trial: Trial, samples: int) -> Trial:
    return replace(trial, u=trial.u[:samples], y=trial.y[:samples])


def _model(parameters: Parameters, scales: tuple[float, float], train: Dataset) -> BlockCascade:
    """Scaling undone: the only place where it is."""
    first = train.trajectories[0]
    b1: FloatArray = parameters.b1 / scales[0]
    return BlockCascade(
        a1=parameters.a1,
        b1=b1,
        f=parameters.f,
        a2=parameters.a2,
        b2=parameters.b2 * scales[1],
        period=train.period,
        y=signals_of(first, "y")[0],
        u=signals_of(first, "u")[0],
        bags=train.bags,
    )
