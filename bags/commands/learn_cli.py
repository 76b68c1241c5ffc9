"""`nlsid learn`: everything from bags to a checked design and its report, in one command.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bags.commands import designs_cli, models_cli
from bags.commands.options import (
    CONFIG,
    BagsArgument,
    DefinitionsOption,
    Signals,
    VerboseOption,
    out,
)
from nlsid_core import deciding
from nlsid_core.errors import DataError


def learn(
    bags: BagsArgument,
    signals: Signals,
    folder: Annotated[Path, typer.Option("--out", help="The design's folder.")] = Path("design"),
    definitions: DefinitionsOption = None,
    _verbose: VerboseOption = False,
) -> None:
    """Make a checked design from bags: init, identify, funnel, check and report, asking nothing.

    The configuration that it uses is written too: robot.yaml. Where a person has to decide, it
    ends with the reason and status 2. Status 1: nothing can be identified from these bags.
    """
    from bags.chain.config import load_config
    from bags.recordings.folders import expand_bags

    proposal = models_cli.proposed(folder, bags, signals, definitions, robot="robot", yes=True)
    if proposal.doubts:
        raise DataError(
            f"{proposal.doubts[0]}. Name the signals with -y and -u; or, if they are right, go on "
            f"with nlsid identify {folder}"
        )
    settings = load_config(folder / CONFIG)
    models_cli.identify_here(expand_bags(bags), settings, folder)
    designs_cli.tube(folder, settings)
    status = designs_cli.decided([folder], deciding.USUAL)
    designs_cli.report(folder)
    out.print(f"next: nlsid monitor {folder} BAG...; nlsid run monitor {folder}", soft_wrap=True)
    raise typer.Exit(status)
