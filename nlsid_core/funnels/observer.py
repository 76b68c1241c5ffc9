"""The observer whose state the tube speaks about, and the innovations recorded trials give it."""

import numpy as np
from scipy.linalg import solve_discrete_are

from nlsid_core._types import FloatArray
from nlsid_core.models import DifferenceEquation
from nlsid_core.trajectory import Dataset, Trajectory


def kalman_gain(model: DifferenceEquation, noise_ratio: float) -> FloatArray:
    """L (n,) of x̂⁺ = A x̂ + B u + f + L (y - ŷ), by the Riccati equation.

    noise_ratio: variance of a disturbance of the input over the variance of the measurement.
    """
    A, B, C = model.A, model.B, model.C
    S = solve_discrete_are(A.T, C.T, noise_ratio * B @ B.T, np.eye(1))
    gain: FloatArray = (A @ S @ C.T)[:, 0] / (1.0 + (C @ S @ C.T)[0, 0])
    return gain


def innovations(model: DifferenceEquation, gains: FloatArray, trial: Trajectory) -> FloatArray:
    """Innovations e(t) = y(t) - ŷ(t), t = n …, of the observers with gains (m, n): (N - n, m).

    The first n samples give the state; from then on the observer runs on the recorded signals.
    """
    n, y, u = len(model), trial.y[:, 0], trial.u[:, 0]
    x = np.tile(model.state_after(y[:n], u[:n]), (len(gains), 1))
    e = np.empty((len(trial) - n, len(gains)))
    for t in range(n, len(trial)):
        e[t - n] = y[t] - (x[:, 0] + model.D * u[t] + model.c)
        x = x @ model.A.T + model.B[:, 0] * u[t] + model.offset + gains * e[t - n][:, None]
    return e


def innovation_energies(
    model: DifferenceEquation, gains: FloatArray, dataset: Dataset
) -> FloatArray:
    """Σ_t e(t)² of every trial for every gain: (trials, m), in the output's unit squared."""
    return np.array([(innovations(model, gains, trial) ** 2).sum(axis=0) for trial in dataset])
