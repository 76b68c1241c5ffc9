"""Pictures of funnels around motions (extra `report`): free run, motion, funnel, tube, runs."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bags.designs.design import AnyDesign
from bags.pictures.plots import BLUE, GREY, INK, LINE, ORANGE, RED, tidy
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.dynamics import VectorField
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.identification.states import free_run_error, stretches_in_box
from nlsid_core.models import Signal
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.running.assumption import disturbance_of, meter_of
from nlsid_core.running.reading import Reading, Status

TUBE = "#c9deef"
TIMES = 200  # at which a continuous tube is drawn
NOISE_BAND = 2.0  # standard deviations of the sensors
COLOURS = {Status.INSIDE: BLUE, Status.ASSUMPTION_VIOLATED: ORANGE, Status.OUTSIDE: RED}
MANY_BOUNDS = 3.0  # from which on the logarithm of a disturbance over its bound is drawn ...
LEAST_DRAWN = 0.05  # ... down to this
LEGEND_ROOM = 4.0  # below the narrowest half-width
LEAST_MARGIN = -1.0  # of what is outside


def draw_free_run(model: MeasuredState, validation: Dataset) -> Figure:
    """Measured and simulated states of the worst trial; beside them, what the simulation misses.

    Simulated in each stretch in the box of the model's data, from its measured start, as the class
    was chosen.
    """
    errors = [free_run_error(model, Dataset((trial,)), in_box=True) for trial in validation]
    trial, error = validation.trajectories[int(np.argmax(errors))], max(errors)
    n = len(model)
    figure = Figure(figsize=(11.0, 1.7 * n + 0.8), layout="constrained")
    panels: Any = figure.subplots(n, 2, squeeze=False, sharex=True, width_ratios=(1.5, 1))
    parts = stretches_in_box(model, trial)
    t = trial.t - trial.t[0]
    simulated = np.full_like(trial.y, np.nan)
    for part in parts:
        simulated[part] = model.simulate(trial.y[part][0], trial.u[part][:-1])
    for i, (left, right) in enumerate(panels):
        _box(left, model.x_range[i])
        left.plot(t, trial.y[:, i], color=INK, lw=2.0, label="measured")
        left.plot(t, simulated[:, i], color=ORANGE, lw=1.0, label="simulated")
        left.set_ylabel(_name(model.x[i]), fontsize=8)
        right.plot(t, trial.y[:, i] - simulated[:, i], color=BLUE, lw=0.5)
        noise = f"±{NOISE_BAND:g} standard deviations of the sensor's noise"
        for side, label in ((-NOISE_BAND, noise), (NOISE_BAND, None)):
            right.axhline(side * model.noise[i], color=RED, lw=LINE, ls=":", label=label)
    panels[0, 1].set_title("measured - simulated", fontsize=9, loc="left")
    tidy(list(panels.flat))
    for axes in panels[-1]:
        axes.set_xlabel("time [s]", fontsize=8)
    used = sum(part.stop - part.start for part in parts)
    where = "" if used == len(trial) else f" in the box ({used} of {len(trial)} samples)"
    _title(figure, f"free run of {trial.name}, the worst that was not fitted: {error:.2g} %{where}")
    _legend(figure, panels[0])
    return figure


def draw_motion(model: MeasuredState, policy: SampledPolicy) -> Figure:
    """Nominal states and inputs over time in the box of the model's data."""
    n, p = len(model), len(model.u)
    figure, panels = _grid(n + p)
    nominal = [*policy.x.T, *policy.u.T]
    for axes, signal, values, bounds in zip(
        panels, (*model.x, *model.u), nominal, (*model.x_range, *model.u_range), strict=True
    ):
        _box(axes, bounds)
        _nominal(axes, policy, values)
        axes.set_title(_name(signal), fontsize=9, loc="left")
    _title(figure, f"motion of {len(policy) * policy.period:g} s, {len(policy)} steps")
    _legend(figure, panels[:1])
    return figure


def draw_funnel(
    model: MeasuredState, policy: SampledPolicy, funnel: SampledFunnel, runs: Dataset
) -> Figure:
    """Tube, inlet and goal around the motion, its inputs, half-widths, and the disturbance.

    runs: the commissioning runs, drawn beside the bound on the disturbance that the tube rests on.
    """
    n, p = len(model), len(model.u)
    figure, panels = _grid(n + p + 2)
    t = _times(policy)
    widths, axis = funnel.half_widths, funnel.half_widths / funnel.radius[:, None]
    for i, axes in enumerate(panels[:n]):
        x, inlet = policy.x[:, i], axis[:, i] * funnel.inlet
        _box(axes, model.x_range[i])
        axes.fill_between(t, x - widths[:, i], x + widths[:, i], color=TUBE, lw=0, label="tube")
        axes.plot(t, x + inlet, color=ORANGE, lw=LINE, ls=":", label="inlet")
        axes.plot(t, x - inlet, color=ORANGE, lw=LINE, ls=":")
        _nominal(axes, policy, x)
        reach = axis[-1, i] * (funnel.inlet[-1] + funnel.margin)
        axes.vlines(t[-1], x[-1] - reach, x[-1] + reach, color=ORANGE, lw=4, label="goal")
        axes.set_title(_name(model.x[i]), fontsize=9, loc="left")
    used = feedback_reach(policy, funnel)
    for j, axes in enumerate(panels[n : n + p]):
        u = policy.u[:, j]
        _box(axes, model.u_range[j])
        axes.fill_between(t[:-1], u - used[:, j], u + used[:, j], color=TUBE, lw=0)
        _nominal(axes, policy, u)
        axes.set_title(f"{_name(model.u[j])}; shaded: with feedback", fontsize=9, loc="left")
    _half_widths(panels[n + p], model, t, widths)
    _disturbance(panels[n + p + 1], model, policy, funnel, runs)
    a = funnel.assumption
    _title(
        figure,
        f"funnel of {t[-1]:g} s, {len(policy)} steps, proved while the disturbance's "
        f"{a.form} is at most {a.bound:.3g}",
    )
    _legend(figure, panels[:1])
    return figure


def draw_tube(design: AnyDesign) -> Figure:
    """Each state's tube around the motion, over time; of a composition, stage after stage."""
    model = design.model
    names = (
        [f"x{i}" for i in range(model.n)]
        if isinstance(model, VectorField)
        else [_name(signal) for signal in design.signals[0]]
    )
    figure, panels = _grid(len(names))
    for number, stage in enumerate(design.stages, 1):
        t, x, widths = _band(stage)
        for i, axes in enumerate(panels):
            axes.fill_between(
                t,
                x[:, i] - widths[:, i],
                x[:, i] + widths[:, i],
                color=TUBE,
                lw=0,
                label="tube" if number == 1 else None,
            )
            axes.plot(t, x[:, i], color=INK, lw=LINE, label="motion" if number == 1 else None)
            if number > 1:
                axes.axvline(t[0], color=GREY, lw=LINE, ls=":")
    for axes, name in zip(panels, names, strict=True):
        axes.set_title(name, fontsize=9, loc="left")
    _legend(figure, panels[:1])
    return figure


def _band(design: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of one stage: times in s, the motion (N, n) and the half-widths (N, n) at them."""
    policy, funnel = design.policy, design.funnel
    if isinstance(funnel, ContinuousFunnel):
        t = np.linspace(funnel.t0, funnel.tf, TIMES)
        return t, funnel.x(t), np.array([funnel.widths(float(when)) for when in t])
    assert isinstance(policy, SampledPolicy), "a tube around a simulation has no motion"
    assert isinstance(funnel, SampledFunnel), "with such a policy"
    return _times(policy), policy.x, funnel.half_widths


def feedback_reach(policy: SampledPolicy, funnel: SampledFunnel) -> FloatArray:
    """(N, p) the largest |K_k x̄| in the tube: what the feedback may add to the nominal input."""
    rows = policy.K @ np.linalg.inv(funnel.S[:-1])
    return np.asarray(np.linalg.norm(rows, axis=2) * funnel.radius[:-1, None])


def draw_watched(
    model: MeasuredState, funnel: SampledFunnel, bags: Sequence[Sequence[Reading]]
) -> Figure:
    """Runs in the tube, their margin, and their disturbance over its bound, verdicts by colour.

    bags: the readings of each, in order, of one run or of several; unknown ones are not drawn.
    """
    runs = [run for readings in bags for run in _runs(readings)]
    figure, panels = _grid(len(model) + 2)
    t = np.arange(len(funnel) + 1) * model.period
    widths = funnel.half_widths
    for i, axes in enumerate(panels[:-2]):
        axes.fill_between(t, -widths[:, i], widths[:, i], color=TUBE, lw=0, label="tube")
        axes.plot(t, 0 * t, color=INK, lw=0.6)
        axes.set_title(f"{_name(model.x[i])}, from the nominal", fontsize=9, loc="left")
        axes.set_ylim(*np.array([-1.5, 1.5]) * np.max(widths[:, i]))
    margin, disturbance = panels[-2:]
    margin.set_title("margin; 0 on the tube's boundary", fontsize=9, loc="left")
    disturbance.set_title(f"disturbance / bound ({funnel.assumption.form})", fontsize=9, loc="left")
    margin.axhline(0.0, color=INK, lw=0.8)
    disturbance.axhline(1.0, color=INK, lw=0.8)
    for run in runs:
        judged = [r for r in run if r.status is not Status.UNKNOWN]
        rows = [(*r.deviation, r.margin, r.assumption) for r in judged]
        for axes, values in zip(panels, np.array(rows).T, strict=False):
            _by_verdict(axes, judged, values)
    margin.set_ylim(max(LEAST_MARGIN, min(-0.05, margin.dataLim.y0 * 1.05)), 1.05)
    if disturbance.dataLim.y1 > MANY_BOUNDS:
        disturbance.set_yscale("log")
        disturbance.yaxis.set_major_formatter("{x:g}")
        disturbance.set_ylim(bottom=LEAST_DRAWN)
    else:
        disturbance.set_ylim(0.0, max(1.1, disturbance.dataLim.y1 * 1.05))
    inside = sum(all(r.status is Status.INSIDE for r in run) for run in runs)
    _title(figure, f"runs against the funnel: {inside} of {len(runs)} inside")
    seen = {r.status for run in runs for r in run}
    for status in (s for s in COLOURS if s in seen):
        panels[0].plot([], [], color=COLOURS[status], lw=2, label=status.value)
    _legend(figure, panels[:1])
    return figure


def _runs(readings: Sequence[Reading]) -> list[Sequence[Reading]]:
    """Apart where time begins again."""
    again = [i for i in range(1, len(readings)) if readings[i].t < readings[i - 1].t]
    return [readings[a:b] for a, b in pairwise([0, *again, len(readings)])]


def _by_verdict(axes: Axes, readings: Sequence[Reading], values: FloatArray) -> None:
    """Each status in its colour; a stretch begins at the sample before it, so that lines join."""
    t = np.array([r.t for r in readings])
    for status, colour in COLOURS.items():
        now = np.array([r.status is status for r in readings])
        drawn = now | np.append(now[1:], False)
        if now.any():
            alpha = 0.45 if status is Status.INSIDE else 0.9
            axes.plot(t, np.where(drawn, values, np.nan), color=colour, lw=0.9, alpha=alpha)


def _half_widths(axes: Axes, model: MeasuredState, t: FloatArray, widths: FloatArray) -> None:
    for i, signal in enumerate(model.x):
        colour = (BLUE, ORANGE, INK, RED)[i % 4]
        axes.semilogy(t, widths[:, i], color=colour, lw=1.5, label=_name(signal))
    axes.set_ylim(bottom=float(np.min(widths)) / LEGEND_ROOM)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.set_title("half-widths of the tube", fontsize=9, loc="left")
    axes.legend(fontsize=7, frameon=False, loc="lower left", ncols=1 if len(model) < 3 else 2)


def _disturbance(
    axes: Axes,
    model: MeasuredState,
    policy: SampledPolicy,
    funnel: SampledFunnel,
    runs: Dataset,
) -> None:
    a, t = funnel.assumption, _times(policy)
    for index, run in enumerate(runs):
        sizes = disturbance_of(model, policy, run, meter_of(funnel))
        axes.plot(t, sizes, color=GREY, lw=0.6, label=None if index else "commissioning runs")
    axes.axhline(a.measured, color=INK, lw=LINE, ls="--", label="largest measured")
    axes.axhline(a.bound, color=RED, lw=1.5, label=f"assumed bound, {a.safety_factor:g} times")
    axes.set_ylim(0.0, 1.5 * a.bound)
    axes.set_title(f"disturbance ({a.form})", fontsize=9, loc="left")
    axes.legend(fontsize=7, frameon=False, loc="upper right")


def _grid(count: int) -> tuple[Figure, list[Axes]]:
    """So many panels over time, in one row, or in two."""
    columns = count if count <= 3 else -(-count // 2)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.1 * columns + 0.4, 2.5 * rows + 0.7), layout="constrained")
    every = list(figure.subplots(rows, columns, squeeze=False, sharex=True).flat)
    for axes in every[count:]:
        axes.set_visible(False)
    for axes in every[max(0, count - columns) : count]:
        axes.set_xlabel("time [s]", fontsize=8)
        axes.tick_params(labelbottom=True)
    tidy(every[:count])
    return figure, every[:count]


def _times(policy: SampledPolicy) -> FloatArray:
    return np.arange(len(policy) + 1) * policy.period


def _nominal(axes: Axes, policy: SampledPolicy, values: FloatArray) -> None:
    axes.plot(_times(policy)[: len(values)], values, color=INK, lw=1.5, label="nominal")


def _box(axes: Axes, bounds: FloatArray) -> None:
    for bound, label in zip(bounds, ("box of the data", None), strict=True):
        axes.axhline(bound, color=GREY, lw=LINE, ls="--", label=label)


def _name(signal: Signal) -> str:
    return f"{signal.name} [{signal.unit}]"


def _title(figure: Figure, text: str) -> None:
    figure.suptitle(text, fontsize=11, x=0.01, ha="left")


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    found = [axes.get_legend_handles_labels() for axes in panels]
    handles = [handle for part, _ in found for handle in part]
    labels = [label for _, part in found for label in part]
    figure.legend(
        handles, labels, loc="outside lower left", ncols=len(labels), fontsize=8, frameon=False
    )
