"""The command line `nlsid bag`: look into recordings, check, repair, convert and cut them.

A command imports what it runs when it is called.
"""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from bags.commands.progress import progress_bar
from nlsid_core.errors import BagError, DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bags.recordings.definitions import Definition

WIDTH_IN_FILES = 200  # columns where nobody's terminal sets them
PROGRESS_AFTER = 2.0  # s of work before a progress bar appears

bag_app = typer.Typer(
    name="bag",
    help="Look into recordings, check, repair, convert and cut them.",
    no_args_is_help=True,
)
out = Console(width=None if Console().is_terminal else WIDTH_IN_FILES)
err = Console(stderr=True)


class Format(StrEnum):
    """What a table is written as."""

    CSV = "csv"
    NPZ = "npz"
    PARQUET = "parquet"


class Clock(StrEnum):
    """Which of a message's times is its stamp."""

    HEADER = "header"
    LOG = "log"
    PUBLISH = "publish"


class SignalClock(StrEnum):
    """Which times signals are paired by."""

    HEADER = "header"
    LOG = "log"


class Resampling(StrEnum):
    """How a signal is put on a grid."""

    LINEAR = "linear"
    CUBIC = "cubic"
    HOLD = "hold"


BagArgument = Annotated[
    Path, typer.Argument(help="A rosbag2 folder, an .mcap, .db3 or ROS 1 .bag file.")
]
BagsArgument = Annotated[list[Path], typer.Argument(help="Bags, or folders of bags.")]
OutOption = Annotated[Path, typer.Option("--out", help="What to write; must not be there yet.")]
SignalsOption = Annotated[
    list[str],
    typer.Option(
        "--signal",
        "-s",
        help="topic:field.path[index], [*] or [name=elbow]; then |to(deg), |derivative(0.1 s), ...",
    ),
]
DefinitionsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--definitions",
        help="PACKAGE/msg/Type.msg, or folders of packages: types that the bag does not define.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="As JSON, for programs.")]
ClockOption = Annotated[
    SignalClock, typer.Option(help="The signals' stamps: their header's, or of logging.")
]
UnfinishedOption = Annotated[
    bool, typer.Option("--unfinished", help="Read what there is of a recording not closed.")
]


@bag_app.command()
def info(
    bags: BagsArgument, definitions: DefinitionsOption = None, as_json: JsonOption = False
) -> None:
    """Topics, types, counts, rates, jitter, gaps, clock offsets, losses and sizes."""
    from bags.commands import bag_show
    from bags.recordings.folders import expand_bags
    from bags.tools.info import bag_info

    for path in expand_bags(bags):
        with progress_bar("reading", after=PROGRESS_AFTER) as progress:
            found = bag_info(path, definitions=_definitions(definitions), progress=progress)
        if as_json:
            typer.echo(bag_show.info_json(found))
        else:
            bag_show.show_info(out, found)


@bag_app.command()
def signals(
    bag: BagArgument, definitions: DefinitionsOption = None, as_json: JsonOption = False
) -> None:
    """Every number in the bag's messages as a signal: its range, its unit where the type says one.

    Joints are named, orientations have a yaw, transforms their frames.
    """
    from bags.commands import bag_show
    from bags.recordings.bag import Bag
    from bags.tools.listing import bag_signals

    with (
        Bag(bag, unfinished=True, definitions=_definitions(definitions)) as source,
        progress_bar("reading", after=PROGRESS_AFTER) as progress,
    ):
        found = bag_signals(source, progress=progress)
    if as_json:
        typer.echo(bag_show.signals_json(found))
    else:
        out.print(bag_show.signals_table(found))


@bag_app.command()
def plot(
    bag: BagArgument,
    picture: Annotated[Path, typer.Option("--out", help="A .png, .svg or .html file.")],
    signals: SignalsOption,
    clock: Annotated[Clock | None, typer.Option(help="Which times (default: header).")] = None,
    definitions: DefinitionsOption = None,
    unfinished: UnfinishedOption = False,
) -> None:
    """Draw signals over time."""
    from bags.pictures.report import report_available
    from bags.signals.reader import read_signals

    if not report_available():
        raise BagError("drawing needs matplotlib: pip install 'nlsid[report]'")
    from bags.pictures.signal_plots import draw_signals, write_picture

    with progress_bar("reading", after=PROGRESS_AFTER) as progress:
        samples = read_signals(
            bag,
            signals,
            clock=_clock(clock),
            unfinished=unfinished,
            definitions=_definitions(definitions),
            progress=progress,
        )
    write_picture(picture, draw_signals(list(samples.values()), title=str(bag)), title=str(bag))
    out.print(f"wrote {picture}", soft_wrap=True, markup=False)


@bag_app.command()
def check(
    bags: BagsArgument,
    excitations: Annotated[
        list[str], typer.Option("--excitation", "-u", help="Signals that drive the robot.")
    ],
    responses: Annotated[
        list[str], typer.Option("--response", "-y", help="Signals that are measured.")
    ],
    clock: ClockOption = SignalClock.HEADER,
    definitions: DefinitionsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Are these bags fit for identification? Status 1 if one is not."""
    from bags.commands import bag_show
    from bags.recordings.folders import expand_bags
    from bags.tools.fitness import Level, check_fitness

    results = check_fitness(
        expand_bags(bags),
        excitations=excitations,
        responses=responses,
        clock=clock.value,
        definitions=_definitions(definitions),
    )
    if as_json:
        typer.echo(bag_show.fitness_json(results))
    for result in () if as_json else results:
        bag_show.show_fitness(out, result)
    if any(result.verdict is Level.BAD for result in results):
        raise typer.Exit(1)


@bag_app.command("recover")
def recover_command(bag: BagArgument, bag_out: OutOption) -> None:
    """Make a whole bag of an unfinished or damaged one, verify it, and say what was lost.

    Status 1 if something was.
    """
    from bags.tools.recover import recover

    with progress_bar("recovering", after=PROGRESS_AFTER) as progress:
        found = recover(bag, bag_out, progress=progress)
    for topic, count in found.counts.items():
        out.print(f"{count:9d} messages on {topic}", soft_wrap=True, markup=False)
    for what in found.lost:
        out.print(f"lost: {what}", soft_wrap=True, markup=False)
    if found.lost:
        verdict = f"{len(found.lost)} losses, as said above"
    elif found.statements:
        verdict = f"nothing was lost of what {' and '.join(found.statements)} state"
    else:
        verdict = (
            "whether messages are missing is not known: the bag does not state how many it had"
        )
    out.print(
        f"wrote {found.out}, {found.messages} messages, read back and compared; {verdict}",
        soft_wrap=True,
        markup=False,
    )
    if found.lost:
        raise typer.Exit(1)


@bag_app.command("export")
def export_command(
    bag: BagArgument,
    target: OutOption,
    form: Annotated[Format, typer.Option("--format", "-f")] = Format.CSV,
    signals: Annotated[
        list[str] | None, typer.Option("--signal", "-s", help="Which; default: every number.")
    ] = None,
    period: Annotated[
        float | None, typer.Option(help="s: one table on a common grid instead of one a topic.")
    ] = None,
    hold: Annotated[
        list[str] | None, typer.Option(help="Signals that are commands: held, not interpolated.")
    ] = None,
    method: Annotated[
        Resampling, typer.Option(help="Of the other signals, on the grid.")
    ] = Resampling.LINEAR,
    max_gap: Annotated[
        float | None, typer.Option(help="s without a sample; default 1.5 periods.")
    ] = None,
    clock: ClockOption = SignalClock.HEADER,
    definitions: DefinitionsOption = None,
    unfinished: UnfinishedOption = False,
) -> None:
    """Write signals as CSV, npz or Parquet: a table per topic, or one on a common grid."""
    from bags.tools import export

    if period is None:
        with progress_bar("exporting", after=PROGRESS_AFTER) as progress:
            rows = export.export_topics(
                bag,
                target,
                form=form.value,
                signals=signals,
                unfinished=unfinished,
                definitions=_definitions(definitions),
                progress=progress,
            )
        for file, count in rows.counts.items():
            out.print(f"wrote {file}, {count} rows", soft_wrap=True, markup=False)
        for what in rows.left_out:
            out.print(f"left out: {what}", soft_wrap=True, markup=False)
        _say_notes(rows.notes)
        return
    if not signals:
        raise BagError("a common grid needs to know which signals: --signal")
    errors = export.export_grid(
        bag,
        target,
        form=form.value,
        signals=signals,
        period=period,
        method=method.value,
        hold=hold or (),
        max_gap=1.5 * period if max_gap is None else max_gap,
        clock=clock.value,
        unfinished=unfinished,
        definitions=_definitions(definitions),
    )
    for name, error in errors.items():
        out.print(f"{name}: off by at most {error:.2g}", soft_wrap=True, markup=False)
    out.print(f"wrote {target}", soft_wrap=True, markup=False)


@bag_app.command()
def cut(
    bag: BagArgument,
    bag_out: OutOption,
    start: Annotated[float, typer.Option(help="s after the first message.")] = 0.0,
    end: Annotated[float | None, typer.Option(help="s after the first message.")] = None,
    topics: Annotated[list[str] | None, typer.Option("--topic", "-t")] = None,
    definitions: DefinitionsOption = None,
    unfinished: UnfinishedOption = False,
) -> None:
    """Copy a stretch of time, or some topics, to a new bag."""
    from bags.tools import edit

    with progress_bar("copying", after=PROGRESS_AFTER) as progress:
        copied = edit.cut(
            bag,
            bag_out,
            start=start,
            end=end,
            topics=topics or None,
            unfinished=unfinished,
            definitions=_definitions(definitions),
            progress=progress,
        )
    out.print(f"wrote {bag_out}, {copied.messages} messages", soft_wrap=True, markup=False)
    _say_notes(copied.notes)


@bag_app.command()
def merge(bags: BagsArgument, bag_out: OutOption) -> None:
    """Copy several bags into one, by log time."""
    from bags.recordings.folders import expand_bags
    from bags.tools import edit

    with progress_bar("copying", after=PROGRESS_AFTER) as progress:
        copied = edit.merge(expand_bags(bags), bag_out, progress=progress)
    out.print(f"wrote {bag_out}, {copied.messages} messages", soft_wrap=True, markup=False)
    _say_notes(copied.notes)


@bag_app.command()
def split(
    bag: BagArgument,
    bag_out: Annotated[Path, typer.Option("--out", help="OUT_01, OUT_02, ... are written.")],
    repeats: Annotated[
        str | None, typer.Option(help="A signal whose repetitions become the parts.")
    ] = None,
    every: Annotated[
        float | None, typer.Option(help="s per part; a rest shorter than half goes with the last.")
    ] = None,
) -> None:
    """Copy a bag in parts: at the repeats of an excitation, or every so many seconds."""
    from bags.tools import edit

    with progress_bar("copying", after=PROGRESS_AFTER) as progress:
        copied = edit.split(bag, bag_out, repeats=repeats, every=every, progress=progress)
    for part in copied.parts:
        out.print(f"wrote {part}", soft_wrap=True, markup=False)
    _say_notes(copied.notes)


@bag_app.command("import")
def import_command(
    tables: Annotated[list[Path], typer.Argument(help="CSV or MAT files.")],
    bag_out: OutOption,
    assignments: Annotated[
        list[str],
        typer.Option(
            "--signal", "-s", help="signal=column: /joints:position[name=elbow]=angles[3]"
        ),
    ],
    types: Annotated[
        list[str], typer.Option("--type", help="topic=type: /joints=sensor_msgs/msg/JointState")
    ],
    period: Annotated[float | None, typer.Option(help="s between rows.")] = None,
    time_column: Annotated[
        str | None, typer.Option("--time", help="The column with the rows' times in s.")
    ] = None,
    drop_repeats: Annotated[
        bool, typer.Option("--drop-repeats", help="Of rows with one time keep the first.")
    ] = False,
    start: Annotated[float, typer.Option(help="s since 1970 of time 0.")] = 0.0,
    custom: Annotated[
        list[str] | None, typer.Option(help="key=value for the bag's metadata.")
    ] = None,
) -> None:
    """Write columns of tables as a bag of standard messages."""
    from bags.tools.importing import import_tables, said_units

    counts = import_tables(
        tables,
        bag_out,
        assignments,
        types=_pairs(types, "--type"),
        period=period,
        time=time_column,
        drop_repeats=drop_repeats,
        start_ns=round(start * 1e9),
        custom=_pairs(custom or (), "--custom"),
    )
    listed = ", ".join(f"{count} on {topic}" for topic, count in counts.items())
    out.print(f"wrote {bag_out}: {listed}", soft_wrap=True, markup=False)
    if units := said_units(assignments, _pairs(types, "--type")):
        out.print(
            f"units by the message types, not by the table: {units}; where a column is in another, "
            "write it behind the signal, as |unit(V), or as its `unit` in the configuration",
            soft_wrap=True, markup=False,
        )  # fmt: skip


def _say_notes(notes: "Sequence[str]") -> None:
    for note in notes:
        out.print(f"not as stated: {note}", soft_wrap=True, markup=False)


def _definitions(paths: list[Path] | None) -> "dict[str, Definition]":
    from bags.recordings.definitions import read_definitions

    return read_definitions(paths or ())


def _pairs(texts: list[str] | tuple[str, ...], option: str) -> dict[str, str]:
    pairs = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key or not value:
            raise DataError(f"{option} {text}: expected key=value")
        pairs[key] = value
    return pairs


def _clock(clock: Clock | None) -> str | None:
    from bags.signals.reader import CLOCKS

    return None if clock is None else next(name for name in CLOCKS if name.startswith(clock.value))
