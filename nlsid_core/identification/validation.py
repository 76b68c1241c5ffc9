"""How good a model is on trials it has not seen: the numbers and tests users know.

Residual tests are on one-step residuals. Under a model that explains everything the normalised
autocorrelations r_1 … r_L are independent and normal with variance 1/N, so N Σ r² is χ² with L
degrees; a correlation with the input has variance Σ_k ρ_e(k) ρ_u(k)/N instead (Bartlett).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.identification.prediction import (
    Model,
    Simulated,
    history,
    one_step_residual,
    predict,
    simulate_trial,
)
from nlsid_core.trajectory import Dataset, Trajectory

NORMAL_99 = 2.5758293035489004  # two-sided 99 % of a standard normal
CONFIDENCE = 0.99
LAGS = 20
HORIZONS = (1, 5, 20)


@dataclass(frozen=True, eq=False)
class Validation:
    """Scores of one model on one dataset; per output where an array has an output axis.

    simulation_percent: 100·‖y - ŷ‖/‖y - mean(y)‖ of the simulation; fit_percent: 100 minus it.
    prediction_percent: the same of the k-step predictions, by horizon k.
    autocorrelation: (n_y, L) of one-step residuals at lags 1 … L, within ± band if white.
    cross_correlation: (n_y, n_u, 2L+1) of residual and input at lags -L … L, each within
    ± cross_band (n_y, n_u) if independent. white, independent: the joint tests at 99 %.
    samples: how many were scored.
    """

    simulation_percent: float
    prediction_percent: dict[int, float]
    autocorrelation: FloatArray
    band: float
    cross_correlation: FloatArray
    cross_band: FloatArray
    white: bool
    independent: bool
    samples: int

    @property
    def fit_percent(self) -> float:
        """100·(1 - ‖y - ŷ‖/‖y - mean(y)‖)."""
        return 100.0 - self.simulation_percent

    def __str__(self) -> str:
        ahead = ", ".join(f"{k}: {p:.2f} %" for k, p in self.prediction_percent.items())
        lines = [
            f"simulation error {self.simulation_percent:.2f} % (fit {self.fit_percent:.2f} %) "
            f"over {self.samples} samples",
            f"prediction error, steps ahead: {ahead}",
            "one-step residual is " + ("white" if self.white else "NOT white (99 %): the model "
            "leaves dynamics or coloured noise unexplained"),
            "one-step residual is " + ("independent of the input" if self.independent else
            "NOT independent of the input (99 %): the input explains more than the model uses"),
        ]  # fmt: skip
        return "\n".join(lines)


def validate(
    model: Model, dataset: Dataset, *, horizons: Sequence[int] = HORIZONS, lags: int = LAGS
) -> Validation:
    """Score `model` on every trial of `dataset`; DataError if a trial is too short for it."""
    shortest = min(dataset, key=len)
    longest = max(max(horizons, default=1), 2 * lags)
    if len(shortest) <= len(model) + longest:
        raise DataError(
            f"{shortest.name}: {len(shortest)} samples; horizons {tuple(horizons)} and {lags} "
            f"correlation lags need more than {len(model) + longest}"
        )
    residuals = [one_step_residual(model, trial) for trial in dataset]
    inputs = [trial.u[len(model) :] for trial in dataset]
    autocorrelation = np.stack(
        [_correlation(_columns(residuals, i), _columns(residuals, i), lags)[lags + 1 :]
         for i in range(residuals[0].shape[1])]
    )  # fmt: skip
    N = sum(map(len, residuals))
    limit = chi2.ppf(CONFIDENCE, lags)
    cross, variances = _cross(residuals, inputs, lags)
    statistics = N * np.sum(cross[:, :, lags:] ** 2, axis=2) / variances
    return Validation(
        simulation_percent=simulation_percent(model, dataset),
        prediction_percent={k: prediction_percent(model, dataset, k) for k in horizons},
        autocorrelation=autocorrelation,
        band=NORMAL_99 / float(np.sqrt(N)),
        cross_correlation=cross,
        cross_band=NORMAL_99 * np.sqrt(variances / N),
        white=bool((N * np.sum(autocorrelation**2, axis=1) <= limit).all()),
        independent=bool((statistics <= chi2.ppf(CONFIDENCE, lags + 1)).all()),
        samples=sum(len(trial) - len(model) for trial in dataset),
    )


def simulation_percent(model: Simulated, dataset: Dataset) -> float:
    """100·‖y - ŷ‖/‖y - mean(y)‖ over all samples after the first n of every trial, outputs in units
    of their spread; ŷ is simulated from those first n.
    """
    n = history(model)
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable model scores infinity
        pairs = [(trial.y[n:], simulate_trial(model, trial)[n:]) for trial in dataset]
    return _percent(pairs)


def prediction_percent(model: Model, dataset: Dataset, horizon: int) -> float:
    """The same error of predictions `horizon` samples ahead."""
    return _percent(
        [(trial.y[len(model) + horizon - 1 :], predict(model, trial, horizon)) for trial in dataset]
    )


def without_missing(trial: Trajectory, missing: FloatArray, *, shortest: int) -> tuple[
    tuple[Trajectory, ...], int
]:  # fmt: skip
    """The stretches of `trial` where `missing` (N,) is false, and how many samples were skipped.

    Stretches of fewer than `shortest` samples are skipped too. Raises DataError if none is left.
    """
    flags = np.asarray(missing, dtype=bool)
    if flags.shape != trial.t.shape:
        raise DataError(f"{trial.name}: {flags.shape} flags for {len(trial)} samples")
    edges = np.flatnonzero(np.diff(np.concatenate([[True], flags, [True]])))
    stretches = [
        (begin, end) for begin, end in zip(edges[::2], edges[1::2], strict=True)
        if end - begin >= shortest
    ]  # fmt: skip
    if not stretches:
        raise DataError(f"{trial.name}: no stretch of {shortest} samples without gaps")
    kept = tuple(_cut(trial, begin, end, i) for i, (begin, end) in enumerate(stretches, 1))
    return kept, len(trial) - sum(map(len, kept))


def _cut(trial: Trajectory, begin: int, end: int, number: int) -> Trajectory:
    rows = slice(begin, end)
    return Trajectory(
        t=trial.t[rows],
        y=trial.y[rows],
        u=trial.u[rows],
        x=None if trial.x is None else trial.x[rows],
        y_names=trial.y_names,
        u_names=trial.u_names,
        y_units=trial.y_units,
        u_units=trial.u_units,
        y_paths=trial.y_paths,
        u_paths=trial.u_paths,
        name=f"{trial.name} part {number}",
        group=trial.group,
        digest=trial.digest,
    )


def _percent(pairs: list[tuple[FloatArray, FloatArray]]) -> float:
    measured, simulated = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
    centred = measured - measured.mean(axis=0)
    spread = np.maximum(centred.std(axis=0), np.finfo(float).tiny)
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = np.linalg.norm((measured - simulated) / spread) / np.linalg.norm(centred / spread)
    return float(100.0 * ratio) if np.isfinite(ratio) else np.inf


def _columns(arrays: list[FloatArray], i: int) -> list[FloatArray]:
    return [array[:, i] for array in arrays]


def _correlation(first: list[FloatArray], second: list[FloatArray], lags: int) -> FloatArray:
    """(2·lags + 1,): normalised E first(t) second(t - k), k = -lags … lags, trials pooled."""
    a_mean, b_mean = (float(np.concatenate(parts).mean()) for parts in (first, second))
    total = np.zeros(2 * lags + 1)
    power = np.zeros(2)
    for a, b in zip(first, second, strict=True):
        x, y = a - a_mean, b - b_mean
        full = np.correlate(x, y, mode="full")
        middle = len(y) - 1
        total += full[middle - lags : middle + lags + 1]
        power += x @ x, y @ y
    scale = float(np.sqrt(power[0] * power[1]))
    return total / scale if scale > 0.0 else total


def _cross(
    residuals: list[FloatArray], inputs: list[FloatArray], lags: int
) -> tuple[FloatArray, FloatArray]:
    """Correlations (n_y, n_u, 2·lags + 1) and N times their variances (n_y, n_u)."""
    n_y, n_u = residuals[0].shape[1], inputs[0].shape[1]
    cross, variances = np.zeros((n_y, n_u, 2 * lags + 1)), np.ones((n_y, n_u))
    for i in range(n_y):
        for j in range(n_u):
            e, u = _columns(residuals, i), _columns(inputs, j)
            cross[i, j] = _correlation(e, u, lags)
            product = _correlation(e, e, lags) * _correlation(u, u, lags)
            variances[i, j] = max(float(product.sum()), 1.0)
    return cross, variances
