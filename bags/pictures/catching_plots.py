"""The picture of the faults that a funnel catches (extra `report`: matplotlib)."""

from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bags.monitoring.catching import Catching
from bags.pictures.plots import BLUE, INK, LINE, ORANGE, tidy

TITLE = 60  # letters of a line
SHADES = (BLUE, "#5f6b73", "#9aa0a6", "#cfd3d6")  # of the tube and the other detectors


def catching(found: Catching) -> Figure:
    """Left, each output's error on the untouched trials in the tube, beside half the range.

    Right, how long after each fault the tube and other detectors alarm, and in how many trials.
    """
    p = len(found.widths)
    figure = Figure(figsize=(11, max(4.2, 2.4 * p)), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1, 1.15))
    panels = halves[0].subplots(p, 1, squeeze=False)[:, 0]
    for j, axes in enumerate(panels):
        _errors(axes, found, j)
    panels[-1].set_xlabel("time [s]", fontsize=8)
    delays = halves[1].subplots()
    _delays(delays, found)
    tidy([*panels, delays])
    return figure


def _errors(axes: Axes, found: Catching, j: int) -> None:
    width = found.widths[j]
    following = [
        (t, w[:, j]) for (t, _), w in zip(found.errors, found.half_widths, strict=True) if len(w)
    ]
    if not following:
        ends = -width.half_width, width.half_width
        axes.axhspan(*ends, color=BLUE, alpha=0.15, lw=0, label="tube")
    for number, (t, half) in enumerate(following):
        label = None if number else "tube, as each trial's commands go"
        axes.fill_between(t, -half, half, color=BLUE, alpha=0.08, lw=0, label=label)
    for number, (t, error) in enumerate(found.errors):
        axes.plot(
            t,
            error[:, j],
            color=INK,
            lw=0.7,
            alpha=0.8,
            label=None if number else "measured - simulated, untouched",
        )
    for sign in (-1, 1):
        axes.axhline(
            sign * width.range / 2,
            color=ORANGE,
            lw=LINE,
            ls="--",
            label="half the range" if sign > 0 else None,
        )
    widest = width.half_width if width.most is None else width.most
    most = 1.15 * min(max(widest, width.range / 2), 2.0 * max(width.half_width, width.range / 2))
    axes.set_ylim(-most, most)
    axes.set_ylabel(f"error of {width.name}" + f" [{width.unit}]" * bool(width.unit), fontsize=8)
    said = f"half-width {width.said}: {width.part}"
    axes.set_title(fill(said, TITLE), fontsize=8, loc="left", pad=36)
    axes.legend(frameon=False, fontsize=7, loc="lower left", bbox_to_anchor=(-0.02, 1), ncols=2)


def _delays(axes: Axes, found: Catching) -> None:
    """How long each fault goes unseen by each detector, and in how many trials it is seen at all.

    Faults that nothing sees are left out.
    """
    tried = [row for row in found.rows[1:] if not row.refused]
    rows = [row for row in tried if row.funnel.count or any(o.count for o in row.others.values())]
    untouched = found.rows[0]
    detectors = {"tube": untouched.funnel, **untouched.others}
    height = 0.8 / len(detectors)
    for number, name in enumerate(detectors):
        caught = [row.others.get(name, row.funnel) for row in rows]
        delays = np.nan_to_num([each.after for each in caught])
        places = np.arange(len(rows)) + number * height
        bars = axes.barh(places, delays, height, color=SHADES[number % len(SHADES)], label=name)
        counts = [f"{c.count} of {found.trials}" if c.count else "not caught" for c in caught]
        axes.bar_label(bars, counts, padding=3, fontsize=6)
    axes.set_yticks(np.arange(len(rows)) + 1.5 * height, [row.fault for row in rows])
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.set_xlabel("time from the fault to the alarm [s], median; shorter is better", fontsize=8)
    false = ", ".join(f"{name} {caught.count}" for name, caught in detectors.items())
    said = f"false alarms in {found.trials} trials without a fault: {false}"
    axes.set_title(said, fontsize=8, loc="left", pad=24)
    axes.legend(frameon=False, fontsize=7, ncols=4, loc="lower left", bbox_to_anchor=(-0.02, 1))
