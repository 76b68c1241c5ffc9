"""From recordings to a model: `nlsid init` and `identify`.

A command imports what it runs when it is called.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bags.commands.options import (
    CONFIG,
    BagsArgument,
    ConfigOption,
    DefinitionsOption,
    DesignArgument,
    PatienceOption,
    Sharing,
    Signals,
    VerboseOption,
    config_of,
    err,
    out,
    progress_bar,
)
from nlsid_core.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bags.chain.config import Config
    from bags.chain.steps import Identified, Trials
    from bags.setup.proposal import Proposal


def init(
    folder: DesignArgument,
    bags: BagsArgument,
    signals: Signals,
    definitions: DefinitionsOption = None,
    robot: Annotated[str, typer.Option(help="The robot's name.")] = "robot",
) -> None:
    """Write a first configuration from bags, DIR/robot.yaml: signals, period, split, model, tube.

    It is tried on the bags, and every key says why it is as it is. What later steps will meet is
    said first. Of signals that you do not name the likeliest are taken. Status 1: nothing can be
    identified from these bags. Status 2: it is written, and a person has to look at it.
    """
    from bags.commands.init import say_next

    proposed(folder, bags, signals, definitions, robot=robot)
    say_next(out, folder, bags)


def proposed(
    folder: Path,
    bags: list[Path],
    signals: Signals,
    definitions: list[Path] | None,
    *,
    robot: str,
) -> Proposal:
    """Write the first configuration; Exit with status 1 if nothing can be identified.

    Raises DataError, when it is written, if a person has to decide whether it is right.
    """
    from bags.commands.init import run_init
    from bags.setup.candidates import Unfit
    from bags.setup.proposing import Chosen

    chosen = Chosen(
        tuple(signals.response or ()),
        tuple(signals.excitation or ()),
        robot,
        tuple(definitions or ()),
    )
    try:
        proposal = run_init(out, bags, folder / CONFIG, chosen)
    except Unfit as reason:
        err.print(f"nothing was written: {reason}", soft_wrap=True, markup=False)
        raise typer.Exit(1) from reason
    if proposal.doubts:
        raise DataError(
            f"{proposal.doubts[0]}. Name the signals with -y and -u; or, if they are right, go on "
            f"with nlsid identify {folder}"
        )
    return proposal


@dataclass(frozen=True)
class Reading(Sharing):
    """Who reads the bags, and how patiently."""

    patience: PatienceOption = 60.0


def identify(
    folder: DesignArgument,
    bags: BagsArgument,
    reading: Reading,
    config: ConfigOption = None,
    _verbose: VerboseOption = False,
) -> None:
    """Identify a model from bags and prove it stable: model.json, model.proof.json, report.html.

    If the configuration has a motion, the model is of the measured state, and there is a policy
    for the motion. Workers read the bags if these are in object storage, or with --workers or
    --scheduler. A bag that cannot be used is then listed and left out. The next run reads only
    what is new.
    """
    from bags.chain.config import load_config
    from bags.chain.tracking_config import is_tracking, load_tracking_config
    from bags.recordings.folders import expand_bags
    from bags.recordings.remote import is_url

    path = config_of(folder, config)
    if is_tracking(path):
        from bags.commands import states

        states.identify(expand_bags(bags), load_tracking_config(path), folder)
    else:
        settings = load_config(path)
        if reading.count or reading.scheduler or any(map(is_url, bags)):
            _by_workers(bags, settings, folder, reading)
        else:
            identify_here(expand_bags(bags), settings, folder)


def identify_here(bags: Sequence[Path], settings: Config, folder: Path) -> Identified:
    """Read and identify in this process, and say what was found."""
    from bags.chain.steps import read_trials

    with progress_bar("reading") as progress:
        trials = read_trials(bags, settings, progress=progress)
    return _identify(trials, settings, folder)


def _by_workers(bags: list[Path], settings: Config, folder: Path, reading: Reading) -> None:
    """Read by workers, identify at home, say what was left out and why."""
    from bags.commands.fleet_cli import say_read
    from bags.fleet.bags import named_bags
    from bags.fleet.trials import MANIFEST, read_fleet

    workers = reading.workers()
    with progress_bar("reading") as progress:
        named = named_bags(bags, patience=reading.patience)
        found = read_fleet(named, settings, folder, workers=workers, progress=progress)
    say_read(found, folder / MANIFEST)  # before anything is made of it, which may fail
    _identify(found.trials, settings, folder)


def _identify(trials: Trials, settings: Config, folder: Path) -> Identified:
    """Identify as configured, and say what was found."""
    from bags.chain.steps import identify_trials
    from bags.commands import show

    with progress_bar("identifying") as progress:
        result = identify_trials(trials, settings, folder, progress=progress)
    show.say_identified(out, result)
    return result
