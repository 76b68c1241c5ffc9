"""The command line `nlsid fleet`, and what `nlsid identify` says of many bags.

A command imports what it runs when it is called.
"""

from __future__ import annotations

import math
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
    settings_if_any,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from bags.chain.config import Config
    from bags.fleet.check import Checked
    from bags.fleet.monitor import FleetVerdict, Judged
    from bags.fleet.trials import FleetTrials

LISTED = 20  # bags of a kind, by name
ROWS = 30  # of a table on the screen
WHOLE = 34  # letters of a name that is not broken

fleet_app = typer.Typer(
    name="fleet",
    help="Many bags at once, on this machine or in object storage: are they fit, are they inside.",
    no_args_is_help=True,
)


@dataclass(frozen=True)
class Fleet(Sharing):
    """Who reads the bags, how patiently, and what is kept of them."""

    patience: PatienceOption = 60.0
    manifest: Annotated[
        Path | None,
        typer.Option(help="A file that keeps what is read: the next run reads only what is new."),
    ] = None


@fleet_app.command()
@flat
def check(
    folder: DesignArgument,
    bags: BagsArgument,
    fleet: Fleet,
    config: ConfigOption = None,
    table: Annotated[
        Path | None, typer.Option("--out", help="A .parquet file for all rows and findings.")
    ] = None,
) -> None:
    """Say of every bag what its fitness, its clocks and its losses are, as one table.

    bad: `nlsid identify` leaves it out, or it is not fit; look: there is something to mend.
    Status 1 if a bag is bad, 2 if none is and one was not read.
    """
    from bags.chain.config import load_config
    from bags.commands.progress import progress_bar
    from bags.fleet.bags import UNREAD, named_bags
    from bags.fleet.check import BAD, SERIOUS, check_fleet, write_parquet

    settings = load_config(config_of(folder, config))
    named = named_bags(bags, patience=fleet.patience)
    _say_misspelt(named, settings)
    with progress_bar("checking") as progress:
        found = check_fleet(
            named, settings, workers=fleet.workers(), manifest=fleet.manifest, progress=progress
        )
    if table is not None:
        write_parquet(found.rows, table)
    counts = Counter(row.verdict for row in found.rows)
    _say_counts(len(found.rows), found.known, fleet.manifest, [(counts[v], v) for v in SERIOUS])
    wrong = [row for verdict in SERIOUS[:-1] for row in found.rows if row.verdict == verdict]
    if wrong:
        out.print(_checked_table(wrong[:ROWS]))
    if more := wrong[ROWS:]:
        left = Counter(row.verdict for row in more)
        said = ", ".join(f"{count} {verdict}" for verdict, count in left.items())
        out.print(f"and {len(more)} more ({said}); --out writes all of them")
    if found.still:
        out.print(
            "no command moves in any bag that can be used: there is little to identify from",
            soft_wrap=True,
        )
    if table is not None:
        out.print(f"wrote {table}", soft_wrap=True)
    if counts[BAD] or counts[UNREAD]:
        raise typer.Exit(1 if counts[BAD] else 2)


def _say_misspelt(names: Iterable[str], settings: Config) -> None:
    """Mind names in the split that are near a bag's: others may be of bags that lie elsewhere."""
    from bags.chain.steps import absent_from, with_parts

    for line in absent_from(with_parts(list(names), settings), settings):
        if line.endswith("?"):  # it asks whether another was meant
            out.print(f"mind: {line}", soft_wrap=True, markup=False, style="dark_orange3")


def _checked_table(rows: Sequence[Checked]) -> Table:
    shown = _table(rows)
    shown.add_column("verdict", no_wrap=True)
    shown.add_column("start (UTC)", min_width=10)
    if any(row.lost is not None for row in rows):
        shown.add_column("lost", justify="right")
    shown.add_column("what to look at", overflow="fold", ratio=1)
    for row in rows:
        cells = [_plain(row.bag), row.verdict, _when(row.start)]
        if any(other.lost is not None for other in rows):
            cells.append("-" if row.lost is None else str(row.lost))
        shown.add_row(*cells, _plain(row.trouble))
    return shown


@fleet_app.command()
@flat
def monitor(
    folder: DesignArgument,
    bags: BagsArgument,
    fleet: Fleet,
    config: ConfigOption = None,
    table: Annotated[
        Path | None, typer.Option("--out", help="A .parquet file with a row for every bag.")
    ] = None,
) -> None:
    """Hold every bag against one proved design: which robots, which days, which assumption.

    How much of what is assumed each bag spends, the worst ten, what that says of the next bag, and
    whether the newest month is like the calibration. Status 0 if all are inside with the assumption
    kept, 1 if one is not, 2 if one was not judged whole.
    """
    from bags.commands import show
    from bags.commands.progress import progress_bar
    from bags.designs import documents
    from bags.fleet.bags import COPY, named_bags
    from bags.fleet.check import write_parquet
    from bags.fleet.monitor import JudgeBag, calibration_spent, monitor_fleet
    from bags.recordings.definitions import read_definitions
    from nlsid_core.running.reading import Status

    settings = settings_if_any(folder, config)
    design = documents.load(folder)
    definitions = read_definitions(settings.definitions if settings else ())
    task = JudgeBag(design, show.centre_of(settings), definitions)
    named = named_bags(bags, patience=fleet.patience)
    if settings is not None:
        _say_misspelt(named, settings)
    with progress_bar("judging") as progress:
        found = monitor_fleet(
            named,
            task,
            calibration_spent(folder, design),
            workers=fleet.workers(),
            manifest=fleet.manifest,
            progress=progress,
        )
    if table is not None:
        write_parquet(found.rows, table)
    _say_verdicts(found, fleet.manifest, table)
    if found.worst:
        worst = named[found.worst[0].bag]
        centre = f" --config {config}" if config else ""
        out.print(
            f"look at the first: nlsid view {folder} {worst}{centre}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    if table is not None:
        out.print(f"wrote {table}", soft_wrap=True)
    verdicts = {row.verdict for row in found.rows} - {COPY}
    if verdicts & {Status.OUTSIDE.value, Status.ASSUMPTION_VIOLATED.value} or any(
        row.alarm for row in found.rows
    ):
        raise typer.Exit(1)
    if verdicts != {Status.INSIDE.value}:
        raise typer.Exit(2)


def _say_verdicts(found: FleetVerdict, manifest: Path | None, table: Path | None) -> None:
    from bags.fleet.bags import COPY, UNREAD

    counts = Counter(row.verdict for row in found.rows)
    words = [word for word in _VERDICTS if counts[word]]
    _say_counts(len(found.rows), found.known, manifest, [(counts[word], word) for word in words])
    if own := found.own:
        out.print(f"{own} of them made the design: a verdict on these says little", soft_wrap=True)
    for key, title in (("robot", "robots"), ("day", "days")):
        _say_groups(title, found.by(key), words, table)
    for what, count in Counter(r.assumption for r in found.rows if r.assumption).most_common():
        out.print(f"broken in {_bags(count)}: {what}", soft_wrap=True, markup=False)
    if most := max(found.histogram):
        out.print("bags by how much of what is assumed they spent:")
        for k, count in enumerate(found.histogram):
            label = f"{10 * k} to {10 * k + 10} %" if k < 10 else "over 100 %"
            out.print(f"{label:>12} {count:6d} {'#' * math.ceil(40 * count / most)}".rstrip())
    if found.worst:
        _say_worst(found.worst)
    for line in found.ranks:
        out.print(line, soft_wrap=True, highlight=False)
    if found.ranks and found.unrecognised:
        out.print(
            "none of these is known to be a bag that the design was made with. Those count above "
            "if they are here, read from elsewhere than for the design",
            soft_wrap=True,
        )
    drift = found.drift
    said = str(drift) if drift else "drift is not judged: no calibration trials beside the funnel, "
    out.print(said + ("" if drift else "or too few bags of the newest month"), soft_wrap=True)
    _say_bags(
        "outside, or what is assumed broken",
        {r.bag: _since(r) for r in found.rows if r.verdict in BROKEN},
    )
    _say_bags("not judged whole", {r.bag: r.unjudged for r in found.rows if r.unjudged})
    _say_bags("clock", {r.bag: r.clock for r in found.rows if r.clock})
    alarms = {r.bag: r.alarm for r in found.rows if r.alarm and r.verdict not in BROKEN}
    _say_bags("only the second alarm", alarms)
    for verdict, title in ((UNREAD, UNREAD), (COPY, "copies")):
        said_of = {row.bag: row.reason for row in found.rows if row.verdict == verdict}
        _say_bags(title, said_of)


BROKEN = ("outside", "assumption violated")
_VERDICTS = {  # and the heads of their columns
    "outside": "outside",
    "assumption violated": "violated",
    "unknown": "unknown",
    "not read": "not read",
    "copy": "copy",
    "inside": "inside",
}


def _say_groups(
    title: str, groups: Mapping[str, Sequence[Judged]], words: Sequence[str], table: Path | None
) -> None:
    """Those with trouble, as a table; how many have none, and how many are not shown."""
    from bags.fleet.monitor import trouble_in

    if list(groups) == ["-"]:
        return  # the bags' names have no folders
    troubled = {name: rows for name, rows in groups.items() if trouble_in(rows)}
    named = [name for name in troubled if name]  # the others are listed as not read
    out.print(f"{title} with trouble: {len(named)} of {len(set(groups) - {''})}")
    if not named:
        return
    shown = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    shown.add_column(title.removesuffix("s"), overflow="fold")
    for head in ("bags", *(_VERDICTS[word] for word in words)):
        shown.add_column(head, justify="right")
    for name in named[:ROWS]:
        rows = troubled[name]
        counts = Counter(row.verdict for row in rows)
        cells = (str(counts[word] or "") for word in words)
        shown.add_row(_plain(name), str(len(rows)), *cells)
    out.print(shown)
    if (more := len(named) - ROWS) > 0:
        rest = "--out writes every bag" if table is None else f"every bag is in {table}"
        out.print(f"and {more} more {title} with trouble, none with more; {rest}")


def _say_worst(worst: Sequence[Judged]) -> None:
    from bags.fleet.monitor import in_percent

    count = f"the {len(worst)} bags that" if len(worst) > 1 else "the bag that"
    out.print(f"{count} spent the most, and when:")
    shown = _table(worst)
    for column, justify in (
        ("spent", "right"),
        ("at", "right"),
        ("start (UTC)", "left"),
        ("verdict", "left"),
        ("bad from", "right"),
        ("margin", "right"),
    ):
        shown.add_column(column, justify=justify, min_width=10 if "UTC" in column else None)  # type: ignore[arg-type]
    for row in worst:
        shown.add_row(
            _plain(row.bag),
            in_percent(row.spent or 0.0),
            f"{row.spent_at:.3f} s",
            _when(row.start),
            _VERDICTS[row.verdict],
            f"{row.bad_at:.3f} s" if row.bad_from else "-",
            "-" if row.margin is None else f"{row.margin:.3f}",
        )
    out.print(shown)


def _table(rows: Sequence[Checked | Judged]) -> Table:
    """A table that begins with the bags' names, whole ones if they are not long."""
    shown = Table(box=SIMPLE_HEAD, show_edge=False, padding=0)
    longest = max(len(row.bag) for row in rows)
    shown.add_column("bag", overflow="fold", no_wrap=longest <= WHOLE, max_width=WHOLE)
    return shown


def _when(moment: str) -> str:
    """A time of ISO 8601 to the minute, as people write it."""
    return moment[:16].replace("T", " ")


def _since(row: Judged) -> str:
    """Why a bag is bad, and from when on."""
    return row.reason if " at t = " in row.reason else f"from {row.bad_at:.3f} s on: {row.reason}"


def _bags(count: int) -> str:
    return f"{count} bag" if count == 1 else f"{count} bags"


def _say_counts(
    count: int, known: int, manifest: Path | None, counts: Sequence[tuple[int, str]]
) -> None:
    """How many there are of each verdict, and how many were known from a run before."""
    said = ", ".join(f"{n} {'copies' if word == 'copy' and n != 1 else word}" for n, word in counts)
    out.print(f"{_bags(count)}: {said}", soft_wrap=True, highlight=False)
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
    out.print(
        f"{_bags(count)}: {count - left_out} used, {len(found.unread)} not read, "
        f"{len(found.unusable)} not usable, {len(found.copies)} copies; "
        f"{sum(answer.kept for answer in found.answers)} of them known from {manifest}",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    for title, bags in (
        ("left out, not read", found.unread),
        ("left out, not usable as configured", found.unusable),
        ("left out, copies", found.copies),
    ):
        _say_bags(title, bags)


def _plain(text: str) -> str:
    """What others wrote, for a terminal: no markup, nothing that is not printed."""
    return escape(
        "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    )


def _say_bags(title: str, said: Mapping[str, str]) -> None:
    """Each of these bags, with what is said of it."""
    if said:
        out.print(f"{title}: {_bags(len(said))}")
    for name, reason in list(said.items())[:LISTED]:
        out.print(f"  {_plain(name)}: {_plain(reason)}", soft_wrap=True, highlight=False)
    if len(said) > LISTED:
        out.print(f"  and {len(said) - LISTED} more")
