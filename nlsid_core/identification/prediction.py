"""Simulation and k-step prediction of any identified model, trial by trial, without time loops
over single predictions: all starts advance together.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.polynomial.rollout import simulate_together
from nlsid_core.models import (
    BlockCascade,
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    StableModel,
    StateAffineModel,
)
from nlsid_core.models.monotone_equation import solve_increasing
from nlsid_core.models.starts import nearest_start

Model = StableModel
# [y(t-1), y(t-2), …], each (T, n_y), and the rows t they belong to -> y(t), (T, n_y)
Step = Callable[[list[FloatArray], slice], FloatArray]


def history(model: Model) -> int:
    """How many measured samples start a simulation: a block cascade's second filter, a network's
    hidden states.
    """
    if isinstance(model, BlockCascade):
        return len(model.a2)
    if isinstance(model, CellNetwork):
        return model.start_samples
    return model.history if isinstance(model, MonotoneEquation | ImplicitModel) else len(model)


def learns(model: Model) -> bool:
    """Whether outputs after the first n change what the model predicts.

    Not of a block cascade or a network: their noise is that of the measurement.
    """
    return not isinstance(model, BlockCascade | CellNetwork)


def simulate_trial(model: Model, trial: Trajectory) -> FloatArray:
    """(N, n_y) outputs, from the first measured outputs with the recorded inputs.

    The input of a block cascade's first filter is held at its first value before the trial.
    """
    n = history(model)
    if isinstance(model, StateAffineModel | CellNetwork):
        return model.simulate(trial.u, trial.y[:n])
    if isinstance(model, BlockCascade):
        return model.simulate(trial.u[:, 0], trial.y[:n, 0])[:, None]
    if isinstance(model, ImplicitModel):
        return simulate_together(model, [trial])[0]
    u = trial.u if isinstance(model, MonotoneEquation) else trial.u[:, 0]
    return model.simulate(u, trial.y[:n, 0])[:, None]


def simulate_started(model: Model, trial: Trajectory, samples: int) -> FloatArray:
    """`simulate_trial` from the start that is nearest to the first samples of the trial."""
    n = history(model)
    if isinstance(model, CellNetwork):
        return model.simulate(trial.u, trial.y[: samples or n])
    if samples <= n:
        return simulate_trial(model, trial)
    beginning = trial.rows(slice(samples))

    def simulated(starts: FloatArray) -> FloatArray:
        return np.stack([simulate_trial(model, _from(start, beginning)) for start in starts])

    return simulate_trial(model, _from(nearest_start(simulated, beginning.y, n), trial))


def _from(start: FloatArray, trial: Trajectory) -> Trajectory:
    """The trial with other first outputs (n, p)."""
    return replace(trial, y=np.concatenate([start, trial.y[len(start) :]]))


def simulate_trials(model: Model, trials: Sequence[Trajectory]) -> list[FloatArray]:
    """`simulate_trial` of each; implicit models solve all trials together."""
    if isinstance(model, ImplicitModel):
        return simulate_together(model, trials)
    return [simulate_trial(model, trial) for trial in trials]


def predict(model: Model, trial: Trajectory, horizon: int) -> FloatArray:
    """(N - n - horizon + 1, n_y): ŷ(t) from measurements up to t - horizon, t = n + horizon - 1 ….

    n is the model's history. A model that does not learn (`learns`) predicts what it simulates.
    Raises DataError if the horizon is not positive or the trial is too short.
    """
    n, N = history(model), len(trial)
    if horizon < 1 or n + horizon > N:
        raise DataError(f"{trial.name}: a horizon of {horizon} needs 1 to {N - n} samples")
    if isinstance(model, BlockCascade | CellNetwork):  # those that do not learn
        return simulate_trial(model, trial)[n + horizon - 1 :]
    step, lags = _step(model, trial)
    starts = N - n - horizon + 1
    past = [trial.y[n - k : n - k + starts] for k in range(1, lags + 1)]
    predicted = past[0]
    for ahead in range(horizon):
        predicted = step(past, slice(ahead, ahead + starts))
        past = [predicted, *past[:-1]]
    return predicted


def one_step_residual(model: Model, trial: Trajectory) -> FloatArray:
    """(N - n, n_y): y(t) minus its prediction one sample ahead."""
    return np.asarray(trial.y[history(model) :] - predict(model, trial, 1))


def _step(
    model: DifferenceEquation | StateAffineModel | MonotoneEquation | ImplicitModel,
    trial: Trajectory,
) -> tuple[Step, int]:
    """One step of the model at rows t = n …, in the outputs' units, and its number of lags."""
    if isinstance(model, MonotoneEquation):
        return _monotone_step(model, trial), len(model)
    if isinstance(model, ImplicitModel):
        return _implicit_step(model, trial), model.lags
    gains, forcing = _explicit(model, trial)

    def step(past: list[FloatArray], rows: slice) -> FloatArray:
        stacked = np.concatenate(past, axis=1)
        return np.asarray(np.einsum("tij,tj->ti", gains[rows], stacked) + forcing[rows])

    return step, len(model)


def _explicit(
    model: DifferenceEquation | StateAffineModel, trial: Trajectory
) -> tuple[FloatArray, FloatArray]:
    """y(t) = gains(t) [y(t-1); …; y(t-n)] + forcing(t) in the outputs' units, t = n …."""
    n, N = len(model), len(trial)
    if isinstance(model, DifferenceEquation):
        gains = np.broadcast_to(model.a, (N - n, 1, n))
        forcing = np.asarray(lfilter(model.b, [1.0], trial.u[:, 0])[n:, None] + model.c)
        return gains, forcing
    gains, forcing = model.explicit(model.windows(trial.u))
    scale, offset = model.y_scale, model.y_offset
    gains = gains * scale[:, None] / np.tile(scale, n)
    return gains, forcing * scale + offset - gains @ np.tile(offset, n)


def _monotone_step(model: MonotoneEquation, trial: Trajectory) -> Step:
    forcing, e = model.forcing(trial.u), tuple(model.e.tolist())

    def step(past: list[FloatArray], rows: slice) -> FloatArray:
        target = forcing[rows] + sum(
            a * (y[:, 0] - model.y_offset) for a, y in zip(model.a, past, strict=True)
        )
        pairs = zip(target.tolist(), past[0][:, 0].tolist(), strict=True)
        found = [solve_increasing(e, value, guess - model.y_offset) for value, guess in pairs]
        return np.array(found)[:, None] + model.y_offset

    return step


def _implicit_step(model: ImplicitModel, trial: Trajectory) -> Step:
    w = model.windows(trial.u)

    def step(past: list[FloatArray], rows: slice) -> FloatArray:
        return model.step(np.concatenate(past, axis=1), w[rows])[:, : model.unknowns]

    return step
