"""Pictures of recorded signals (extra `report`: matplotlib)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bags.pictures.plots import BLUE, LINE, ORANGE, png, svg, thinned
from bags.signals.reader import Samples
from bags.signals.timing import seconds
from nlsid_core.errors import DataError
from nlsid_core.files import write_atomically

DRAWN = 20_000  # points a panel; of more, the least and the largest of each stretch are drawn


def draw_signals(samples: Sequence[Samples], *, title: str) -> Figure:
    """One panel a signal over time in s since the first stamp of all; gaps are left open."""
    origin = min(int(s.stamp_ns[0]) for s in samples)
    figure = Figure(figsize=(9.5, 0.8 + 1.7 * len(samples)), layout="constrained")
    panels = figure.subplots(len(samples), 1, sharex=True, squeeze=False)[:, 0]
    for axes, signal in zip(panels, samples, strict=True):
        t, values = thinned(seconds(signal.stamp_ns, origin), signal.values, DRAWN)
        steps = np.diff(t)
        gaps = np.flatnonzero(steps > 5 * np.median(steps)) + 1 if len(steps) else steps.astype(int)
        axes.plot(np.insert(t, gaps, np.nan), np.insert(values, gaps, np.nan), color=BLUE, lw=LINE)
        if len(t) < 200:
            axes.plot(t, values, ".", color=ORANGE, ms=3)
        axes.set_title(signal.path, fontsize=9, loc="left")
        axes.set_ylabel(f"[{signal.unit}]" if signal.unit else "")
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel(f"time [s] by {samples[0].clock}")
    figure.suptitle(title, fontsize=10)
    return figure


def write_picture(path: Path | str, figure: Figure) -> None:
    """A .png or .svg file, by its ending; DataError for another one."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".png", ".svg"):
        raise DataError(f"{path}: a picture is a .png or .svg file")
    write_atomically(Path(path), png(figure) if suffix == ".png" else svg(figure).encode())
