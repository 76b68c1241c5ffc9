"""Simulation error minimisation (SEM), the usual comparator."""

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter, lfiltic

from nlsid_core._types import FloatArray
from nlsid_core.identification.regression import Regression
from nlsid_core.models import DifferenceEquation

UNSTABLE_RESIDUAL = 1e6  # in units of the signal's spread: a diverged simulation, kept finite
LM_TOLERANCE = 1e-12  # relative decrease of the cost at which the minimiser stops
LM_EVALUATIONS = 300


def minimise_simulation_error(
    regression: Regression, start: DifferenceEquation
) -> DifferenceEquation:
    """Levenberg-Marquardt on Σ (y - ŷ)² with exact sensitivities, from `start`'s coefficients.

    Finds a local minimum; nothing makes the result stable. Source: thesis Section 1.2.
    """
    n = regression.lags
    first_rows = np.flatnonzero(regression.row == 0)
    bounds = list(zip(first_rows, [*first_rows[1:], len(regression.row)], strict=True))
    columns = np.column_stack([regression.Y[:, 1:], regression.Q])
    target = regression.Y[:, 0]

    def simulate(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        denominator = np.concatenate([[1.0], -theta[:n]])
        forcing = regression.Q @ theta[n:]
        outputs = np.empty_like(target)
        regressors = columns.copy()
        for begin, end in bounds:
            history = regression.Y[begin, 1:]
            state = lfiltic([1.0], denominator, history)
            outputs[begin:end], _ = lfilter([1.0], denominator, forcing[begin:end], zi=state)
            padded = np.concatenate([history[::-1], outputs[begin:end]])
            for k in range(1, n + 1):
                regressors[begin:end, k - 1] = padded[n - k : len(padded) - k]
        return outputs, regressors

    def residual(theta: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            difference = simulate(theta)[0] - target
        finite: FloatArray = np.nan_to_num(difference)
        return finite.clip(-UNSTABLE_RESIDUAL, UNSTABLE_RESIDUAL)

    def jacobian(theta: FloatArray) -> FloatArray:
        denominator = np.concatenate([[1.0], -theta[:n]])
        with np.errstate(all="ignore"):
            _, regressors = simulate(theta)
            parts = [lfilter([1.0], denominator, regressors[b:e], axis=0) for b, e in bounds]
        sensitivities: FloatArray = np.nan_to_num(np.concatenate(parts))
        return sensitivities

    theta_p = np.linalg.lstsq(regression.Q, target - columns[:, :n] @ start.a, rcond=None)[0]
    found = least_squares(
        residual,
        np.concatenate([start.a, theta_p]),
        jac=jacobian,
        method="lm",
        ftol=LM_TOLERANCE,
        xtol=LM_TOLERANCE,
        max_nfev=LM_EVALUATIONS,
    )
    g = np.concatenate([[1.0], -found.x[:n]])
    return regression.model(g, found.x[n:])
