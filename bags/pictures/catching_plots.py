"""The picture of what a funnel catches (extra `report`: matplotlib)."""

from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bags.monitoring.catching import Catching
from bags.pictures.plots import BLUE, INK, LINE, ORANGE, tidy

TITLE = 60  # letters of a line
SHADES = ("#5f6b73", "#9aa0a6", "#cfd3d6")  # of the other detectors


def catching(found: Catching) -> Figure:
    """Left, each output's error on the untouched trials in the tube, beside half the range.

    Right, the part of the trials in which each sabotage is caught, by the funnel and by others.
    """
    p = len(found.widths)
    figure = Figure(figsize=(11, max(4.2, 2.4 * p)), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1, 1.15))
    panels = halves[0].subplots(p, 1, squeeze=False)[:, 0]
    for j, axes in enumerate(panels):
        _errors(axes, found, j)
    panels[-1].set_xlabel("time [s]", fontsize=8)
    caught = halves[1].subplots()
    _caught(caught, found)
    tidy([*panels, caught])
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
    axes.set_ylabel(f"error of {width.name} [{width.unit}]", fontsize=8)
    said = f"half-width {width.said}: {width.part}"
    axes.set_title(fill(said, TITLE), fontsize=8, loc="left", pad=36)
    axes.legend(frameon=False, fontsize=7, loc="lower left", bbox_to_anchor=(-0.02, 1), ncols=2)


def _caught(axes: Axes, found: Catching) -> None:
    rows = [row for row in found.rows if not row.refused]
    detectors = list(rows[0].others)
    height = 0.8 / (1 + len(detectors))
    places = np.arange(len(rows), dtype=float)
    left = np.zeros(len(rows))
    for label, color, counts in (
        ("outside", BLUE, [row.funnel.outside for row in rows]),
        ("assumption violated", "#7fb0d9", [row.funnel.violated for row in rows]),
        ("alarm (CUSUM)", "#b9d6b0", [row.funnel.alarmed for row in rows]),
        ("unknown", "#e8d9c4", [row.funnel.unjudged for row in rows]),
    ):
        axes.barh(places, counts, height, left=left, color=color, label=f"funnel: {label}")
        left += counts
    for number, name in enumerate(detectors, 1):
        counts = [row.others[name].count for row in rows]
        color = SHADES[(number - 1) % len(SHADES)]
        axes.barh(places + number * height, counts, height, color=color, label=name)
    axes.set_yticks(places + 1.5 * height, [row.fault for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(0, found.trials)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"caught, of {found.trials} held-back trials", fontsize=8)
    axes.legend(frameon=False, fontsize=7, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
