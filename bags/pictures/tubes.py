"""Pictures of funnels around motions, and of the models they were made for (extra `report`)."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from bags.pictures.plots import BLUE, GREY, INK, LINE, ORANGE, RED, grid, legend, tidy, write_png
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.designs import AnyDesign
from nlsid_core.funnels import ContinuousFunnel, TubeFunnel
from nlsid_core.identification.states import free_run_error, stretches_in_box
from nlsid_core.models import StateModel

TUBE = "#dbe8f4"
TIMES = 200  # at which a tube in continuous time, or without an end, is drawn
OUTLINES = 80  # ellipses of a projected tube: their shadows join into one
RINGS = 6  # of them drawn with a line
PROJECTIONS = 3  # at most
COLUMNS = 3  # of panels
NOISE_BAND = 2.0  # standard deviations of the sensors


def write_tube(path: Path, design: AnyDesign) -> None:
    """Draw `draw_tube` into a PNG file."""
    write_png(path, draw_tube(design))


def draw_tube(design: AnyDesign) -> Figure:
    """Draw each signal's tube around the motion over time; of a composition stage after stage.

    Of a funnel in continuous time its projections onto pairs of states come first. A tube without
    a plan goes where its model's simulation goes, so it is drawn around 0.
    """
    signals = design.signals[0]
    is_continuous = isinstance(design.funnel, ContinuousFunnel)
    pairs = state_pairs(len(signals)) if is_continuous else []
    figure, panels = grid(len(pairs) + len(signals), COLUMNS, (3.6, 2.6))

    for axes, pair in zip(panels, pairs, strict=False):
        for stage in design.stages:
            _projection(axes, stage.funnel, pair)
        axes.set_xlabel(signals[pair[0]].label, fontsize=8)
        axes.set_ylabel(signals[pair[1]].label, fontsize=8)

    over_time = panels[len(pairs) :]
    for stage in design.stages:
        t, x, widths = _band(stage)
        for axes, middle, width in zip(over_time, x.T, widths.T, strict=True):
            axes.fill_between(t, middle - width, middle + width, color=TUBE, lw=0, label="tube")
            axes.plot(t, middle, color=INK, lw=LINE, label="motion")
            if stage is not design.stages[0]:
                axes.axvline(t[0], color=GREY, lw=LINE, ls=":")
    for axes, signal in zip(over_time, signals, strict=True):
        axes.set_title(signal.label, fontsize=9, loc="left")
        axes.set_xlabel("time [s]", fontsize=8)
    legend(figure, over_time[:1], loc="outside lower left")
    return figure


def state_pairs(n: int) -> list[tuple[int, int]]:
    """Which states are drawn against each other: 0-1, 2-3, 4-5, and the last two if n is odd."""
    pairs = [(i, i + 1) for i in range(0, n - 1, 2)][:PROJECTIONS]
    if n % 2 and 1 < n < 2 * PROJECTIONS:
        pairs.append((n - 2, n - 1))
    return pairs


def draw_free_run(model: StateModel, validation: Dataset) -> Figure:
    """Draw measured and simulated states of the worst trial, and beside them what is missed.

    Simulated in each stretch in the box of the model's data, from its measured start, as the class
    was chosen.
    """
    errors = [free_run_error(model, Dataset((trial,))) for trial in validation]
    trial, error = validation.trajectories[int(np.argmax(errors))], max(errors)
    parts = stretches_in_box(model, trial)
    simulated = np.full_like(trial.y, np.nan)
    for part in parts:
        simulated[part] = model.simulate(trial.y[part][0], trial.u[part][:-1])

    n, t = len(model), trial.t - trial.t[0]
    figure = Figure(figsize=(11.0, 1.7 * n + 0.8), layout="constrained")
    panels: Any = figure.subplots(n, 2, squeeze=False, sharex=True, width_ratios=(1.5, 1))
    for i, (left, right) in enumerate(panels):
        left.plot(t, trial.y[:, i], color=INK, lw=2.0, label="measured")
        left.plot(t, simulated[:, i], color=ORANGE, lw=1.0, label="simulated")
        left.set_ylabel(model.x[i].label, fontsize=8)
        right.plot(t, trial.y[:, i] - simulated[:, i], color=BLUE, lw=0.5)
        for side in (-NOISE_BAND, NOISE_BAND):
            right.axhline(side * model.noise[i], color=RED, lw=LINE, ls=":")
    said = f"measured - simulated; ±{NOISE_BAND:g} standard deviations of the sensor's noise"
    panels[0, 1].set_title(said, fontsize=9, loc="left")
    tidy(list(panels.flat))
    for axes in panels[-1]:
        axes.set_xlabel("time [s]", fontsize=8)

    used = sum(part.stop - part.start for part in parts)
    where = "" if used == len(trial) else f" in the box ({used} of {len(trial)} samples)"
    worst = f"free run of {trial.name}, the worst that was not fitted: {error:.2g} %{where}"
    figure.suptitle(worst, fontsize=11, x=0.01, ha="left")
    legend(figure, panels[0, :1], loc="outside lower left")
    return figure


def _band(design: AnyDesign) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times of one stage in s, the motion (N, n) and the half-widths (N, n) at them."""
    policy, funnel = design.policy, design.funnel
    if isinstance(funnel, ContinuousFunnel):
        t = np.linspace(funnel.t0, funnel.tf, TIMES)
        return t, funnel.x(t), np.array([funnel.widths(float(when)) for when in t])
    if isinstance(funnel, TubeFunnel):
        count = len(policy or range(int(min(funnel.last + 1, TIMES))))
        widths = np.array(list(map(funnel.widths, range(count))))
        x = 0.0 * widths if policy is None else policy.plan(design.model).y[:, None]
        return np.arange(count) * design.period, x, widths
    return np.arange(len(policy) + 1) * policy.period, policy.x, funnel.half_widths


def _projection(axes: Axes, funnel: ContinuousFunnel, pair: tuple[int, int]) -> None:
    times = np.linspace(funnel.t0, funnel.tf, OUTLINES)
    shadows = [funnel.outline(float(t), pair) for t in times]
    axes.add_collection(PolyCollection(shadows, facecolors=TUBE, edgecolors="none", zorder=1))
    for t in np.linspace(funnel.t0, funnel.tf, RINGS):
        axes.plot(*funnel.outline(float(t), pair).T, color=BLUE, lw=0.7, alpha=0.8, zorder=2)
    path = funnel.x(np.linspace(funnel.t0, funnel.tf, TIMES))[:, list(pair)]
    axes.plot(*path.T, color=INK, lw=LINE, zorder=4)
    axes.plot(*path[0], "o", color=INK, ms=5, mfc="white", zorder=5)
    axes.plot(*path[-1], "o", color=INK, ms=5, zorder=5)
