"""Arguments, options and consoles that the verbs of `nlsid` share: each is written here once."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from nlsid_core.errors import DataError

if TYPE_CHECKING:
    from bags.chain.config import Config
    from bags.designs.design import Wiring

CONFIG = "robot.yaml"  # of a design's folder

out = Console()
err = Console(stderr=True)


class Clock(StrEnum):
    """Which of a message's times is its stamp."""

    HEADER = "header"
    LOG = "log"


DesignArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DIR",
        help="The design's folder: robot.yaml, model.json, funnel.json, their proofs.",
    ),
]
BagsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="BAG...", help="Bags, folders of bags, URLs (s3://...) and patterns, in quotes."
    ),
]
SomeBagsArgument = Annotated[
    list[Path] | None, typer.Argument(metavar="[BAG]...", help="Bags, or folders of bags.")
]
BagArgument = Annotated[
    Path, typer.Argument(metavar="BAG", help="A rosbag2 folder, .mcap, .db3 or ROS 1 .bag file.")
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="The robot's YAML; default robot.yaml in DIR.")
]
ResponseOption = Annotated[
    list[str] | None,
    typer.Option("--response", "-y", help="topic:field of what is measured; repeat."),
]
ExcitationOption = Annotated[
    list[str] | None,
    typer.Option("--excitation", "-u", help="topic:field of what drives the robot; repeat."),
]
PeriodOption = Annotated[float, typer.Option("--period", min=0.0, help="s between samples.")]
ClockOption = Annotated[
    Clock, typer.Option("--clock", help="The signals' stamps: their header's, or of logging.")
]
DefinitionsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--definitions",
        help="PACKAGE/msg/Type.msg, or folders of packages: types that the bags do not define.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="As JSON, for programs.")]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Processes that share the work; 0: this one.")
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
        "--patience",
        min=1.0,
        help="Seconds that a bag may lose with failing requests before it is left out.",
    ),
]


def config_of(folder: Path, given: Path | None) -> Path:
    """The configuration that was given, else the folder's; DataError if there is none."""
    path = given or folder / CONFIG
    if given is None and not path.is_file():
        raise DataError(
            f"there is no {path}: `nlsid init {folder} BAG...` writes one, or give --config"
        )
    return path


def settings_if_any(folder: Path, given: Path | None) -> Config | None:
    """The configuration that was given, else the folder's, None if it has none or one of a motion.

    Raises DataError if it is wrong.
    """
    from bags.chain.config import load_config
    from bags.chain.tracking_config import is_tracking

    path = given or folder / CONFIG
    if (given is None and not path.is_file()) or is_tracking(path):
        return None
    return load_config(path)


def wiring_of(
    responses: list[str] | None, excitations: list[str] | None, period: float
) -> Wiring | None:
    """Where the state and the input of a continuous funnel are; None if nothing was given."""
    from bags.designs.design import Wiring

    return Wiring.parse_if_any(responses or [], excitations or [], period)
