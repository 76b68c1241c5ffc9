"""The command line `nlsid fleet`, and what `nlsid identify` does with many bags.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from nlsid_core.progress import part

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bags.chain.config import Config
    from bags.fleet.monitor import FleetVerdict
    from bags.fleet.trials import FleetTrials
    from bags.fleet.workers import Workers
    from nlsid_core.progress import Progress

LISTED = 20  # bags that are left out, by name
ROWS = 30  # of a table on the screen

fleet_app = typer.Typer(
    name="fleet",
    help="Many bags at once, on this machine or in object storage: are they fit, are they inside.",
    no_args_is_help=True,
)
console = Console()

BagsArgument = Annotated[
    list[Path], typer.Argument(help="Bags, folders of bags, URLs and patterns (quote them).")
]
ManifestOption = Annotated[
    Path | None,
    typer.Option(help="A file that keeps what is read: the next run reads only what is new."),
]
WorkersOption = Annotated[
    int,
    typer.Option("--workers", min=0, help="Processes that share the work; 0: this one."),
]
SchedulerOption = Annotated[
    str, typer.Option("--scheduler", help="Of a Dask cluster instead: tcp://HOST:PORT.")
]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="End at the first bag that cannot be used.")
]
PatienceOption = Annotated[
    float,
    typer.Option(
        min=1.0, help="Seconds that a bag may lose with failing requests before it is left out."
    ),
]


@fleet_app.command()
def check(
    bags: BagsArgument,
    config: Annotated[Path, typer.Option(help="The robot's YAML configuration: its signals.")],
    table: Annotated[
        Path | None, typer.Option("--out", help="A .parquet file for all rows and findings.")
    ] = None,
    manifest: ManifestOption = None,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    patience: PatienceOption = 60.0,
) -> None:
    """Fitness, clock trouble and losses of every bag as one table.

    Status 1 if a bag is bad, 2 if one cannot be read.
    """
    from bags.chain.config import load_config
    from bags.commands.progress import progress_bar
    from bags.fleet.bags import named_bags
    from bags.fleet.check import UNREAD, check_fleet, write_parquet
    from bags.fleet.workers import Workers

    settings = load_config(config)
    named = named_bags(bags, patience=patience)
    with progress_bar("checking") as progress:
        rows = check_fleet(
            named, settings,
            workers=Workers(workers, scheduler), manifest=manifest, progress=progress,
        )  # fmt: skip
    if table is not None:
        write_parquet(rows, table)
    shown = Table(title=f"{len(rows)} bags", title_justify="left")
    for column in ("bag", "verdict", "start (UTC)", "lost", "what to look at"):
        shown.add_column(column, overflow="fold")
    serious = {UNREAD: 0, "bad": 1, "look": 2, "good": 3}
    for row in sorted(rows, key=lambda row: serious[row.verdict])[:ROWS]:
        lost = "-" if row.lost is None else str(row.lost)
        shown.add_row(_plain(row.bag), row.verdict, row.start[:19], lost, _plain(row.trouble))
    console.print(shown)
    if len(rows) > ROWS:
        console.print(f"and {len(rows) - ROWS} more, none more serious; --out writes all of them")
    counts = Counter(row.verdict for row in rows)
    console.print(", ".join(f"{counts[verdict]} {verdict}" for verdict in serious))
    if table is not None:
        console.print(f"wrote {table}", soft_wrap=True)
    if counts["bad"] or counts[UNREAD]:
        raise typer.Exit(1 if counts["bad"] else 2)


@fleet_app.command()
def monitor(
    bags: BagsArgument,
    funnel: Annotated[Path, typer.Option(help="The funnel.json that `nlsid funnel` wrote.")],
    config: Annotated[
        Path | None, typer.Option(help="Takes `monitor.nominal` and `definitions`.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option("--out", help="A .parquet file with a row for every bag.")
    ] = None,
    manifest: ManifestOption = None,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    patience: PatienceOption = 60.0,
) -> None:
    """Hold every bag against one proved design: which robots, which days, which assumption.

    How much of what is assumed each bag spends, the worst ten, what that says of the next bag, and
    whether the newest month is like the calibration. Status 0 if all are inside with the assumption
    kept, 1 if one is not, 2 if one was not judged whole.
    """
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.commands.progress import progress_bar
    from bags.designs import documents
    from bags.fleet.bags import named_bags
    from bags.fleet.check import write_parquet
    from bags.fleet.monitor import COPY, monitor_fleet
    from bags.fleet.workers import Workers
    from bags.recordings.definitions import read_definitions
    from nlsid_core.running.reading import Status

    settings = load_config(config) if config is not None else None
    proved = documents.load_proved(funnel)
    named = named_bags(bags, patience=patience)
    with progress_bar("judging") as progress:
        found = monitor_fleet(
            named, funnel, proved,
            centre=show.centre_of(settings),
            definitions=read_definitions(settings.definitions if settings else ()),
            workers=Workers(workers, scheduler), manifest=manifest, progress=progress,
        )  # fmt: skip
    if table is not None:
        write_parquet(found.rows, table)
    _say_verdicts(found)
    if found.worst:
        worst = named[found.worst[0].bag]
        centre = f" --config {config}" if config else ""
        console.print(
            f"look at the first: nlsid view {worst} --page --funnel {funnel}{centre}",
            soft_wrap=True, markup=False, highlight=False,
        )  # fmt: skip
    if table is not None:
        console.print(f"wrote {table}", soft_wrap=True)
    verdicts = {row.verdict for row in found.rows} - {COPY}
    if verdicts & {Status.OUTSIDE.value, Status.ASSUMPTION_VIOLATED.value} or any(
        row.alarm for row in found.rows
    ):
        raise typer.Exit(1)
    if verdicts != {Status.INSIDE.value}:
        raise typer.Exit(2)


def _say_verdicts(found: FleetVerdict) -> None:
    from bags.fleet.monitor import COPY, UNREAD

    counts = Counter(row.verdict for row in found.rows)
    console.print(
        f"{len(found.rows)} bags: " + ", ".join(f"{n} {what}" for what, n in counts.most_common())
    )
    for key, title in (("robot", "robots"), ("day", "days")):
        console.print(f"{title}, those with the most trouble first:")
        table = Table()
        for column in (key, "bags", *counts):
            table.add_column(column, overflow="fold")
        groups = found.by(key)
        for name, own in list(groups.items())[:ROWS]:
            table.add_row(
                _plain(name) or "-", str(own.total()), *(str(own[what]) for what in counts)
            )
        console.print(table)
    for what, count in Counter(r.assumption for r in found.rows if r.assumption).most_common():
        console.print(f"broken in {count} bags: {what}", soft_wrap=True, markup=False)
    if any(found.histogram):
        console.print("of what is assumed, spent by so many bags:")
    most = max(found.histogram)
    for k, count in enumerate(found.histogram):
        label = f"{10 * k:3d} to {10 * k + 10:3d} %" if k < 10 else "   over 100 %"
        if most:
            console.print(f"{label:>14} {count:6d} {'#' * round(40 * count / most)}")
    console.print("the ten that spent the most, and when:")
    table = Table()
    for column in ("bag", "spent", "at", "time (UTC)", "verdict", "bad from", "margin"):
        table.add_column(column, overflow="fold")
    for row in found.worst:
        table.add_row(
            _plain(row.bag), f"{100 * (row.spent or 0.0):.1f} %", f"{row.spent_at:.3f} s",
            row.spent_when[:19], row.verdict, row.bad_from[:19] or "-",
            "-" if row.margin is None else f"{row.margin:.3f}",
        )  # fmt: skip
    console.print(table)
    for line in found.ranks:
        console.print(line, soft_wrap=True, highlight=False)
    if found.ranks and found.unrecognised:
        console.print(
            "none of these is known to be a bag that the design was made with. Those count above "
            "if they are here, read from elsewhere than for the design", soft_wrap=True,
        )  # fmt: skip
    drift = found.drift
    said = str(drift) if drift else "drift is not judged: no calibration trials beside the funnel, "
    console.print(said + ("" if drift else "or too few bags of the newest month"), soft_wrap=True)
    say_left_out(
        console, {row.bag: row.reason for row in found.rows if row.verdict in (UNREAD, COPY)}
    )


def identify(
    out: Console, bags: Sequence[Path], config: Config, out_dir: Path, reading: Reading
) -> None:
    """Read by workers, identify at home, say what was left out and why."""
    from bags.chain.steps import identify_trials
    from bags.commands import show
    from bags.commands.progress import progress_bar

    with progress_bar("identifying") as progress:
        found = _read(bags, config, out_dir, reading, part(progress, 0.0, 0.5))
        identified = identify_trials(found.trials, config, out_dir, progress=progress)
    show.say_identified(out, identified)
    _say_read(out, found)


def select(
    out: Console,
    bags: Sequence[Path],
    config: Config,
    out_dir: Path,
    reading: Reading,
    options: Mapping[str, Sequence[object]] | None,
) -> None:
    """Read by workers, which then try the combinations; say what was left out and why."""
    from bags.chain.choosing import sections_to_try, select_trials
    from bags.commands import show
    from bags.commands.progress import progress_bar

    sections_to_try(config, options)
    with progress_bar("selecting") as progress:
        found = _read(bags, config, out_dir, reading, part(progress, 0.0, 0.3))
        with reading.workers.sharing() as executor:
            result = select_trials(
                found.trials, config, out_dir,
                options=options, executor=executor, progress=progress,
            )  # fmt: skip
    show.say_selected(out, result)
    _say_read(out, found)


@dataclass(frozen=True)
class Reading:
    """Who reads the bags, and how patiently."""

    workers: Workers
    strict: bool
    patience: float


def _read(
    bags: Sequence[Path], config: Config, out_dir: Path, reading: Reading, progress: Progress
) -> FleetTrials:
    from bags.fleet.bags import named_bags
    from bags.fleet.trials import read_fleet

    return read_fleet(
        named_bags(bags, patience=reading.patience), config, out_dir,
        workers=reading.workers, strict=reading.strict, progress=progress,
    )  # fmt: skip


def _say_read(out: Console, found: FleetTrials) -> None:
    count, kept = len(found.answers), sum(answer.kept for answer in found.answers)
    read = sum(not answer.kept and not answer.reason for answer in found.answers)
    out.print(f"{count} bags: {read} read, {kept} known from before", soft_wrap=True)
    say_left_out(out, found.left_out)


def _plain(text: str) -> str:
    """What others wrote, for a terminal: no markup, nothing that is not printed."""
    return escape(
        "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    )


def say_left_out(out: Console, left_out: dict[str, str]) -> None:
    """Each bag that is left out, with the reason."""
    if left_out:
        out.print(f"left out: {len(left_out)} bags")
    for name, reason in list(left_out.items())[:LISTED]:
        out.print(f"  {_plain(name)}: {_plain(reason)}", soft_wrap=True, highlight=False)
    if len(left_out) > LISTED:
        out.print(f"  and {len(left_out) - LISTED} more")
