"""Pictures of funnels around trajectories (extra `report`: matplotlib)."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bags.pictures.plots import BLUE, GREY, INK, LINE, png
from nlsid_core import _json
from nlsid_core.continuous import Funnel
from nlsid_core.funnels import FunnelDesign

DECAY = 3.0  # of the first guess ρ = exp(-c (t_f - t)/(t_f - t₀)) drawn for comparison
OUTLINES = 25


def write_funnel_picture(path: Path, design: FunnelDesign) -> None:
    """Draw `funnel_picture` into a PNG file."""
    _json.write_atomically(path, png(funnel_picture(design)))


def funnel_picture(design: FunnelDesign) -> Figure:
    """The tube onto its first two states with the nominal; volume; certified margin over time."""
    funnel = design.funnel
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    tube, volume, margin = figure.subplots(1, 3)
    times = np.linspace(funnel.t0, funnel.tf, 200)
    if funnel.n > 1:
        for t in np.linspace(funnel.t0, funnel.tf, OUTLINES):
            tube.fill(*funnel.outline(float(t), (0, 1)).T, color=BLUE, alpha=0.12, lw=0)
        path = funnel.x(times)
        tube.plot(path[:, 0], path[:, 1], color=INK, lw=LINE, label="nominal")
        tube.set_xlabel("x0")
        tube.set_ylabel("x1")
    else:
        middle = funnel.x(times)[:, 0]
        width = np.array([1 / np.sqrt(funnel.shape(float(t))[0, 0]) for t in times])
        tube.fill_between(times, middle - width, middle + width, color=BLUE, alpha=0.2, lw=0)
        tube.plot(times, middle, color=INK, lw=LINE, label="nominal")
        tube.set_xlabel("time [s]")
        tube.set_ylabel("x0")
    tube.legend(frameon=False)
    first = Funnel(
        funnel.x,
        funnel.P / funnel.rho[:, None, None],
        np.exp(-DECAY * (funnel.tf - funnel.t) / (funnel.tf - funnel.t0)),
        "",
        "",
    )
    volume.plot(
        times, [first.volume(float(t)) for t in times], color=GREY, lw=LINE, label="scaled start"
    )
    volume.plot(
        times, [funnel.volume(float(t)) for t in times], color=BLUE, lw=LINE, label="proved"
    )
    volume.set_xlabel("time [s]")
    volume.set_ylabel("volume")
    volume.legend(frameon=False)
    pieces = design.proved.pieces
    h = np.diff(funnel.t)[pieces.interval] / 2.0**pieces.level
    start = funnel.t[pieces.interval] + pieces.index * h
    margin.hlines(design.proved.margins, start, start + h, color=BLUE, lw=2)
    margin.set_yscale("log")
    margin.set_xlabel("time [s]")
    margin.set_ylabel("proved -dV/dt on the boundary [1/s]")
    for axes in (tube, volume, margin):
        axes.grid(alpha=0.25, lw=0.5)
    return figure
