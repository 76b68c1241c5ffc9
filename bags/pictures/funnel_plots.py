"""Pictures of funnels around trajectories (extra `report`: matplotlib)."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from bags.pictures.plots import BLUE, GREY, INK, LINE, ORANGE, write_png
from nlsid_core.arrays import FloatArray
from nlsid_core.design import FunnelDesign, Goal
from nlsid_core.errors import DataError
from nlsid_core.funnels.continuous import ContinuousFunnel

OUTLINES = 80  # ellipses of a projected tube: their shadows join into one
RINGS = 6  # of them drawn with a line
PROJECTIONS = 3  # at most
DECADE = 10.0  # of margins that differ by more the logarithm is drawn


def write_funnel_picture(path: Path, design: FunnelDesign) -> None:
    """Draw `funnel_picture` into a PNG file."""
    write_png(path, funnel_picture(design))


def funnel_picture(design: FunnelDesign) -> Figure:
    """Above, the tube with its nominal: onto pairs of states, and over time where there is room.

    Below, the volume beside the first guess's, the widths, and the certified margin over time.
    Raises DataError for a design that was read from files: they do not keep the search.
    """
    if design.found is None:
        raise DataError(
            "the picture shows how the funnel was found, which its files do not keep: draw it of "
            "what `design` returns, or take `nlsid report`"
        )
    funnel = design.funnel
    figure = Figure(figsize=(12, 7), layout="constrained")
    rows: Any = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    pairs = state_pairs(funnel.n)
    over_time = range(min(funnel.n, PROJECTIONS - len(pairs)))
    panels = np.atleast_1d(rows[0].subplots(1, len(pairs) + len(over_time)))
    for axes, pair in zip(panels, pairs, strict=False):
        _tube(axes, funnel, pair, design.found.goal)
    for i, axes in zip(over_time, panels[len(pairs) :], strict=True):
        _tube_over_time(axes, funnel, i)
    panels[0].legend(frameon=False, fontsize=8)
    volume, widths, margin = rows[1].subplots(1, 3)
    _volume(volume, design)
    _widths(widths, funnel)
    _margin(margin, design)
    for axes in (*panels, volume, widths, margin):
        axes.grid(alpha=0.25, lw=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.xaxis.label.set_size(9)
        axes.yaxis.label.set_size(9)
    figure.suptitle(
        f"funnel proved from {funnel.t0:g} to {funnel.tf:g} s: "
        f"{len(design.found.proved.pieces)} pieces, "
        f"least margin {np.min(design.found.proved.margins):.2g} 1/s",
        fontsize=11,
        x=0.01,
        ha="left",
    )
    return figure


def state_pairs(n: int) -> list[tuple[int, int]]:
    """Which states are drawn against each other: 0-1, 2-3, 4-5, and the last two if n is odd."""
    pairs = [(i, i + 1) for i in range(0, n - 1, 2)][:PROJECTIONS]
    if n % 2 and 1 < n < 2 * PROJECTIONS:
        pairs.append((n - 2, n - 1))
    return pairs


def _tube(axes: Axes, funnel: ContinuousFunnel, pair: tuple[int, int], goal: Goal) -> None:
    times = np.linspace(funnel.t0, funnel.tf, OUTLINES)
    shadows = [funnel.outline(float(t), pair) for t in times]
    axes.add_collection(PolyCollection(shadows, facecolors="#dbe8f4", edgecolors="none", zorder=1))
    for t in np.linspace(funnel.t0, funnel.tf, RINGS):
        ring = funnel.outline(float(t), pair)
        axes.plot(
            *ring.T,
            color=BLUE,
            lw=0.7,
            alpha=0.8,
            zorder=2,
            label="tube" if t == funnel.t0 else None,
        )
    path = funnel.x(np.linspace(funnel.t0, funnel.tf, 400))[:, list(pair)]
    axes.plot(*path.T, color=INK, lw=LINE, label="nominal", zorder=4)
    axes.plot(*path[0], "o", color=INK, ms=5, mfc="white", label="start", zorder=5)
    axes.plot(*path[-1], "o", color=INK, ms=5, label="end", zorder=5)
    end = ContinuousFunnel(
        funnel.x, np.array([goal.P] * len(funnel.t)), np.ones(len(funnel.t)), "", ""
    ).outline(funnel.tf, pair)
    shifted = end + (goal.centre - funnel.nominal(funnel.tf))[list(pair)]
    axes.plot(*shifted.T, color=ORANGE, lw=LINE, ls="--", label="goal", zorder=3)
    axes.set_xlabel(f"x{pair[0]}")
    axes.set_ylabel(f"x{pair[1]}")
    axes.autoscale_view()


def _tube_over_time(axes: Axes, funnel: ContinuousFunnel, i: int) -> None:
    times = np.linspace(funnel.t0, funnel.tf, 400)
    middle, width = funnel.x(times)[:, i], _half_widths(funnel, times)[:, i]
    axes.fill_between(times, middle - width, middle + width, color="#dbe8f4", lw=0, label="tube")
    axes.plot(times, middle, color=INK, lw=LINE, label="nominal")
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"x{i}")


def _volume(axes: Axes, design: FunnelDesign) -> None:
    times = np.linspace(design.funnel.t0, design.funnel.tf, 300)
    for funnel, color, label in (
        (design.found.first, GREY, "first guess, not proved"),
        (design.funnel, BLUE, "proved"),
    ):
        volumes = [funnel.volume(float(t)) for t in times]
        axes.plot(times, volumes, color=color, lw=1.5 * LINE, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("volume of {V ≤ 1}")
    axes.legend(frameon=False, fontsize=8)


def _widths(axes: Axes, funnel: ContinuousFunnel) -> None:
    times = np.linspace(funnel.t0, funnel.tf, 300)
    widths = _half_widths(funnel, times)
    for i in range(funnel.n):
        color = (BLUE, ORANGE, INK, GREY)[i % 4]
        line = ("-", "--", ":")[i // 4 % 3]
        axes.plot(times, widths[:, i], color=color, ls=line, lw=LINE, label=f"x{i}")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("half-width of the tube, each state")
    axes.legend(frameon=False, fontsize=8, ncols=-(-funnel.n // 6))


def _margin(axes: Axes, design: FunnelDesign) -> None:
    pieces, funnel = design.found.proved.pieces, design.funnel
    h = np.diff(funnel.t)[pieces.interval] / 2.0**pieces.level
    start = funnel.t[pieces.interval] + pieces.index * h
    axes.hlines(design.found.proved.margins, start, start + h, color=BLUE, lw=2)
    if np.max(design.found.proved.margins) > DECADE * np.min(design.found.proved.margins):
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, 1.1 * float(np.max(design.found.proved.margins)))
        axes.ticklabel_format(axis="y", scilimits=(-2, 3))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("certified -dV/dt on the boundary [1/s]")


def _half_widths(funnel: ContinuousFunnel, times: FloatArray) -> FloatArray:
    """(times, n) the largest |x_i - x0_i| in the tube."""
    shapes = np.array([funnel.shape(float(t)) for t in times])
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(shapes), axis1=1, axis2=2)))
