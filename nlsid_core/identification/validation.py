"""How good a model is on trials it has not seen: the numbers and tests users know.

Where a residual is white its normalised autocorrelations r_1 … r_L are independent and normal with
variance 1/N, so N Σ r² is χ² with L degrees. A correlation with the input has variance
Σ_k ρ_e(k) ρ_u(k)/N, and those of neighbouring lags go together: the largest of the L + 1 causal
ones, in standard deviations, is held against the quantile that all of them exceed in 1 % of cases.
Source: Bartlett 1946; Ljung, System Identification, Section 16.6.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2, norm

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification.prediction import (
    Model,
    history,
    learns,
    one_step_residual,
    simulate_started,
)
from nlsid_core.models import StateAffineModel
from nlsid_core.shown import Table

NORMAL_99 = 2.5758293035489004  # two-sided 99 % of a standard normal
CONFIDENCE = 0.99
LAGS = 20
STARTED = 20  # samples, a fifth of a trial at most, that show where a simulation starts
DIVERGED = 1e100  # a residual whose square no sum of squares should meet


@dataclass(frozen=True, eq=False)
class Residual:
    """What is left over, tested: autocorrelation (n_y, L) at lags 1 … L, within ± band if white.

    cross_correlation: (n_y, n_u, 2L+1) of residual and input at lags -L … L, each within
    ± cross_band (n_y, n_u) if independent. white, independent: the joint tests at 99 %.
    """

    autocorrelation: FloatArray
    band: float
    cross_correlation: FloatArray
    cross_band: FloatArray
    white: bool
    independent: bool

    def __str__(self) -> str:
        white = (
            "white"
            if self.white
            else "NOT white (99 %): dynamics are left, or noise that is coloured or of both kinds"
        )
        if self.independent:
            return f"{white}, independent of the input"
        return f"{white}, NOT independent of the input (99 %): it explains more than the model uses"


@dataclass(frozen=True, eq=False)
class Validation:
    """Scores of one model on one dataset.

    simulation_percent: 100·‖y - ŷ‖/‖y - mean(y)‖ of the simulation, output_percent of each output
    alone; fit_percent: 100 minus it. output_rms: of y - ŷ of each output with its name and unit.
    one_step_percent: of the predictions one step ahead; None of a model that predicts what it
    simulates (`learns`). clipped_percent: of the samples with an input beyond the model's
    range, where the model uses the nearest in the range instead.
    one_step is white where noise enters the equation, simulation where it enters the measurement:
    under a model that explains everything one of them is; they are the same where nothing is
    predicted. samples: how many were scored.
    """

    simulation_percent: float
    output_percent: tuple[float, ...]
    output_rms: tuple[tuple[str, float, str], ...]
    one_step_percent: float | None
    one_step: Residual
    simulation: Residual
    samples: int
    clipped_percent: float = 0.0

    @property
    def fit_percent(self) -> float:
        """100·(1 - ‖y - ŷ‖/‖y - mean(y)‖)."""
        return 100.0 - self.simulation_percent

    def __str__(self) -> str:
        if self.one_step_percent is None:
            predicted = [
                "prediction error: -, as this class of models predicts what it simulates: it "
                "learns nothing from outputs after the start"
            ]
        else:
            predicted = [
                f"prediction error, one step ahead: {self.one_step_percent:.2f} %",
                f"one-step residual is {self.one_step}",
            ]
        lines = [
            f"simulation error {self.simulation_percent:.2f} % (fit {self.fit_percent:.2f} %) "
            f"over {self.samples} samples",
            *predicted,
            f"simulation residual is {self.simulation}",
        ]
        rms = []
        for (name, value, unit), part in zip(self.output_rms, self.output_percent, strict=True):
            varies = f" of the {100.0 * value / part:.3g}" if 0.0 < part < np.inf else ""
            rms.append(f"{name} {value:.3g}{varies} {unit}".rstrip())
        said = " by which it varies in these trials" if len(rms) == 1 else ""
        lines.insert(1, f"rms error of the simulation: {', '.join(rms)}{said}")
        if self.clipped_percent:
            lines.insert(
                2,
                f"{self.clipped_percent:.2g} % of the samples have an input beyond the model's "
                "range, which the model clips; a wider input_range takes them as they are",
            )
        if len(self.output_percent) > 1:
            each = ", ".join(f"{percent:.2f} %" for percent in self.output_percent)
            lines.insert(1, f"simulation error of each output: {each}")
        return "\n".join(lines)


def validate(model: Model, dataset: Dataset, *, transient: int = 0) -> Validation:
    """Score `model` on every trial of `dataset`, all but its first `transient` samples.

    Raises DataError if a trial is too short for correlations.
    """
    first = max(history(model), transient)
    shortest = min(dataset, key=len)
    lags = min(LAGS, (len(shortest) - first - 1) // 2)
    if lags < 1:
        raise DataError(
            f"{shortest.name}: {len(shortest)} samples; correlations need more than {first + 2}"
        )
    inputs = [trial.u[first:] for trial in dataset]
    simulated = _simulated(model, dataset, first)
    one_step = [one_step_residual(model, trial)[first - history(model) :] for trial in dataset]
    with np.errstate(over="ignore", invalid="ignore"):
        left = [measured - outputs for measured, outputs in simulated]
        pairs = zip(dataset, one_step, strict=True)
        predicted = [(trial.y[first:], trial.y[first:] - error) for trial, error in pairs]
    return Validation(
        simulation_percent=_percent(simulated),
        output_percent=tuple(
            _percent([(y[:, [i]], x[:, [i]]) for y, x in simulated])
            for i in range(simulated[0][0].shape[1])
        ),
        output_rms=tuple(
            (name, _rms([(y - x)[:, i] for y, x in simulated]), unit)
            for i, (name, unit) in enumerate(
                zip(dataset.trajectories[0].y_names, dataset.trajectories[0].y_units, strict=True)
            )
        ),
        clipped_percent=_clipped_percent(model, dataset),
        one_step_percent=_percent(predicted) if learns(model) else None,
        one_step=residual_tests(one_step, inputs, lags),
        simulation=residual_tests(left, inputs, lags),
        samples=sum(len(trial) - first for trial in dataset),
    )


def unscored(dataset: Dataset, transient: int = 0) -> int:
    """First samples of every trial that show where it starts and are not scored."""
    return max(transient, min(STARTED, min(map(len, dataset)) // 5))


def residual_tests(
    residuals: Sequence[FloatArray], inputs: Sequence[FloatArray], lags: int
) -> Residual:
    """Whiteness and independence of residuals [(N, n_y)] with inputs [(N, n_u)], trials pooled."""
    n_y, n_u = residuals[0].shape[1], inputs[0].shape[1]
    N = sum(map(len, residuals))
    if not all((np.abs(part) < DIVERGED).all() for part in residuals):
        nowhere = np.full((n_y, n_u), np.inf)
        return Residual(
            np.full((n_y, lags), np.nan),
            NORMAL_99 / float(np.sqrt(N)),
            np.full((n_y, n_u, 2 * lags + 1), np.nan),
            nowhere,
            False,
            False,
        )
    autocorrelation = np.stack(
        [
            _correlation(_columns(residuals, i), _columns(residuals, i), lags)[lags + 1 :]
            for i in range(n_y)
        ]
    )
    cross, deviation = cross_correlation(residuals, inputs, lags)
    largest = np.max(np.abs(cross[:, :, lags:]), axis=2) / deviation
    chance = (1.0 - CONFIDENCE) / (lags + 1)
    return Residual(
        autocorrelation=autocorrelation,
        band=NORMAL_99 / float(np.sqrt(N)),
        cross_correlation=cross,
        cross_band=NORMAL_99 * deviation,
        white=bool((N * np.sum(autocorrelation**2, axis=1) <= chi2.ppf(CONFIDENCE, lags)).all()),
        independent=bool((largest <= norm.isf(chance / 2.0)).all()),
    )


def simulation_percent(model: Model, dataset: Dataset, *, transient: int = 0) -> float:
    """100·‖y - ŷ‖/‖y - mean(y)‖ over all samples after the first n of every trial, outputs in units
    of their spread; ŷ is simulated from the start nearest to these n: the model's history, or
    `transient` if longer.
    """
    return _percent(_simulated(model, dataset, max(history(model), transient)))


def _simulated(model: Model, dataset: Dataset, first: int) -> list[tuple[FloatArray, FloatArray]]:
    """(measured, simulated) of every trial from sample `first` on."""
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable model scores infinity
        outputs = simulate_started(model, dataset.trajectories, first)
    return [(t.y[first:], y[first:]) for t, y in zip(dataset, outputs, strict=True)]


def _rms(errors: list[FloatArray]) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        rms = float(np.sqrt(np.mean(np.square(np.concatenate(errors)))))
    return rms if np.isfinite(rms) else np.inf


def _clipped_percent(model: Model, dataset: Dataset) -> float:
    """How many percent of the samples have an input that a state-affine model clips."""
    if not isinstance(model, StateAffineModel):
        return 0.0
    low, high = model.u_range.T
    u = np.concatenate([trial.u for trial in dataset])
    return float(100.0 * np.mean(((u < low) | (u > high)).any(axis=1)))


def _percent(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    measured, simulated = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
    centred = measured - measured.mean(axis=0)
    spread = np.maximum(centred.std(axis=0), np.finfo(float).tiny)
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = np.linalg.norm((measured - simulated) / spread) / np.linalg.norm(centred / spread)
    return float(100.0 * ratio) if np.isfinite(ratio) else np.inf


def _columns(arrays: Sequence[FloatArray], i: int) -> list[FloatArray]:
    return [array[:, i] for array in arrays]


def _correlation(first: list[FloatArray], second: list[FloatArray], lags: int) -> FloatArray:
    """(2·lags + 1,): normalised E first(t) second(t - k), k = -lags … lags, trials pooled."""
    a_mean, b_mean = (float(np.concatenate(parts).mean()) for parts in (first, second))
    total = np.zeros(2 * lags + 1)
    power = np.zeros(2)
    for a, b in zip(first, second, strict=True):
        x, y = a - a_mean, b - b_mean
        middle = len(y) - 1
        total += correlate(x, y)[middle - lags : middle + lags + 1]
        power += x @ x, y @ y
    scale = float(np.sqrt(power[0] * power[1]))
    return total / scale if scale > 0.0 else total


def cross_correlation(
    residuals: Sequence[FloatArray], inputs: Sequence[FloatArray], lags: int
) -> tuple[FloatArray, FloatArray]:
    """Correlations (n_y, n_u, 2·lags + 1) and their standard deviations (n_y, n_u)."""
    n_y, n_u, N = residuals[0].shape[1], inputs[0].shape[1], sum(map(len, residuals))
    horizon = max(lags, min(map(len, residuals)) // 4)  # beyond, too few products
    cross, variances = np.zeros((n_y, n_u, 2 * lags + 1)), np.ones((n_y, n_u))
    for i in range(n_y):
        for j in range(n_u):
            e, u = _columns(residuals, i), _columns(inputs, j)
            cross[i, j] = _correlation(e, u, lags)
            product = _correlation(e, e, horizon) * _correlation(u, u, horizon)
            variances[i, j] = max(float(product.sum()), 1.0)
    return cross, np.sqrt(variances / N)


def compare(data: Dataset, models: Mapping[str, Model]) -> Table:
    """Simulate models on the same trials; a row for each, [name] is its error.

    The error is 100·‖y - ŷ‖/‖y - mean(y)‖ in %, the fit 100 % minus it. The first samples show
    where a simulation starts and are not scored (`unscored`).
    """
    errors = {
        name: simulation_percent(model, data, transient=unscored(data))
        for name, model in models.items()
    }
    rows = {name: (100.0 - error, error) for name, error in errors.items()}
    return Table(("fit [%]", "simulation error [%]"), rows)
