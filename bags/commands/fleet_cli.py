"""The command line `nlsid fleet`, and what `nlsid identify` does with many bags.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bags.chain.config import Config

LISTED = 20  # bags that are left out, by name; all are in fleet.json

fleet_app = typer.Typer(
    name="fleet",
    help="Many bags at once, on this machine or in object storage: are they fit, are they inside.",
    no_args_is_help=True,
)
console = Console()

WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Processes that read; 0: this one.")
]
SchedulerOption = Annotated[
    str, typer.Option("--scheduler", help="Of a Dask cluster that reads: tcp://HOST:PORT.")
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


def identify(
    out: Console,
    bags: Sequence[Path],
    config: Config,
    out_dir: Path,
    *,
    workers: int,
    scheduler: str,
    strict: bool,
    patience: float,
) -> None:
    """Read by workers, identify at home, say what was left out and why."""
    from bags.commands import show
    from bags.commands.progress import progress_bar
    from bags.fleet.bags import named_bags
    from bags.fleet.trials import identify_fleet
    from bags.fleet.workers import Workers

    named = named_bags(bags, patience=patience)
    with progress_bar("identifying") as progress:
        found = identify_fleet(
            named, config, out_dir,
            workers=Workers(workers, scheduler), strict=strict, progress=progress,
        )  # fmt: skip
    show.say_identified(out, found.identified)
    kept = sum(answer.kept for answer in found.answers)
    read = len(named) - kept - len(found.left_out)
    out.print(f"{len(named)} bags: {read} read, {kept} known from before", soft_wrap=True)
    say_left_out(out, found.left_out)


def say_left_out(out: Console, left_out: dict[str, str]) -> None:
    """Each bag that is left out, with the reason."""
    if left_out:
        out.print(f"left out: {len(left_out)} bags")
    for name, reason in list(left_out.items())[:LISTED]:
        out.print(f"  {name}: {reason}", soft_wrap=True, markup=False, highlight=False)
    if len(left_out) > LISTED:
        out.print(f"  and {len(left_out) - LISTED} more")
