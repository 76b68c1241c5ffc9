"""The command line `nlsid bag`: look into recordings, check, repair and convert them.

A command imports what it runs when it is called.
"""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from bags.commands.options import (
    BagArgument,
    BagsArgument,
    Clock,
    ClockOption,
    DefinitionsOption,
    JsonOption,
    Signals,
    flat,
    progress_bar,
)
from bags.tools.copies import Into, Rows, What
from nlsid_core.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bags.recordings.bag import Bag
    from bags.recordings.definitions import Definition

WIDTH_IN_FILES = 200  # columns where nobody's terminal sets them

bag_app = typer.Typer(
    name="bag",
    help="Look into recordings, check, repair and convert them.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)
out = Console(
    width=None if Console().is_terminal else WIDTH_IN_FILES,
    markup=False,
    emoji=False,
    highlight=False,
)


OutOption = Annotated[Path | None, typer.Option("--out", help="What to write; must not be there.")]
SignalsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--signal",
        "-s",
        help=r"topic:field.path\[0], [*] or \[name=elbow]; then |to(deg), |derivative(0.1 s), ...",
    ),
]


@bag_app.command()
def info(
    bags: BagsArgument,
    messages: Annotated[
        bool,
        typer.Option("--messages", help="Read every message too: clocks, stamps, losses, sizes."),
    ] = False,
    definitions: DefinitionsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show when and how a bag was recorded, and of each topic type, count, rate, jitter and gaps.

    They are read from the bag's indexes.
    """
    from bags.commands import bag_show
    from bags.recordings.folders import expand_bags
    from bags.tools.info import bag_info

    for path in expand_bags(bags):
        with progress_bar("reading") as progress:
            found = bag_info(
                path,
                messages=messages,
                definitions=_definitions(definitions),
                progress=progress,
            )
        if as_json:
            typer.echo(bag_show.info_json(found))
        else:
            bag_show.show_info(out, found)


@bag_app.command()
def signals(
    bag: BagArgument, definitions: DefinitionsOption = None, as_json: JsonOption = False
) -> None:
    """List every number in the bag's messages as a signal, with its range and its unit.

    Joints are named, orientations have a yaw, transforms their frames.
    """
    from bags.commands import bag_show
    from bags.tools.listing import bag_signals

    with (
        _opened(bag, definitions) as source,
        progress_bar("reading") as progress,
    ):
        found = bag_signals(source, progress=progress)
    if as_json:
        typer.echo(bag_show.as_json([asdict(listed) for listed in found]))
    else:
        out.print(bag_show.signals_table(found))


@bag_app.command()
def plot(
    bag: BagArgument,
    signals: SignalsOption = None,
    definitions: DefinitionsOption = None,
    picture: Annotated[Path, typer.Option("--out", help="A .png or .svg file.")] = Path(
        "signals.png"
    ),
) -> None:
    """Draw signals over time; without -s a response and the command that it follows best."""
    from bags.pictures.signal_plots import draw_signals, write_picture
    from bags.signals.reader import read_signals

    drawn = signals or [signal for part in _likeliest([bag], definitions) for signal in part]
    with (
        _opened(bag, definitions) as opened,
        progress_bar("reading") as progress,
    ):
        samples = read_signals(opened, drawn, progress=progress)
    if opened.ending is not None:
        out.print(f"unfinished: {opened.ending}", soft_wrap=True)
    write_picture(picture, draw_signals(list(samples.values()), title=str(bag)))
    out.print(f"wrote {picture}", soft_wrap=True)


@bag_app.command()
@flat
def check(
    bags: BagsArgument,
    signals: Signals,
    clock: ClockOption = Clock.HEADER,
    definitions: DefinitionsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say whether bags are fit for identification; status 1 if one is not.

    Without -y or -u of the likeliest response, or command, which are said.
    """
    from bags.commands import bag_show
    from bags.recordings.folders import expand_bags
    from bags.tools.fitness import Level, check_fitness

    folders = expand_bags(bags)
    y, u = _likeliest(folders, definitions, signals.response or (), signals.excitation or ())
    if not (signals.response and signals.excitation) and not as_json:
        out.print(f"of {', '.join(y)} under {', '.join(u)}", soft_wrap=True)
    results = check_fitness(
        folders,
        excitations=u,
        responses=y,
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
def recover_command(bag: BagArgument, bag_out: OutOption = None) -> None:
    """Make a whole bag of an unfinished or damaged one, BAG_recovered, and say what was lost.

    It is verified. Status 1 if something was lost.
    """
    from bags.tools.recover import recover

    with progress_bar("recovering") as progress:
        found = recover(bag, bag_out or _beside(bag, "recovered"), progress=progress)
    for topic, count in found.counts.items():
        out.print(f"{count:9d} messages on {topic}", soft_wrap=True)
    for what in found.lost:
        out.print(f"lost: {what}", soft_wrap=True)
    if found.lost:
        verdict = "what was lost is said above"
    elif found.statements:
        verdict = f"nothing was lost of what is stated in {' and '.join(found.statements)}"
    else:
        verdict = (
            "whether messages are missing is not known: the bag does not state how many it had"
        )
    out.print(
        f"wrote {found.out}, {found.messages} messages, read back and compared; {verdict}",
        soft_wrap=True,
    )
    if found.lost:
        raise typer.Exit(1)


@bag_app.command("export")
def export_command(
    bag: BagArgument,
    target: OutOption = None,
    form: Annotated[str, typer.Option("--format", "-f", help="csv or parquet.")] = "csv",
    signals: Annotated[
        list[str] | None,
        typer.Option("--signal", "-s", help="Signals, or topics; default: every field of all."),
    ] = None,
    definitions: DefinitionsOption = None,
) -> None:
    """Write topics as CSV or Parquet, a table of each in the folder BAG_tables.

    Fields keep their types; an array is a list, and `-s '/joints:position[*]'` a column for each
    element.
    """
    from bags.tools.tables import export_topics

    target = target or _beside(bag, "tables")
    with (
        _opened(bag, definitions) as opened,
        progress_bar("exporting") as progress,
    ):
        rows = export_topics(opened, target, form=form, signals=signals or (), progress=progress)
    for file, count in rows.counts.items():
        out.print(f"wrote {file}, {count} rows", soft_wrap=True)
    for what in rows.left_out:
        out.print(f"left out: {what}", soft_wrap=True)
    _say_notes(rows.notes)


@bag_app.command("convert")
@flat
def convert_command(
    bags: BagsArgument,
    what: What,
    into: Into,
    definitions: DefinitionsOption = None,
    bag_out: OutOption = None,
) -> None:
    """Copy bags into a new bag, or parts: a stretch of time, some topics, several bags as one.

    Several are merged by log time. The default of --out is BAG_converted.
    """
    from contextlib import ExitStack

    from bags.recordings.folders import expand_bags
    from bags.tools.convert import convert

    folders = expand_bags(bags)
    target = bag_out or _beside(folders[0], "converted")
    with ExitStack() as stack:
        opened = [stack.enter_context(_opened(folder, definitions)) for folder in folders]
        progress = stack.enter_context(progress_bar("copying"))
        copied = convert(opened, target, what, into, progress=progress)
    for part in copied.parts:
        out.print(f"wrote {part}", soft_wrap=True)
    out.print(f"{copied.messages} messages", soft_wrap=True)
    _say_notes(copied.notes)


@bag_app.command("import")
@flat
def import_command(
    table: Annotated[Path, typer.Argument(help="A CSV file.")],
    rows: Rows,
    bag_out: OutOption = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--signal",
            "-s",
            help=r"signal=column: /joints:position\[name=elbow]=angle; repeat. "
            "Default: a topic of every column.",
        ),
    ] = None,
    types: Annotated[
        list[str] | None,
        typer.Option(
            "--type", help="topic=type: /joints=sensor_msgs/msg/JointState. /topic:data: a Float64."
        ),
    ] = None,
    custom: Annotated[
        list[str] | None, typer.Option(help="key=value for the bag's metadata.")
    ] = None,
) -> None:
    """Write columns of a table as a bag of standard messages, named as the table."""
    from bags.tools.importing import import_table

    bag_out = bag_out or Path(table.stem)
    imported = import_table(
        table,
        bag_out,
        assignments or (),
        types=_pairs(types or (), "--type"),
        rows=rows,
        custom=_pairs(custom or (), "--custom"),
    )
    listed = ", ".join(f"{count} on {topic}" for topic, count in imported.counts.items())
    out.print(f"wrote {bag_out}: {listed}", soft_wrap=True)
    out.print(imported.times, soft_wrap=True)


def _say_notes(notes: "Sequence[str]") -> None:
    for note in notes:
        out.print(f"note: {note}", soft_wrap=True)


def _beside(bag: Path, what: str) -> Path:
    """A name for what is made of a bag, in this folder."""
    return Path(f"{bag.stem if bag.suffix else bag.name}_{what}")


def _likeliest(
    bags: "Sequence[Path]",
    definitions: list[Path] | None,
    responses: "Sequence[str]" = (),
    excitations: "Sequence[str]" = (),
) -> tuple[list[str], list[str]]:
    """The responses and the excitations, for those not named the likeliest."""
    if responses and excitations:
        return list(responses), list(excitations)
    from bags.setup.candidates import choose, look

    return choose(look(bags, definitions=_definitions(definitions)), responses, excitations)


def _opened(bag: Path, definitions: list[Path] | None) -> "Bag":
    """The recording; if it was not closed, the messages that are whole."""
    from bags.recordings.bag import Bag

    return Bag(bag, unfinished=True, definitions=_definitions(definitions))


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
