"""From recordings to a model: `nlsid init` and `identify`.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from bags.commands.options import (
    CONFIG,
    BagsArgument,
    ConfigOption,
    DefinitionsOption,
    DesignArgument,
    ExcitationOption,
    PatienceOption,
    ResponseOption,
    SchedulerOption,
    SomeBagsArgument,
    StrictOption,
    WorkersOption,
    config_of,
    err,
    out,
)
from bags.commands.progress import progress_bar
from nlsid_core.errors import DataError

if TYPE_CHECKING:
    from bags.chain.config import Config


def init(
    folder: DesignArgument,
    bags: SomeBagsArgument = None,
    response: ResponseOption = None,
    excitation: ExcitationOption = None,
    definitions: DefinitionsOption = None,
    robot: Annotated[str, typer.Option(help="What people call it.")] = "robot",
    yes: Annotated[
        bool, typer.Option("--yes", help="Take the likeliest signals, and what seems wrong too.")
    ] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Look at the running robot's topics instead of bags.")
    ] = False,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, help="To listen with --live; let the robot move.")
    ] = 10.0,
) -> None:
    """Write a first configuration from bags, DIR/robot.yaml: signals, period, split, model, tube.

    It is tried on the bags, every key says why, and what later steps will meet is said first.
    Status 1 if nothing can be identified from these bags.
    """
    import tempfile

    from bags.commands.init import run_init
    from bags.commands.listening import listen
    from bags.setup.proposal import Unfit

    if live is bool(bags):
        raise typer.BadParameter("give bags, or --live for the robot that is running")
    target = folder / CONFIG
    if target.exists():
        raise DataError(f"{target} exists already; give another folder, or remove it")
    with tempfile.TemporaryDirectory() as heard:
        if live:
            out.print(f"listening for {seconds:g} s; let the robot move", soft_wrap=True)
        try:
            run_init(
                out,
                [listen(Path(heard) / "heard", seconds)] if live else bags or [],
                target,
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
    folder: DesignArgument,
    bags: BagsArgument,
    config: ConfigOption = None,
    only_check: Annotated[
        bool,
        typer.Option("--check", help="Only say what is wrong, status 1; no message is read."),
    ] = False,
    select: Annotated[
        bool,
        typer.Option(
            "--select", help="Choose among the configuration's `select` by `split.validation`."
        ),
    ] = False,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare", help="Only score every method of every class in `compare`: a table."
        ),
    ] = False,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    strict: StrictOption = False,
    patience: PatienceOption = 60.0,
) -> None:
    """Identify a model from bags and prove it stable: model.json, model.proof.json, report.html.

    Of a configuration with a motion: a model of the measured state, and a policy for the motion.
    Bags in object storage, or with --workers or --scheduler: each is read by a worker, one that
    cannot be used is listed and left out, and the next run reads only what is new.
    """
    from bags.chain.config import load_config
    from bags.chain.tracking_config import is_tracking
    from bags.commands import fleet_cli, show
    from bags.fleet.workers import Workers
    from bags.recordings.folders import expand_bags
    from bags.recordings.remote import is_url

    path = config_of(folder, config)
    if only_check:
        _check(path, bags)
        return
    if is_tracking(path):
        from bags.commands import track

        track.identify(bags, path, folder)
        track.plan(path, folder)
        return

    settings = load_config(path)
    if workers or scheduler or strict or any(map(is_url, bags)):
        reading = fleet_cli.Reading(Workers(workers, scheduler), strict, patience)
        verb = fleet_cli.select if select else fleet_cli.identify
        verb(out, bags, settings, folder, reading)
        return

    folders = expand_bags(bags)
    if compare:
        _compare(folders, settings, folder)
        return
    with progress_bar("identifying") as progress:
        if select:
            from bags.chain.choosing import select_bags

            show.say_selected(out, select_bags(folders, settings, folder, progress=progress))
        else:
            from bags.chain.steps import identify_bags

            show.say_identified(out, identify_bags(folders, settings, folder, progress=progress))


def _check(path: Path, bags: list[Path]) -> None:
    """Say all that is wrong with a configuration, and with it for these bags."""
    from bags.chain.config import load_config
    from bags.chain.fitting import misfits
    from bags.chain.tracking_config import is_tracking, load_tracking_config
    from bags.recordings.folders import expand_bags

    folders = expand_bags(bags)
    try:
        if is_tracking(path):
            load_tracking_config(path)
            wrong = []
        else:
            wrong = misfits(load_config(path), folders)
    except DataError as error:
        wrong = [str(error)]
    for line in wrong:
        typer.echo(line)
    if wrong:
        raise typer.Exit(1)
    typer.echo(f"{path}: nothing is wrong with it for {len(folders)} bags; no message was read")


def _compare(folders: list[Path], settings: Config, folder: Path) -> None:
    """Score every method on the same test bags: simulation, prediction, residuals, proof."""
    from bags.chain.choosing import compare_bags
    from bags.commands import show
    from bags.designs import documents
    from bags.pictures.report import report_available

    with progress_bar("comparing") as progress:
        compared = compare_bags(folders, settings, progress=progress)
    out.print(show.comparison_table(compared))
    for refusal in compared.refusals:
        out.print(f"no model: {escape(refusal)}", soft_wrap=True)
    if report_available():
        folder.mkdir(parents=True, exist_ok=True)
        compared.draw(folder / documents.COMPARISON_PLOT)
        out.print(f"wrote {folder / documents.COMPARISON_PLOT}", soft_wrap=True)
