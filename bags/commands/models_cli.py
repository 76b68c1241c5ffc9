"""From recordings to a model: `nlsid init`, `identify`, `select` and `compare`.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from bags.commands.fleet_cli import (
    PatienceOption,
    SchedulerOption,
    StrictOption,
    WorkersOption,
)
from bags.commands.options import BagsArgument, ConfigOption, OutOption, err, out
from bags.commands.progress import progress_bar
from nlsid_core.errors import DataError

LagsOption = Annotated[list[int] | None, typer.Option(help="Numbers of lags to try, repeatable.")]


def init(
    out_file: Annotated[
        Path, typer.Option("--out", help="The YAML to write; must not be there yet.")
    ],
    bags: Annotated[
        list[Path] | None, typer.Argument(help="Bags, or folders of bags; none with --live.")
    ] = None,
    response: Annotated[
        list[str] | None, typer.Option("--response", "-y", help="What answers; repeat.")
    ] = None,
    excitation: Annotated[
        list[str] | None, typer.Option("--excitation", "-u", help="What drives it; repeat.")
    ] = None,
    definitions: Annotated[
        list[Path] | None, typer.Option(help=".msg files that the bags do not define.")
    ] = None,
    robot: Annotated[str, typer.Option(help="What people call it.")] = "robot",
    yes: Annotated[bool, typer.Option("--yes", help="Take the likeliest signals.")] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Look at the running robot's topics instead of bags.")
    ] = False,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, help="To listen with --live; let the robot move.")
    ] = 10.0,
) -> None:
    """Write a first configuration from bags: signals, clock, period, gaps, split, lags, tube.

    It is tried on the bags, every key says why, and what later steps will meet is said first.
    """
    import tempfile

    from bags.commands.init import run_init
    from bags.commands.listening import listen
    from bags.setup.proposal import Unfit

    if live is bool(bags):
        raise typer.BadParameter("give bags, or --live for the robot that is running")
    if out_file.exists():
        raise DataError(f"{out_file} exists already; give another name, or remove it")
    with tempfile.TemporaryDirectory() as folder:
        if live:
            out.print(f"listening for {seconds:g} s; let the robot move", soft_wrap=True)
        try:
            run_init(
                out,
                [listen(Path(folder) / "heard", seconds)] if live else bags or [],
                out_file,
                responses=response or (),
                excitations=excitation or (),
                definitions=definitions or (),
                robot=robot,
                yes=yes,
                live=live,
            )
        except Unfit as reason:
            err.print(f"nothing was written: {reason}", soft_wrap=True, markup=False)
            raise typer.Exit(1) from reason


def identify(
    bags: BagsArgument,
    config: ConfigOption,
    out_dir: OutOption,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    strict: StrictOption = False,
    patience: PatienceOption = 60.0,
) -> None:
    """Identify a model from bags and prove it stable: model.json, model.proof.json, report.html.

    Bags in object storage, or with --workers or --scheduler: each is read by a worker, one that
    cannot be used is listed and left out, and the next run reads only what is new.
    """
    from bags.chain.config import load_config
    from bags.chain.steps import identify_bags
    from bags.commands import fleet_cli, show
    from bags.fleet.workers import Workers
    from bags.recordings.folders import expand_bags
    from bags.recordings.remote import is_url

    settings = load_config(config)
    if workers or scheduler or strict or any(map(is_url, bags)):
        reading = fleet_cli.Reading(Workers(workers, scheduler), strict, patience)
        fleet_cli.identify(out, bags, settings, out_dir, reading)
        return
    folders = expand_bags(bags)
    with progress_bar("identifying") as progress:
        result = identify_bags(folders, settings, out_dir, progress=progress)
    show.say_identified(out, result)


def select(
    bags: BagsArgument,
    config: ConfigOption,
    out_dir: OutOption,
    lags: LagsOption = None,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    strict: StrictOption = False,
    patience: PatienceOption = 60.0,
) -> None:
    """Choose orders and bases by the error on validation bags, and write the best model.

    What is tried: the configuration's `select`, or --lags. Workers read the bags as for `identify`,
    and then try what is to be tried beside each other.
    """
    from bags.chain.choosing import select_bags
    from bags.chain.config import load_config
    from bags.commands import fleet_cli, show
    from bags.fleet.workers import Workers
    from bags.recordings.folders import expand_bags
    from bags.recordings.remote import is_url

    settings = load_config(config)
    options = {"lags": lags} if lags else None
    if workers or scheduler or strict or any(map(is_url, bags)):
        reading = fleet_cli.Reading(Workers(workers, scheduler), strict, patience)
        fleet_cli.select(out, bags, settings, out_dir, reading, options)
        return
    folders = expand_bags(bags)
    with progress_bar("selecting") as progress:
        result = select_bags(folders, settings, out_dir, options=options, progress=progress)
    show.say_selected(out, result)


def compare(
    bags: BagsArgument,
    config: ConfigOption,
    lags: LagsOption = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for a picture of the test errors.")
    ] = None,
) -> None:
    """Score every method on the same test bags: simulation, prediction, residual tests, proof.

    What is compared: the configuration's `compare`, a list of model classes, or else the one it
    identifies, with --lags at each number of lags.
    """
    from bags.chain.choosing import compare_bags
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.designs import documents
    from bags.pictures.report import report_available
    from bags.recordings.folders import expand_bags

    settings = load_config(config)
    folders = expand_bags(bags)
    with progress_bar("comparing") as progress:
        compared = compare_bags(folders, settings, lags=lags or (), progress=progress)
    out.print(show.comparison_table(compared))
    for refusal in compared.refusals:
        out.print(f"no model: {escape(refusal)}", soft_wrap=True)
    if out_dir is not None and report_available():
        out_dir.mkdir(parents=True, exist_ok=True)
        compared.draw(out_dir / documents.COMPARISON_PLOT)
        out.print(f"wrote {out_dir / documents.COMPARISON_PLOT}", soft_wrap=True)
