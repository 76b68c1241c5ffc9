"""Pictures for reports (extra `report`: matplotlib). Each function returns a Figure."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bags.monitoring.replay import Replay
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.running.reading import Reading, Status

INK, BLUE, ORANGE, RED, GREY = "#222222", "#1f6fb4", "#d9822b", "#c23b3b", "#9aa0a6"
LINE = 1.2
Place = Literal["outside upper left", "outside upper right", "outside lower left"]


def svg(figure: Figure) -> str:
    """The figure as an element to put into a page, in which a narrow window can scroll."""
    stream = io.StringIO()
    _laid_out(figure).savefig(stream, format="svg")
    text = stream.getvalue()
    return f'<div class="picture">{text[text.index("<svg") :]}</div>'


def png(figure: Figure) -> bytes:
    """The figure as a PNG file's content."""
    stream = io.BytesIO()
    _laid_out(figure).savefig(stream, format="png", dpi=130)
    return stream.getvalue()


def _laid_out(figure: Figure) -> Figure:
    """With the places that its layout computes fixed, so that it is drawn once and not twice."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    return figure


def write_png(path: Path, figure: Figure) -> None:
    """The figure as a PNG file, whole or not at all."""
    files.write_atomically(path, png(figure))


def grid(
    count: int, columns: int, size: tuple[float, float], *, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """So many panels of this size [in], row by row, in at most so many columns."""
    columns = min(count, columns)
    rows = -(-count // columns)
    width, height = size[0] * columns + 0.4, size[1] * rows + 0.5
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
    for axes in panels[count:]:
        axes.set_visible(False)
    tidy(panels[:count])
    return figure, panels[:count]


def legend(
    figure: Figure, panels: Iterable[Axes], *, loc: Place = "outside upper left", ncols: int = 3
) -> None:
    """One legend for these panels, each label once."""
    named: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    figure.legend(
        list(named.values()),
        list(named),
        loc=loc,
        ncols=min(len(named), ncols),
        fontsize=8,
        frameon=False,
    )


def margins(replays: Sequence[Replay]) -> Figure:
    """Per replayed bag: measured output in the tube above, margin and assumption used below."""
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
            upper.set_ylabel(replay.axis + f"\n[{replay.unit}]" * bool(replay.unit), fontsize=8)
            lower.set_ylabel("margin,\nassumption used", fontsize=8)
    for kind in (0, 1):
        _same_limits([axes for axes in panels[kind::2].flat if axes.get_visible()])
    tidy([axes for axes in panels.flat if axes.get_visible()])
    legend(figure, panels[:2, 0], ncols=2 * columns)
    return figure


def _tube(axes: Axes, replay: Replay) -> None:
    judged = [r for r in replay.readings if r.status is not Status.UNKNOWN]
    t = np.array([r.t for r in judged])
    nominal = np.array([_output(r.nominal) for r in judged])
    width = np.array([r.half_widths[0] if r.half_widths else replay.half_width for r in judged])
    axes.fill_between(
        t, nominal - width, nominal + width, color=BLUE, alpha=0.18, lw=0, label="proved tube"
    )
    axes.plot(t, nominal, color=BLUE, lw=LINE, label="nominal")
    everything = replay.readings
    measured = [_output(r.measured) for r in everything]
    axes.plot([r.t for r in everything], measured, color=INK, lw=LINE, label="measured")
    bad = [r for r in judged if r.status is not Status.INSIDE]
    axes.plot(
        [r.t for r in bad],
        [_output(r.measured) for r in bad],
        ".",
        color=RED,
        ms=3,
        label="not inside",
    )
    since = f" from {bad[0].t:.3f} s" if bad else ""
    axes.set_title(f"{replay.name}:\n{replay.verdict}{since}", fontsize=8, loc="left")


def _output(values: Sequence[float]) -> float:
    """The one output that a tube is about; NaN where nothing was measured."""
    return values[0] if values else float("nan")


def _margin(axes: Axes, replay: Replay) -> None:
    judged: list[Reading] = [r for r in replay.readings if r.status is not Status.UNKNOWN]
    t = [r.t for r in judged]
    axes.axhline(0.0, color=RED, lw=0.8)
    axes.plot(t, [r.margin for r in judged], color=BLUE, lw=LINE, label="margin")
    axes.plot(t, [r.assumption for r in judged], color=ORANGE, lw=LINE, label="assumption used")
    lowest = min((r.margin for r in judged), default=0.0)
    axes.set_ylim(max(-1.0, min(0.0, lowest)) - 0.08, 1.3)


def _same_limits(panels: list[Axes]) -> None:
    limits = [axes.get_ylim() for axes in panels]
    for axes in panels:
        axes.set_ylim(min(lo for lo, _ in limits), max(hi for _, hi in limits))


def thinned(t: FloatArray, values: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """At most so many points: of each stretch of more the least and the largest."""
    if len(t) <= most:
        return t, values
    kept: list[int] = []
    for part in np.array_split(np.arange(len(t)), most // 2):
        ends = {int(part[np.argmin(values[part])]), int(part[np.argmax(values[part])])}
        kept += sorted(ends)
    return t[kept], values[kept]


def tidy(panels: Sequence[Axes]) -> None:
    """A light grid, small ticks, no box."""
    for axes in panels:
        axes.grid(alpha=0.25, lw=0.5)
        axes.tick_params(labelsize=8)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
