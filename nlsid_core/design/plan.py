"""A plan of a linear model: the motion that follows a profile, and an LQR around it."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear

from nlsid_core.arrays import FloatArray
from nlsid_core.design.riccati import solve_riccati
from nlsid_core.errors import DataError
from nlsid_core.models import DifferenceEquation

SMOOTHING = 0.1  # weight of a change of input between samples against an output error


def lqr_gain(model: DifferenceEquation, *, output_weight: float, input_weight: float) -> FloatArray:
    """K (n,) minimising Σ output_weight·(C x̄)² + input_weight·ū², x̄⁺ = A x̄ + B ū, ū = -K x̄."""
    A, B, C = model.A, model.B, model.C
    S = solve_riccati(A, B, output_weight * C.T @ C, np.array([[input_weight]]))
    return np.asarray((B.T @ S @ A)[0] / (input_weight + (B.T @ S @ B)[0, 0]))


def track_profile(
    model: DifferenceEquation, profile: Sequence[tuple[float, float]], samples: int
) -> tuple[FloatArray, FloatArray]:
    """State at sample 0 (n,) and inputs (samples,) that follow a piecewise-linear output.

    profile: (time in s, output) corner points. Starts at rest at the profile's first value; inputs
    stay in the range the model was fitted on. Least squares on output error and input changes.
    Raises DataError if the profile's times do not increase.
    """
    times, values = np.array(profile, dtype=np.float64).T
    if not (np.diff(times) > 0).all():
        raise DataError(f"profile: times should increase; they are {times.tolist()}")
    reference = np.interp(np.arange(samples) * model.period, times, values)
    lo, hi = model.u_range
    gain_at_rest = model.b.sum() / (1.0 - model.a.sum())
    rest = float(np.clip((values[0] - model.c / (1.0 - model.a.sum())) / gain_at_rest, lo, hi))
    start = np.linalg.solve(np.eye(len(model)) - model.A, model.B[:, 0] * rest + model.offset)
    A, B, f = model.A, model.B[:, 0], model.offset
    response = np.empty(samples)  # y_j to a unit input at sample 0
    response[0], x = model.D, B.copy()
    for k in range(1, samples):
        response[k], x = x[0], A @ x
    free, x = np.empty(samples), start.copy()
    for k in range(samples):
        free[k], x = x[0] + model.c, A @ x + f
    lower = np.arange(samples)[:, None] - np.arange(samples)
    toeplitz = np.where(lower >= 0, response[np.clip(lower, 0, None)], 0.0)
    changes = np.eye(samples) - np.eye(samples, k=-1)
    rows = np.vstack([toeplitz, SMOOTHING * changes])
    target = np.concatenate([reference - free, [SMOOTHING * rest], np.zeros(samples - 1)])
    u = np.clip(lsq_linear(rows, target, bounds=(lo, np.nextafter(hi, np.inf))).x, lo, hi)
    return start, u
