"""Pictures for reports (extra `report`: matplotlib). Each function returns a Figure."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from bags.monitoring.replay import Replay
from nlsid_core.identification import AnyCandidate, Candidate, simulate_trial
from nlsid_core.identification.prediction import one_step_residual
from nlsid_core.identification.validation import NORMAL_99
from nlsid_core.models import DifferenceEquation
from nlsid_core.monitor import Reading, Status
from nlsid_core.trajectory import Dataset, Trajectory

INK, BLUE, ORANGE, RED, GREY = "#222222", "#1f6fb4", "#d9822b", "#c23b3b", "#9aa0a6"
LINE = 1.2


def svg(figure: Figure) -> str:
    """The figure as an <svg> element to put into a page."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", bbox_inches="tight")
    text = stream.getvalue()
    return text[text.index("<svg") :]


def png(figure: Figure) -> bytes:
    """The figure as a PNG file's content."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130, bbox_inches="tight")
    return stream.getvalue()


def simulations(chosen: AnyCandidate, first: AnyCandidate, test: Dataset) -> Figure:
    """Measured against simulated on every test trial, with the input that drove it."""
    figure, panels = _grid(len(test))
    for axes, trial in zip(panels, test, strict=False):
        t = trial.t - trial.t[0]
        axes.step(t, trial.u[:, 0], where="post", color=GREY, lw=LINE, label=trial.u_names[0])
        axes.plot(t, trial.y[:, 0], color=INK, lw=LINE, label="measured")
        for candidate, color in ((first, ORANGE), (chosen, BLUE)):
            simulated = simulate_trial(candidate.model, trial)
            axes.plot(t, simulated[:, 0], color=color, lw=LINE, label=candidate.method)
        axes.set_title(trial.name, fontsize=9, loc="left")
    _label_outer(figure, panels, "time [s]", _axis_name(test.trajectories[0]))
    _shared_legend(figure, panels[0])
    return figure


def residuals(chosen: AnyCandidate, test: Dataset) -> Figure:
    """Simulation residuals over time, and the one-step residual's autocorrelation (99 % band)."""
    figure = Figure(figsize=(9.5, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    n = len(chosen.model)
    correlations = []
    for trial in test:
        simulated = simulate_trial(chosen.model, trial)
        left.plot(trial.t - trial.t[0], trial.y[:, 0] - simulated[:, 0], lw=0.9, label=trial.name)
        correlations.append(_autocorrelation(one_step_residual(chosen.model, trial)[:, 0], 20))
    left.set_xlabel("time [s]")
    left.set_ylabel(f"measured - simulated [{test.trajectories[0].y_units[0]}]")
    left.legend(fontsize=7, ncols=2, frameon=False)
    rows = sum(len(trial) - n for trial in test)
    band = NORMAL_99 / np.sqrt(rows)
    right.axhspan(-band, band, color=GREY, alpha=0.3, lw=0)
    right.stem(
        np.arange(1, 21),
        np.mean(correlations, axis=0)[1:],
        basefmt=" ",
        linefmt=BLUE,
        markerfmt=".",
    )
    right.set_xlabel("lag [samples]")
    right.set_ylabel("autocorrelation, one-step residual")
    _tidy([left, right])
    return figure


def poles(chosen: Candidate[DifferenceEquation]) -> Figure:
    """The model's poles in the unit circle, and the circle of the certified rate."""
    figure = Figure(figsize=(3.6, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.add_patch(Circle((0, 0), 1.0, fill=False, color=INK, lw=LINE))
    if chosen.proof is not None:
        rate = chosen.proof.rate
        axes.add_patch(Circle((0, 0), rate, fill=False, color=BLUE, ls="--", lw=LINE))
        axes.text(
            0,
            0.04 - rate,
            f"proved rate {rate:.3f}",
            color=BLUE,
            ha="center",
            va="bottom",
            fontsize=8,
        )
    z = chosen.model.poles
    axes.plot(z.real, z.imag, "x", color=RED, ms=7)
    axes.set_aspect("equal")
    axes.set_xlim(-1.1, 1.1)
    axes.set_ylim(-1.1, 1.1)
    axes.set_xlabel("real")
    axes.set_ylabel("imaginary")
    _tidy([axes])
    return figure


def margins(replays: Sequence[Replay]) -> Figure:
    """Per replayed bag: measured output in the tube above, margin and budget spent below."""
    columns = min(len(replays), 4)
    rows = -(-len(replays) // columns)
    figure = Figure(figsize=(3.1 * columns + 0.6, 3.6 * rows), layout="constrained")
    heights = [3, 2] * rows
    panels = figure.subplots(
        2 * rows, columns, squeeze=False, sharex=True, gridspec_kw={"height_ratios": heights}
    )
    for axes in panels.flat:
        axes.set_visible(False)
    for index, replay in enumerate(replays):
        upper = panels[2 * (index // columns), index % columns]
        lower = panels[2 * (index // columns) + 1, index % columns]
        upper.set_visible(True)
        lower.set_visible(True)
        _tube(upper, replay)
        _margin(lower, replay)
        lower.set_xlabel("time [s]", fontsize=8)
        if index % columns == 0:
            upper.set_ylabel(f"{replay.axis} [{replay.unit}]", fontsize=8)
            lower.set_ylabel("margin, budget spent", fontsize=8)
    for kind in (0, 1):
        _same_limits([axes for axes in panels[kind::2].flat if axes.get_visible()])
    _tidy([axes for axes in panels.flat if axes.get_visible()])
    handles, labels = [], []
    for axes in (panels[0, 0], panels[1, 0]):
        found = axes.get_legend_handles_labels()
        handles += found[0]
        labels += found[1]
    figure.legend(
        handles, labels, loc="outside upper left", ncols=len(labels), fontsize=8, frameon=False
    )
    return figure


def _tube(axes: Axes, replay: Replay) -> None:
    judged = [r for r in replay.readings if r.status is not Status.UNKNOWN]
    t = np.array([r.t for r in judged])
    nominal = np.array([r.nominal for r in judged])
    width = replay.half_width
    axes.fill_between(
        t, nominal - width, nominal + width, color=BLUE, alpha=0.18, lw=0, label="proved tube"
    )
    axes.plot(t, nominal, color=BLUE, lw=LINE, label="nominal")
    everything = replay.readings
    axes.plot([r.t for r in everything], [r.measured for r in everything], color=INK, lw=LINE,
              label="measured")  # fmt: skip
    bad = [r for r in judged if r.status is not Status.INSIDE]
    axes.plot(
        [r.t for r in bad], [r.measured for r in bad], ".", color=RED, ms=3, label="not inside"
    )
    since = f" from {bad[0].t:.3f} s" if bad else ""
    axes.set_title(f"{replay.name}: {replay.verdict}{since}", fontsize=8, loc="left")


def _margin(axes: Axes, replay: Replay) -> None:
    judged: list[Reading] = [r for r in replay.readings if r.status is not Status.UNKNOWN]
    t = [r.t for r in judged]
    axes.axhline(0.0, color=RED, lw=0.8)
    axes.plot(t, [r.margin for r in judged], color=BLUE, lw=LINE, label="margin")
    axes.plot(t, [r.budget_spent for r in judged], color=ORANGE, lw=LINE, label="budget spent")
    lowest = min((r.margin for r in judged), default=0.0)
    axes.set_ylim(max(-1.0, min(0.0, lowest)) - 0.08, 1.3)


def _same_limits(panels: list[Axes]) -> None:
    limits = [axes.get_ylim() for axes in panels]
    for axes in panels:
        axes.set_ylim(min(lo for lo, _ in limits), max(hi for _, hi in limits))


def _autocorrelation(values: np.ndarray, lags: int) -> np.ndarray:
    centred = values - values.mean()
    full = np.correlate(centred, centred, mode="full")[len(centred) - 1 :]
    return np.asarray(full[: lags + 1] / full[0])


def _grid(count: int) -> tuple[Figure, list[Axes]]:
    columns = min(count, 4)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.1 * columns, 2.1 * rows + 0.4), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes in list(panels.flat)[count:]:
        axes.set_visible(False)
    _tidy(list(panels.flat))
    return figure, list(panels.flat)[:count]


def _label_outer(figure: Figure, panels: list[Axes], x: str, y: str) -> None:
    figure.supxlabel(x, fontsize=9)
    figure.supylabel(y, fontsize=9)
    for axes in panels:
        axes.tick_params(labelsize=8)


def _shared_legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", ncols=len(labels), fontsize=8, frameon=False
    )


def _axis_name(trial: Trajectory) -> str:
    return f"{trial.y_names[0]} [{trial.y_units[0]}]"


def _tidy(panels: list[Axes]) -> None:
    for axes in panels:
        axes.grid(alpha=0.25, lw=0.5)
        axes.tick_params(labelsize=8)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
