"""Where the searches for linear difference equations start: stable models that are found directly.

A search that goes downhill ends at the minimum of the valley it begins in, so it begins in several.
A model of more lags, fitted by least squares, has an impulse response h; with the Hankel matrix
H_ij = h_{i+j+1} ≈ U S V' of the n largest singular values, S^(-1/2) U' H↑ V S^(-1/2) has the poles
of n lags that explain it best, H↑ being H one sample later (Kung 1978). Poles outside the circle
are reflected into it.
"""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import hankel, svd
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.identification.linear import (
    SLOWEST_POLE,
    Regression,
    build_regression,
    least_squares,
)
from nlsid_core.models import DifferenceEquation

LONGER = 4  # times the lags, of the model that is reduced
LONGEST_RESPONSE = 400  # samples of its impulse response


def stable_starts(
    regression: Regression, radius: float = SLOWEST_POLE
) -> Iterator[tuple[str, FloatArray]]:
    """Left parameters (n+1,) of models whose poles are within the radius, with their names."""
    direct = np.concatenate([[1.0], -least_squares(regression).a])
    yield "from least squares", reflected(direct, radius)
    try:
        longer = build_regression(regression.dataset, LONGER * regression.lags)
    except DataError:  # too few rows, or too little excitation for as many lags
        return
    poles = reduced_poles(least_squares(longer), regression.lags)
    if np.isfinite(poles).all():
        yield "from a longer model", reflected(np.poly(poles).real, radius)


def reflected(theta: FloatArray, radius: float = SLOWEST_POLE) -> FloatArray:
    """θ (n+1,) with every pole outside the circle at the place that is as far inside, 1/z̄, and
    what is slower than the radius on it; θ itself if every pole is within the radius.
    """
    poles, radius = np.roots(theta), min(radius, SLOWEST_POLE)
    outside = np.abs(poles) > 1.0
    slow = np.abs(poles) > radius
    if not slow.any():
        return theta
    poles[outside] = 1.0 / poles[outside].conj()
    slow = np.abs(poles) > radius
    poles[slow] *= radius / np.abs(poles[slow])
    lags = len(theta) - 1  # np.roots leaves out poles at 0
    return np.concatenate([np.poly(poles).real, np.zeros(lags - len(poles))])


def reduced_poles(model: DifferenceEquation, lags: int) -> FloatArray:
    """Poles (lags,) by the Hankel matrix of the model's impulse response; NaN if it diverges."""
    half = LONGEST_RESPONSE // 2
    impulse = np.eye(1, 2 * half + 1)[0]
    with np.errstate(over="ignore", invalid="ignore"):
        h = lfilter(model.b, np.concatenate([[1.0], -model.a]), impulse)[1:]
        if not np.isfinite(np.square(h)).all():
            return np.full(lags, np.nan)
    U, s, Vt = svd(hankel(h[:half], h[half - 1 : 2 * half - 1]))
    root = np.sqrt(s[:lags])
    if root[-1] <= 1e-8 * root[0]:
        return np.full(lags, np.nan)
    later = hankel(h[1 : half + 1], h[half : 2 * half])
    A = (U[:, :lags].T @ later @ Vt[:lags].T) / np.outer(root, root)
    return np.asarray(np.linalg.eigvals(A))
