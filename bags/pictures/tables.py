"""What is printed of methods and of faults; `html` puts what is printed into a page."""

import io
import math
from collections.abc import Callable, Sequence
from html import escape
from typing import Any, Final

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bags.monitoring.catching import Catching, Caught
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import counted, duration, percent
from nlsid_core.identification import Candidate, Fit, ImplicitProof, Model, stated_rate
from nlsid_core.models import StateAffineModel

STABILITY = "proved rate a sample (time constant)"
SHADES: Final = {"bold": "chosen", "green": "proved", "dark_orange3": "not"}  # classes of a page


class _Page(Console):
    """A console whose prints are elements of a page: tables are tables, all else paragraphs."""

    def __init__(self) -> None:
        super().__init__(file=io.StringIO())
        self.elements: list[str] = []

    def print(self, *objects: Any, style: Any = None, **_: Any) -> None:
        """Add an element for each object."""
        for printed in objects:
            shade = SHADES.get(str(style), "said")
            paragraph = f'<p class="{shade}">{escape(str(printed))}</p>'
            self.elements.append(_table(printed) if isinstance(printed, Table) else paragraph)


def html(say: Callable[[Console], None]) -> str:
    """Give what is printed as elements of a page, with its colours."""
    page = _Page()
    say(page)
    return "\n".join(page.elements)


def _table(table: Table) -> str:
    """A table as one of a page, its title above it and its caption below."""
    heads = "".join(f"<th>{escape(str(column.header))}</th>" for column in table.columns)
    cells = zip(*(column.cells for column in table.columns), strict=True)
    rows = "".join(
        f'<tr class="{SHADES.get(str(row.style), "")}">{"".join(map(_cell, each))}</tr>'
        for row, each in zip(table.rows, cells, strict=True)
    )
    titled, noted = (escape(str(words or "")) for words in (table.title, table.caption))
    return (
        f"<p>{titled}</p><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>"
        f'<p class="note">{noted}</p>'
    )


def _cell(cell: Any) -> str:
    text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
    shade = SHADES.get(str(text.spans[0].style), "") if text.spans else ""
    return f'<td class="{shade}">{escape(text.plain)}</td>'


def methods_table(fit: Fit[Model], test: Dataset, uses: Sequence[str] = ("test",)) -> Table:
    """Every method's errors on trials of these uses, time, and whether its model is stable."""
    table = Table(title=f"{fit.model}; {counted(len(test), 'test trial')}", title_justify="left")
    table.collapse_padding = True
    longest = max(len(candidate.method.title) for candidate in fit.candidates)
    table.add_column("method", no_wrap=longest <= 38)  # as long as the rate beside it stays whole
    for use in uses:
        table.add_column(f"{use} error", justify="right", min_width=7)
    table.add_column("time", justify="right", no_wrap=True)
    table.add_column(STABILITY, min_width=15)
    for candidate in fit.candidates:
        table.add_row(
            candidate.method.title,
            *(percent(fit.errors[use][candidate.method.name]) for use in uses),
            duration(candidate.seconds),
            stability(candidate),
            style="bold" if candidate is fit.chosen else "",
        )
    return table


def stability(candidate: Candidate[Model]) -> str:
    """The proved rate, or that none is, in colour."""
    if candidate.proof is None:
        return f"[dark_orange3]{candidate.unproved}"
    return f"[green]{stated_rate(candidate.proof, candidate.model.period)}"


def in_unit(data: Dataset, *percents: float, first: int = 0) -> str:
    """State percentages of the spread of one output in its unit; several outputs have no such text.

    first: sample of each trial from which on the spread counts. A 0 is left out: what is "at most"
    has one end. Two sets of trials compare by it: the calmer trials have the larger percentages.
    """
    spread = np.concatenate([trial.y[first:] for trial in data]).std(axis=0)
    if len(spread) > 1:
        return ""
    ends = " to ".join(f"{spread[0] * part / 100.0:.2g}" for part in percents if part)
    return f" ({ends} {data.trajectories[0].y_units[0] or 'in its unit'})"


def stability_sentence(chosen: Candidate[Model]) -> str:
    """What is proved of the model, and for which inputs."""
    if chosen.proof is None:
        why = f" ({chosen.remark})" if chosen.remark else ""
        return f"It is NOT PROVED stable{why}: nothing that is built on it is certified."
    inputs = "whatever these inputs are"
    if isinstance(chosen.model, StateAffineModel):
        low_high = ", ".join(f"[{low:g}, {high:g}]" for low, high in chosen.model.u_range)
        beyond = "clipped to it" if chosen.model.on_out_of_range == "clip" else "refused"
        inputs = f"for every input in {low_high}; others are {beyond}"
    if chosen.proof.rate >= 1.0 and isinstance(chosen.proof, ImplicitProof) and chosen.proof.box:
        inputs = "while these inputs keep them in the box of the proof"
    how = f"at the rate {stated_rate(chosen.proof, chosen.model.period)} a sample or faster"
    if chosen.proof.rate >= 1.0:
        how = "at no rate that is stated"
    return f"Proved: two of its runs under the same inputs approach each other {how}, {inputs}."


def catching_table(catching: Catching) -> Table:
    """What the funnel and other detectors catch of every sabotage, and how soon."""
    detectors = list(catching.rows[0].others)
    table = Table(
        title=f"caught of {counted(catching.trials, 'held-back trial')}, and after how many s "
        "(median)",
        caption=CATCHING_CAPTION,
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
        padding=0,  # 79 columns in all
    )
    table.add_column("fault", no_wrap=True)
    for name in ("outside", "violated", "alarm", "unknown", "after", *detectors):
        table.add_column(name, justify="right")
    for row in catching.rows:
        if row.refused:  # the reason is said below the table
            table.add_row(row.fault, *["-"] * (5 + len(detectors)))
            continue
        funnel = row.funnel
        parts = (funnel.outside, funnel.violated, funnel.alarmed, funnel.unjudged)
        counts = [str(count) for count in parts]
        caught = [row.others[name] for name in detectors]
        others = [f"{each.count} {_after(each)}" for each in caught]
        least = max((other.count for other in row.others.values()), default=0)
        style = "dark_orange3" if least > funnel.count else ""
        table.add_row(row.fault, *counts, _after(funnel), *others, style=style)
    return table


CATCHING_CAPTION = (
    "Outside, violated (an assumption) and alarm (only the monitor's CUSUM, of which nothing is "
    "proved) all count as caught. Unknown: not judged to the end. "
    "CUSUM, 3σ and box have the same safety factor and calibration trials, and no more false "
    "alarms (untouched). Coloured: one of them catches more."
)


def _after(caught: Caught) -> str:
    if math.isnan(caught.after):
        return "-"
    digits = next((d for d, least in ((0, 100.0), (1, 10.0)) if caught.after >= least), 2)
    return f"{caught.after:.{digits}f}"


def warn(console: Console, line: str) -> None:
    """Say what a person should know before they trust what was made."""
    console.print(
        f"warning: {line}", soft_wrap=True, markup=False, highlight=False, style="dark_orange3"
    )


def say_catching(console: Console, catching: Catching) -> None:
    """The widths, the table, and what is to be known of a tube that is too wide."""
    for width in catching.widths:
        console.print(
            f"half-width of {width.name}: {width.said}, {width.part}",
            soft_wrap=True,
            highlight=False,
        )
    console.print(catching_table(catching))
    for row in catching.rows:
        if row.refused:
            console.print(f"{row.fault} was not tried: {row.refused}", soft_wrap=True, markup=False)
    if alone := [f"{row.fault}: {row.output}" for row in catching.rows if row.output]:
        said = "a sensor's fault is in one output at a time; above is the one caught least: "
        console.print(said + "; ".join(alone), soft_wrap=True, markup=False, highlight=False)
    if false := catching.rows[0].funnel.count:
        warn(
            console,
            f"{false} of {catching.trials} held-back trials, nothing put into them, "
            f"{'is' if false == 1 else 'are'} not inside: expect such false alarms on a healthy "
            "robot; calibrate on more trials like those it will run, or raise safety_factor",
        )
    for line in (*catching.beyond, *catching.still, *catching.restarts, *catching.warnings()):
        warn(console, line)
