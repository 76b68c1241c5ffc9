"""Pictures of choices: validation error against order, test error of every method (PNG)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from nlsid_core.identification import Candidate, Model, Selection, Validation

MOST_LINES = 8  # of a selection; more cannot be told apart
SHOWN_ERROR = 100.0  # %: a mean does as well; bars and lines end there


@dataclass(frozen=True, eq=False)
class Scored:
    """A candidate of the class `label` with its scores."""

    label: str
    candidate: Candidate[Model]
    scores: Validation


def draw_selection(selection: Selection, options: Mapping[str, Sequence[object]]) -> bytes:
    """Training and validation error over the option with most values, a line for each other one."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    from bags.pictures import plots  # matplotlib only where something is drawn

    along = max(options, key=lambda key: len(options[key]))
    values = list(options[along])
    numbers = [float(v) for v in values if isinstance(v, int | float)]
    numeric = len(numbers) == len(values)
    at = numbers if numeric else [float(place) for place in range(len(values))]
    places = dict(zip(map(repr, values), at, strict=True))
    lines: dict[str, list[tuple[float, float, float]]] = {}
    best = (0.0, 0.0)
    for chosen, tried in zip(product(*options.values()), selection.tried, strict=True):
        point = dict(zip(options, chosen, strict=True))
        place = places[repr(point.pop(along))]
        label = ", ".join(f"{key} {value}" for key, value in point.items())
        errors = (tried.error("validation"), tried.error("train"))
        lines.setdefault(label, []).append((place, *errors))
        if tried.model_class is selection.best:
            best = (place, errors[0])
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    colours = [plots.BLUE, plots.ORANGE, plots.RED, "#2b8a3e", "#7b4fa3", "#8c6d31", "#444444"]
    drawn = sorted(lines.items(), key=lambda item: min(e for _, e, _ in item[1]))[:MOST_LINES]
    for number, (label, points) in enumerate(drawn):
        x, validation, train = np.array(sorted(points)).T
        colour = colours[number % len(colours)]
        finite = np.isfinite(validation)
        name = "validation" + (f", {label}" if label else "")
        axes.plot(x[finite], validation[finite], "o-", color=colour, lw=1.4, ms=4, label=name)
        if len(drawn) <= 2:
            axes.plot(
                x[finite],
                train[finite],
                ":",
                color=colour,
                lw=1.2,
                label="training" + (f", {label}" if label else ""),
            )
        for nowhere in x[~finite]:
            axes.annotate(
                "no model",
                (nowhere, 0.02),
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize=7,
                color=colour,
                ha="center",
            )
    axes.plot(*best, "o", ms=11, mfc="none", mec=plots.INK, mew=1.5, label="chosen")
    axes.annotate(f"{best[1]:.2f} %", best, (9, 7), textcoords="offset points", fontsize=8)
    if numeric:
        axes.xaxis.set_major_locator(MaxNLocator(integer=all(isinstance(v, int) for v in values)))
    else:
        axes.set_xticks(range(len(values)), [str(v) for v in values])
    room = 0.06 * max(max(at) - min(at), 1.0)
    axes.set_xlim(min(at) - room, max(at) + room)
    axes.set_xlabel(along)
    axes.set_ylabel("simulation error [%]")
    shown = [e for _, points in drawn for _, e, _ in points if np.isfinite(e)]
    if max(shown) > 5 * min(shown) > 0:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    axes.margins(y=0.15)
    axes.legend(fontsize=8, frameon=False)
    plots.tidy([axes])
    return plots.png(figure)


def draw_comparison(rows: Sequence[Scored]) -> bytes:
    """A bar for each candidate: simulation error on the test trials, by whether it is proved."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from bags.pictures import plots

    ranked = sorted(rows, key=lambda row: -row.scores.simulation_percent)
    figure = Figure(figsize=(9.5, 0.42 * len(ranked) + 1.2), layout="constrained")
    axes = figure.subplots()
    for place, row in enumerate(ranked):
        error = row.scores.simulation_percent
        proved = row.candidate.proof is not None
        axes.barh(place, min(error, SHOWN_ERROR), color=plots.BLUE if proved else plots.GREY)
        text = f"{error:.2f} %" if np.isfinite(error) else "diverges"
        axes.annotate(
            text,
            (min(error, SHOWN_ERROR), place),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axes.set_yticks(
        range(len(ranked)),
        [f"{row.label}\n{row.candidate.method.title}" for row in ranked],
        fontsize=7,
    )
    axes.set_xlabel("simulation error on the test trials [%]", fontsize=9)
    axes.set_xlim(0.0, 1.15 * min(max(r.scores.simulation_percent for r in rows), SHOWN_ERROR))
    axes.legend(
        handles=[
            Patch(color=plots.BLUE, label="proved stable"),
            Patch(color=plots.GREY, label="not proved"),
        ],
        fontsize=8,
        frameon=False,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=2,
    )
    axes.set_ylim(-0.6, len(ranked) - 0.4)
    plots.tidy([axes])
    axes.grid(axis="y", visible=False)
    return plots.png(figure)
