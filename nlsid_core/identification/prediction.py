"""Simulation and k-step prediction of any identified model, trial by trial, without time loops
over single predictions: all starts advance together.
"""

import numpy as np
from scipy.signal import lfilter

from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.models import DifferenceEquation, MonotoneEquation, StateAffineModel
from nlsid_core.trajectory import Trajectory

Model = DifferenceEquation | StateAffineModel
Simulated = Model | MonotoneEquation


def history(model: Simulated) -> int:
    """How many measured outputs start a simulation."""
    return model.history if isinstance(model, MonotoneEquation) else len(model)


def simulate_trial(model: Simulated, trial: Trajectory) -> FloatArray:
    """(N, n_y) outputs, from the first measured outputs with the recorded inputs."""
    n = history(model)
    if not isinstance(model, StateAffineModel):
        return model.simulate(trial.u[:, 0], trial.y[:n, 0])[:, None]
    return model.simulate(trial.u, trial.y[:n])


def predict(model: Model, trial: Trajectory, horizon: int) -> FloatArray:
    """(N - n - horizon + 1, n_y): ŷ(t) from measurements up to t - horizon, t = n + horizon - 1 ….

    Raises DataError if the horizon is not positive or the trial is too short.
    """
    n, N = len(model), len(trial)
    if horizon < 1 or n + horizon > N:
        raise DataError(f"{trial.name}: a horizon of {horizon} needs 1 to {N - n} samples")
    gains, forcing = _explicit(model, trial)
    starts = N - n - horizon + 1
    lags = [trial.y[n - k : n - k + starts] for k in range(1, n + 1)]
    for step in range(horizon):
        rows = slice(step, step + starts)
        past = np.concatenate(lags, axis=1)
        predicted: FloatArray = np.einsum("tij,tj->ti", gains[rows], past) + forcing[rows]
        lags = [predicted, *lags[:-1]]
    return predicted


def one_step_residual(model: Model, trial: Trajectory) -> FloatArray:
    """(N - n, n_y): y(t) minus its prediction one sample ahead."""
    return np.asarray(trial.y[len(model) :] - predict(model, trial, 1))


def _explicit(model: Model, trial: Trajectory) -> tuple[FloatArray, FloatArray]:
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
