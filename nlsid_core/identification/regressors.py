"""Recorded signals as regressors: mean and spread, lags, and the refusal of poor ones."""

from collections.abc import Iterable

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError

CONSTANT = 1e-10  # relative spread below which a signal is constant
FEWER = (
    "use richer inputs, fewer lags, a lower degree, or fewer delays of the inputs, such as "
    "`delays: [1]`"
)
RANK_TOLERANCE = 1e-10  # relative singular value at which regressors repeat each other


def signal_scale(trials: Iterable[Trajectory], which: str) -> tuple[FloatArray, FloatArray]:
    """Mean and spread of each y or u over all trials; DataError names one that is constant."""
    trials = list(trials)
    values = np.concatenate([getattr(trial, which) for trial in trials])
    mean, spread = values.mean(axis=0), values.std(axis=0)
    for i in np.flatnonzero(spread <= CONSTANT * np.maximum(np.abs(mean), 1.0)):
        raise DataError(
            f"{getattr(trials[0], which + '_names')[i]} is constant ({mean[i]:g}) in all trials: "
            "nothing can be identified from it"
        )
    return mean, spread


def lagged(signal: FloatArray, lags: int) -> FloatArray:
    """(N - lags, lags + 1, columns): [:, k] holds signal(t - k), t = lags …."""
    N = len(signal)
    return np.stack([signal[lags - k : N - k] for k in range(lags + 1)], axis=1)


def refuse_poor(regressors: FloatArray) -> None:
    """DataError if (N, k) regressors are too few or repeat each other."""
    if len(regressors) <= regressors.shape[1]:
        raise DataError(
            f"{len(regressors)} steps for {regressors.shape[1]} regressors; give more data"
        )
    singular = np.linalg.svd(regressors, compute_uv=False)
    rank = int((singular > RANK_TOLERANCE * singular[0]).sum())
    if rank < regressors.shape[1]:
        raise DataError(
            f"states and inputs are not independent: {regressors.shape[1]} regressors of rank "
            f"{rank}; {FEWER}"
        )
