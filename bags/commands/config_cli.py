"""The command line `nlsid config`: what is wrong with a configuration, before any work."""

from pathlib import Path
from typing import Annotated

import typer

config_app = typer.Typer(
    name="config", help="Look into a robot's YAML configuration.", no_args_is_help=True
)


@config_app.callback()
def config() -> None:
    """Look into a robot's YAML configuration."""


@config_app.command("check")
def check(
    file: Annotated[Path, typer.Argument(help="The robot's YAML configuration.")],
    bags: Annotated[
        list[Path] | None, typer.Argument(help="Bags that it should fit, or folders of them.")
    ] = None,
    tracking: Annotated[bool, typer.Option("--track", help="It is one of `nlsid track`.")] = False,
) -> None:
    """Say all that is wrong with a configuration, and with it for these bags; status 1 if anything.

    Keys, types, units and ranges, and what a later step could not use. No message is read.
    """
    from bags.chain.config import load_config
    from bags.chain.fitting import misfits
    from bags.chain.tracking_config import load_tracking_config
    from bags.recordings.folders import expand_bags
    from nlsid_core.errors import DataError

    try:
        folders: list[Path] = []
        wrong: list[str] = []
        if tracking:
            load_tracking_config(file)
        else:
            settings = load_config(file)
            folders = expand_bags(bags or [])
            wrong = misfits(settings, folders) if folders else []
    except DataError as error:
        typer.echo(str(error))
        raise typer.Exit(1) from error
    for line in wrong:
        typer.echo(line)
    if wrong:
        raise typer.Exit(1)
    fit = f", {len(folders)} bags have its signals; their messages were not read" if folders else ""
    typer.echo(f"{file}: nothing is wrong{fit}")
