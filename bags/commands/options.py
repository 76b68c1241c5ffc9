"""Arguments, options, consoles and the progress bar that the verbs of `nlsid` share.

Options that belong together are a dataclass; `flat` gives a verb that takes one its fields as
options of the command line.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from rich.console import Console

from nlsid_core.errors import DataError, DocumentError
from nlsid_core.progress import Progress, silent

if TYPE_CHECKING:
    from bags.chain.config import Config
    from bags.fleet.workers import Workers
    from nlsid_core.designs import Wiring

CONFIG = "robot.yaml"  # of a design's folder

out = Console()
err = Console(stderr=True)
PATIENCE = 1.0  # s, before a progress bar is shown
details = Console(quiet=True)  # the numbers behind a sentence; --verbose shows them


class Clock(StrEnum):
    """Which of a message's times is its stamp."""

    HEADER = "header"
    LOG = "log"


def _folder(path: Path) -> Path:
    """Refuse a file in the place of a folder."""
    if path.is_file():
        known = any((path.parent / name).is_file() for name in (CONFIG, "model.json"))
        raise DocumentError(
            f"{path} is a file: give the design's folder"
            f"{f', {path.parent}' if known else ' that `nlsid learn` or `nlsid identify` wrote'}"
        )
    return path


DesignArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DIR",
        callback=_folder,
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
ClockOption = Annotated[
    Clock, typer.Option("--clock", help="Which stamps count: those of headers, or of logging.")
]
DefinitionsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--definitions",
        help="PACKAGE/msg/Type.msg, .idl, .srv, .action, or folders of packages: types that the "
        "bags do not define.",
    ),
]


def _show_details(wanted: bool) -> None:
    details.quiet = not wanted


VerboseOption = Annotated[
    bool,
    typer.Option(
        "--verbose", callback=_show_details, help="Print the numbers behind each sentence too."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


@dataclass(frozen=True)
class Signals:
    """Which numbers are measured, and which drive the robot."""

    response: Annotated[
        list[str] | None,
        typer.Option("--response", "-y", help="topic:field of what is measured; repeat."),
    ] = None
    excitation: Annotated[
        list[str] | None,
        typer.Option("--excitation", "-u", help="topic:field of what drives the robot; repeat."),
    ] = None


@dataclass(frozen=True)
class Wired(Signals):
    """Where state and inputs of given equations are."""

    period: Annotated[
        float,
        typer.Option("--period", min=0.0, help="s between samples, for given equations."),
    ] = 0.0

    def wiring(self) -> Wiring | None:
        """The same as a design takes it; None if nothing was given."""
        from bags.designs.wiring import wiring_of

        return wiring_of(self.response, self.excitation, self.period)


@dataclass(frozen=True)
class Sharing:
    """Who shares the work."""

    count: Annotated[
        int,
        typer.Option("--workers", min=0, help="Processes that share the work; 0: only this one."),
    ] = 0
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="Use a Dask cluster instead: tcp://HOST:PORT.")
    ] = ""

    def workers(self) -> Workers:
        """The same as the fleet takes it."""
        from bags.fleet.workers import Workers

        return Workers(self.count, self.scheduler)


PatienceOption = Annotated[
    float,
    typer.Option(
        "--patience",
        min=1.0,
        help="Seconds for which a failing request is repeated before its bag is left out.",
    ),
]


def flat(verb: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a verb: each field of a dataclass that it takes is an option of its own."""
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    parameters: list[Parameter] = []
    for given in signature(verb).parameters.values():
        kind = groups.get(given.name)
        types = hints if kind is None else get_type_hints(kind, include_extras=True)
        inside = [given] if kind is None else signature(kind).parameters.values()
        for each in inside:
            kind_of = types[each.name]
            for said in getattr(kind_of, "__metadata__", ()):
                if isinstance(said, str):  # the help of an option that has nothing else
                    kind_of = Annotated[kind_of.__origin__, typer.Option(help=said)]
            parameters.append(each.replace(annotation=kind_of, kind=Parameter.KEYWORD_ONLY))

    @wraps(verb)
    def command(**values: Any) -> None:
        for name, kind in groups.items():
            own = {field.name: values.pop(field.name) for field in fields(kind)}
            values[name] = kind(**own)
        verb(**values)

    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    return command


def config_of(folder: Path, given: Path | None) -> Path:
    """The configuration that was given, else the folder's; DataError if there is none."""
    path = given or folder / CONFIG
    if given is None and not path.is_file():
        raise DataError(
            f"there is no {path}: `nlsid init DIR BAG...` writes one, or give --config. A design's "
            "folder stands before the bags"
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


@contextmanager
def progress_bar(task: str) -> Iterator[Progress]:
    """Yield `progress(what, fraction)`; the bar disappears when the work is done.

    It is shown only to a terminal, and only of work that takes longer than PATIENCE.
    """
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    started = time.monotonic()
    columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    bar = Bar(*columns, console=Console(stderr=True), transient=True)
    identifier = bar.add_task(task, total=1.0)

    def show(what: str, fraction: float) -> None:
        if time.monotonic() - started >= PATIENCE:
            bar.start()
            bar.update(identifier, description=what, completed=fraction)

    try:
        yield show
    finally:
        bar.stop()
