"""Options and consoles that the verbs of `nlsid` share."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

out = Console()
err = Console(stderr=True)

BagsArgument = Annotated[
    list[Path],
    typer.Argument(help="Bags: rosbag2 folders, .mcap files, folders of bags, URLs (s3://...)."),
]
ConfigOption = Annotated[Path, typer.Option(help="The robot's YAML configuration.")]
ResponseOption = Annotated[
    list[str] | None, typer.Option(help="topic:field of a continuous funnel's state; repeat.")
]
CommandOption = Annotated[
    list[str] | None, typer.Option(help="topic:field of a continuous funnel's input; repeat.")
]
PeriodOption = Annotated[float, typer.Option(help="Seconds between a continuous funnel's samples.")]
OutOption = Annotated[
    Path, typer.Option("--out", help="Folder for the results; made if it is not there.")
]
