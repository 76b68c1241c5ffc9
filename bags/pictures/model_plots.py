"""Pictures of an identified model (extra `report`: matplotlib). Each function returns a Figure."""

from collections.abc import Mapping
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bags.pictures.plots import BLUE, GREY, INK, LINE, ORANGE, RED, grid, legend, thinned, tidy
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.identification import Candidate, Model, Validation
from nlsid_core.identification.prediction import history, learns, simulate_started
from nlsid_core.identification.validation import unscored
from nlsid_core.models import Signal

MOST_TRIALS = 12  # drawn; with more trials those with the largest errors
LONGEST = 400  # samples drawn of a trial: around its largest error
DRAWN = 800  # points of a residual over time
COLUMNS = 4


def simulations(test: Dataset, models: Mapping[str, Model], output: int = 0) -> Figure:
    """Draw what was measured on trials against what models simulate, the last one on top.

    Args:
        test: the trials; of many, those that the last model simulates worst are drawn.
        models: by the names that the legend shows.
        output: the number of the response.

    Returns:
        The figure, with an input of the same unit.
    """
    *others, (title, chosen) = models.items()
    n = unscored(test)
    outputs = simulate_started(chosen, test.trajectories, n)
    simulated = {t.name: y[:, output] for t, y in zip(test, outputs, strict=True)}
    trials = sorted(test, key=lambda t: -_size(t.y[:, output] - simulated[t.name]))[:MOST_TRIALS]
    trials.sort(key=lambda t: test.names.index(t.name))
    width = 3.1 if len(trials) > 1 else 9.1
    figure, panels = grid(len(trials), COLUMNS, (width, 2.1), sharey=True)
    for axes, trial in zip(panels, trials, strict=True):
        y = trial.y[:, output]
        rows_drawn = _excerpt(y - simulated[trial.name])
        t = trial.t[rows_drawn] - trial.t[0]
        for name, unit, u in zip(trial.u_names, trial.u_units, trial.u.T, strict=True):
            if unit == trial.y_units[output]:
                axes.step(t, u[rows_drawn], where="post", color=GREY, lw=LINE, label=name)
        axes.plot(t, y[rows_drawn], color=INK, lw=LINE, label="measured")
        for (name, model), color in zip(others, cycle((ORANGE, RED))):
            other = _bounded(simulate_started(model, [trial], n)[0][rows_drawn, output], y)
            axes.plot(t, other, color=color, lw=LINE, ls="--", label=name)
        axes.plot(t, simulated[trial.name][rows_drawn], color=BLUE, lw=LINE, label=title)
        drawn = "" if len(t) == len(trial) else f", {len(t)} of {len(trial)} samples"
        axes.set_title(f"{trial.name}{drawn}", fontsize=9, loc="left")
    figure.supxlabel("time [s]", fontsize=9)
    figure.supylabel(axis_name(test.trajectories[0], output), fontsize=9)
    legend(figure, panels[:1])
    return figure


def residuals(chosen: Candidate[Model], scores: Validation, test: Dataset) -> Figure:
    """For each output: simulation residual over time, its correlations, and their 99 % bands."""
    first = test.trajectories[0]
    n_y, n_u = first.y.shape[1], first.u.shape[1]
    figure = Figure(figsize=(3.3 * (2 + n_u), 2.7 * n_y + 0.4), layout="constrained")
    panels = figure.subplots(n_y, 2 + n_u, squeeze=False)
    start = max(history(chosen.model), unscored(test, chosen.transient))
    simulated = simulate_started(chosen.model, test.trajectories, start)
    predicts = learns(chosen.model)
    for i in range(n_y):
        over_time, auto, *crossed = panels[i]
        for trial, y in zip(test, simulated, strict=True):
            t, e = thinned(trial.t[start:] - trial.t[0], trial.y[start:, i] - y[start:, i], DRAWN)
            over_time.plot(t, e, lw=0.8)
        over_time.set_title(f"residual of {axis_name(first, i)}", fontsize=8, loc="left")
        over_time.set_xlabel("time [s]", fontsize=8)
        lags = np.arange(1, scores.one_step.autocorrelation.shape[1] + 1)
        _correlations(
            auto,
            lags,
            scores.one_step.autocorrelation[i],
            scores.simulation.autocorrelation[i],
            scores.one_step.band,
            predicts=predicts,
        )
        auto.set_title("autocorrelation", fontsize=8, loc="left")
        both = np.arange(-len(lags), len(lags) + 1)
        for j, axes in enumerate(crossed):
            _correlations(
                axes,
                both,
                scores.one_step.cross_correlation[i, j],
                scores.simulation.cross_correlation[i, j],
                scores.one_step.cross_band[i, j],
                predicts=predicts,
            )
            axes.set_title(f"with {first.u_names[j]}", fontsize=8, loc="left")
        for axes in panels[i, 1:]:
            axes.set_xlabel("lag [samples]", fontsize=8)
    legend(figure, panels[0, 1:2], loc="outside upper right")
    tidy(list(panels.flat))
    return figure


def axis_name(trial: Trajectory, output: int) -> str:
    """The output with its unit."""
    return Signal(trial.y_names[output], trial.y_units[output]).label


def _correlations(
    axes: Axes,
    lags: np.ndarray,
    one_step: FloatArray,
    simulated: FloatArray,
    band: float,
    *,
    predicts: bool,
) -> None:
    """predicts: whether one step ahead is more than the simulation."""
    bounded = f"99 % of {'one-step' if predicts else 'white'} values"
    axes.axhspan(-band, band, color=GREY, alpha=0.3, lw=0, label=bounded)
    if predicts:
        axes.vlines(lags, 0.0, one_step, color=BLUE, lw=LINE, label="one step ahead")
        axes.plot(lags, one_step, ".", color=BLUE, ms=4)
    axes.plot(lags, simulated, color=ORANGE, lw=LINE, label="simulated")
    axes.axhline(0.0, color=INK, lw=0.5)


def _size(error: FloatArray) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.nan_to_num(np.mean(error**2), nan=np.inf))


def _excerpt(error: FloatArray) -> slice:
    """All rows, or LONGEST of them around the largest error."""
    if len(error) <= LONGEST:
        return slice(0, len(error))
    worst = int(np.argmax(np.abs(error)))
    start = min(max(worst - LONGEST // 2, 0), len(error) - LONGEST)
    return slice(start, start + LONGEST)


def _bounded(simulated: FloatArray, measured: FloatArray) -> FloatArray:
    """A comparator that diverges is drawn as far as it stays near the data."""
    room = 2.0 * float(np.ptp(measured))
    low, high = float(np.min(measured)) - room, float(np.max(measured)) + room
    return np.where((simulated >= low) & (simulated <= high), simulated, np.nan)
