"""The command line `nlsid fleet`, and what `nlsid identify` says of many bags.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from bags.commands.options import (
    BagsArgument,
    ConfigOption,
    DesignArgument,
    PatienceOption,
    Sharing,
    config_of,
    flat,
    out,
    progress_bar,
    settings_if_any,
)
from nlsid_core.errors import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from bags.chain.config import Config
    from bags.fleet.monitor import FleetVerdict
    from bags.fleet.rows import Row
    from bags.fleet.run import Task
    from bags.fleet.trials import FleetTrials

LISTED = 20  # bags of a kind, by name
ROWS = 30  # of a table on the screen
WHOLE = 34  # letters of a name that is not broken

fleet_app = typer.Typer(
    name="fleet",
    help="Check and monitor many bags at once, on this machine or in object storage.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@dataclass(frozen=True)
class Fleet(Sharing):
    """Who reads the bags, how patiently, and what is kept and written of them."""

    patience: PatienceOption = 60.0
    manifest: Annotated[
        Path | None,
        typer.Option(help="A file that keeps what is read: the next run reads only what is new."),
    ] = None
    table: Annotated[
        Path | None,
        typer.Option("--out", help="A .parquet file with a row for every bag, and all findings."),
    ] = None

    def read(self, task: Task, bags: Mapping[str, Path], doing: str) -> tuple[Row, ...]:
        """A row of each bag; they are written, if they are to be."""
        from bags.fleet.rows import read_rows, write_parquet

        with progress_bar(doing) as progress:
            found = read_rows(
                task, bags, workers=self.workers(), manifest=self.manifest, progress=progress
            )
        if self.table is not None:
            write_parquet(found, self.table)
            out.print(f"wrote {self.table}", soft_wrap=True)
        return found


@fleet_app.command()
@flat
def check(
    folder: DesignArgument,
    bags: BagsArgument,
    fleet: Fleet,
    config: ConfigOption = None,
) -> None:
    """Say of every bag what its fitness, its clocks and its losses are, as one table.

    bad: `nlsid identify` leaves it out, or it is not fit; look: there is something to mend.
    Status 1 if a bag is bad, 2 if none is and one was not read.
    """
    from bags.chain.config import load_config
    from bags.fleet.bags import UNREAD, named_bags
    from bags.fleet.check import BAD, GOOD, LOOK, SERIOUS, CheckBag

    settings = load_config(config_of(folder, config))
    named = named_bags(bags, patience=fleet.patience)
    _say_misspelt(named, settings)
    found = fleet.read(CheckBag(settings), named, "checking")
    counts = Counter(row.verdict for row in found)
    _say_counts(found, fleet.manifest, [(counts[v], v) for v in SERIOUS])
    wrong = [row for verdict in SERIOUS[:-1] for row in found if row.verdict == verdict]
    if wrong:
        lost = {"lost": lambda row: _number(row, "lost", ".0f")}
        out.print(
            _table(
                wrong[:ROWS],
                {
                    "verdict": lambda row: row.verdict,
                    "start (UTC)": _when,
                    **(lost if any("lost" in row.numbers for row in wrong) else {}),
                    "what to look at": lambda row: _plain(row.reason),
                },
            )
        )
    if more := wrong[ROWS:]:
        left = Counter(row.verdict for row in more)
        said = ", ".join(f"{count} {verdict}" for verdict, count in left.items())
        out.print(f"and {len(more)} more ({said}); --out writes all of them")
    usable = [row for row in found if row.verdict in (LOOK, GOOD)]
    if usable and not any(row.numbers["moves"] for row in usable):
        out.print(
            "no command moves in any bag that can be used: there is little to identify from",
            soft_wrap=True,
        )
    if counts[BAD] or counts[UNREAD]:
        raise typer.Exit(1 if counts[BAD] else 2)


def _say_misspelt(names: Iterable[str], settings: Config) -> None:
    """Mind names in the split that are near a bag's: others may be of bags that lie elsewhere."""
    from bags.chain.steps import absent_from, with_parts

    for line in absent_from(with_parts(list(names), settings), settings):
        if line.endswith("?"):  # it asks whether another was meant
            out.print(f"mind: {line}", soft_wrap=True, markup=False, style="dark_orange3")


@fleet_app.command()
@flat
def monitor(
    folder: DesignArgument,
    bags: BagsArgument,
    fleet: Fleet,
    config: ConfigOption = None,
) -> None:
    """Hold every bag against one proved design: which are inside, and what they spend.

    How much of what is assumed each bag spends, the worst ten, and what that says of the next bag.
    Status 0 if all are inside with the assumption
    kept, 1 if one is not, 2 if one was not judged whole.
    """
    from bags.commands import show
    from bags.designs import documents
    from bags.fleet.bags import COPY, named_bags
    from bags.fleet.monitor import FleetVerdict, JudgeBag
    from bags.recordings.definitions import read_definitions
    from nlsid_core.running.reading import Status

    settings = settings_if_any(folder, config)
    design = documents.load(folder)
    definitions = read_definitions(settings.definitions if settings else ())
    task = JudgeBag(design, show.centre_of(settings), definitions)
    named = named_bags(bags, patience=fleet.patience)
    if settings is not None:
        _say_misspelt(named, settings)
    read = fleet.read(task, named, "judging")
    found = FleetVerdict(read, frozenset(design.made_with))
    counts = Counter(row.verdict for row in found.rows)
    _say_counts(read, fleet.manifest, [(counts[v], v) for v in _VERDICTS if counts[v]])
    _say_verdicts(found)
    if found.worst:
        worst = named[found.worst[0].bag]
        centre = f" --config {config}" if config else ""
        out.print(
            f"look at the first: nlsid view {folder} {worst}{centre}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    verdicts = {row.verdict for row in found.rows} - {COPY}
    if verdicts & {*BROKEN} or any("alarm" in row.said for row in found.rows):
        raise typer.Exit(1)
    if verdicts != {Status.INSIDE.value}:
        raise typer.Exit(2)


def _say_verdicts(found: FleetVerdict) -> None:
    from bags.fleet.bags import COPY, UNREAD

    if own := len(found.own):
        out.print(f"{own} of them made the design: a verdict on these says little", soft_wrap=True)
    if found.worst:
        _say_worst(found.worst)
    for line in found.ranks:
        out.print(line, soft_wrap=True, highlight=False)
    if found.ranks and found.made_of and not found.own:
        out.print(
            "none of these is known to be a bag that the design was made with. Those count above "
            "if they are here, read from elsewhere than for the design",
            soft_wrap=True,
        )
    bad = {row.bag: _since(row) for row in found.rows if row.verdict in BROKEN}
    _say_bags("outside, or what is assumed broken", bad)
    for what, title in (
        ("unjudged", "not judged whole"),
        ("beyond", "commanded beyond training"),
        ("alarm", "only the second alarm"),
    ):
        told = {row.bag: row.said[what] for row in found.rows if what in row.said}
        if what == "alarm":
            told = {bag: said for bag, said in told.items() if bag not in bad}
        _say_bags(title, told)
    for verdict, title in ((UNREAD, UNREAD), (COPY, "copies")):
        _say_bags(title, {row.bag: row.reason for row in found.rows if row.verdict == verdict})


BROKEN = ("outside", "assumption violated")
_VERDICTS = {  # and the heads of their columns
    "outside": "outside",
    "assumption violated": "violated",
    "unknown": "unknown",
    "not read": "not read",
    "copy": "copy",
    "inside": "inside",
}


def _say_worst(worst: Sequence[Row]) -> None:
    from bags.fleet.monitor import in_percent

    count = f"the {len(worst)} bags that" if len(worst) > 1 else "the bag that"
    out.print(f"{count} spent the most, and when:")
    out.print(
        _table(
            worst,
            {
                "spent": lambda row: in_percent(row.numbers["spent"]),
                "at": lambda row: _number(row, "spent_at", ".3f", " s"),
                "start (UTC)": _when,
                "verdict": lambda row: _VERDICTS[row.verdict],
                "bad from": lambda row: _number(row, "bad_at", ".3f", " s"),
                "margin": lambda row: _number(row, "margin", ".3f"),
            },
        )
    )


def _number(row: Row, name: str, form: str, unit: str = "") -> str:
    """A number of a row, - where it is not known."""
    return f"{row.numbers[name]:{form}}{unit}" if name in row.numbers else "-"


def _table(rows: Sequence[Row], columns: Mapping[str, Callable[[Row], str]]) -> Table:
    """A table that begins with the bags' names, whole ones if they are not long."""
    shown = Table(box=SIMPLE_HEAD, show_edge=False, padding=0)
    longest = max(len(row.bag) for row in rows)
    shown.add_column("bag", overflow="fold", no_wrap=longest <= WHOLE, max_width=WHOLE)
    for name in columns:
        numbers = name in ("spent", "at", "bad from", "margin", "lost")
        shown.add_column(
            name,
            justify="right" if numbers else "left",
            overflow="fold",
            min_width=10 if "UTC" in name else None,
        )
    for row in rows:
        shown.add_row(_plain(row.bag), *(cell(row) for cell in columns.values()))
    return shown


def _when(row: Row) -> str:
    """When it was recorded, to the minute, as people write it."""
    return row.start[:16].replace("T", " ")


def _since(row: Row) -> str:
    """Why a bag is bad, and from when on."""
    if " at t = " in row.reason:
        return row.reason
    return f"from {row.numbers['bad_at']:.3f} s on: {row.reason}"


def _say_counts(
    rows: Sequence[Row], manifest: Path | None, counts: Sequence[tuple[int, str]]
) -> None:
    """How many there are of each verdict, and how many were known from a run before."""
    count, known = len(rows), sum(row.known for row in rows)
    said = ", ".join(f"{n} {'copies' if word == 'copy' and n != 1 else word}" for n, word in counts)
    out.print(f"{counted(count, 'bag')}: {said}", soft_wrap=True, highlight=False)
    if manifest is not None:
        out.print(
            f"{known} of them known from {manifest}, {count - known} asked of now",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )


def say_read(found: FleetTrials, manifest: Path) -> None:
    """How many bags are used, and which are not and why."""
    count, left_out = len(found.answers), len(found.left_out)
    known = sum(answer.kept for answer in found.answers)
    out.print(
        f"{counted(count, 'bag')}: {count - left_out} used; {known} of them known from {manifest}",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    _say_bags("left out", found.left_out)


def _plain(text: str) -> str:
    """What others wrote, for a terminal: no markup, nothing that is not printed."""
    return escape(
        "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    )


def _say_bags(title: str, said: Mapping[str, str]) -> None:
    """Each of these bags, with what is said of it."""
    if said:
        out.print(f"{title}: {counted(len(said), 'bag')}")
    for name, reason in list(said.items())[:LISTED]:
        out.print(f"  {_plain(name)}: {_plain(reason)}", soft_wrap=True, highlight=False)
    if len(said) > LISTED:
        out.print(f"  and {len(said) - LISTED} more")
