"""Least squares on the equation error: the first thing anyone tries, and biased by noise."""

import numpy as np

from nlsid_core.identification.regression import Regression
from nlsid_core.models import DifferenceEquation


def least_squares(regression: Regression) -> DifferenceEquation:
    """Minimise Σ (y(t) - Σ a_k y(t-k) - Σ b_j u(t-j) - c)².

    Source: thesis Section 1.2 (equation error).
    """
    lags = regression.lags
    columns = np.column_stack([regression.Y[:, 1:], regression.Q])
    theta = np.linalg.lstsq(columns, regression.Y[:, 0], rcond=None)[0]
    return regression.model(np.concatenate([[1.0], -theta[:lags]]), theta[lags:])
