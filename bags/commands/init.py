"""`nlsid init`: a first configuration from bags, with what a person should mind."""

import os
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bags.commands.options import progress_bar
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.folders import expand_bags
from bags.setup.candidates import choose, look
from bags.setup.proposal import Proposal
from bags.setup.proposing import Chosen, beside, propose
from bags.setup.written import yaml_text
from bags.signals.reader import expanded
from nlsid_core.errors import BagError, DataError, counted, percent
from nlsid_core.files import write_atomically
from nlsid_core.identification import Choice

NAMED = 3  # bags that a command names one by one
MANY = "BAGS"


def run_init(console: Console, bags: Sequence[Path], target: Path, given: Chosen) -> Proposal:
    """Look, try it on the bags, write the YAML; DataError if `target` exists.

    Of signals that nobody named the likeliest are taken.
    """
    if target.exists():
        raise DataError(f"{target} exists already; give another folder, or remove it")
    folders = expand_bags(bags)
    types = read_definitions(given.definitions)
    console.print(f"looking into {counted(len(folders), 'bag')}", soft_wrap=True)
    found = look(folders, definitions=types)
    with Bag(folders[0], definitions=types) as bag:
        responses, excitations = (
            _expanded(bag, texts) for texts in (given.responses, given.excitations)
        )
    chosen_y, chosen_u = choose(found, responses, excitations)
    chosen = replace(
        given,
        responses=tuple(chosen_y),
        excitations=tuple(chosen_u),
        named=(*responses, *excitations),
    )
    with progress_bar("trying models") as progress:
        proposal = propose(folders, found, chosen, widen=not excitations, progress=progress)
    proposal.walls += beside(proposal, found) if not responses else []
    if given.definitions:  # a configuration's paths are seen from where it is
        proposal.content["definitions"] = [
            os.path.relpath(path, target.parent) for path in given.definitions
        ]
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, yaml_text(proposal).encode())
    _say(console, proposal, target)
    return proposal


def _expanded(bag: Bag, texts: Sequence[str]) -> list[str]:
    """The signals, one for each element where `[*]` means several."""
    expand = [expanded(bag, [text]) if "[*]" in text else [text] for text in texts]
    return [element for elements in expand for element in elements]


def _say(console: Console, proposal: Proposal, target: Path) -> None:
    """What was chosen and why, and what to mind."""
    signals = proposal.content["signals"]
    for signal in (*signals["excitation"], *signals["response"]):
        text = signal["path"]
        console.print(f"{text}: {proposal.why[text]}", soft_wrap=True, markup=False)
    if proposal.choice is not None:
        console.print(tried_table(proposal.choice))
    for wall in dict.fromkeys([*proposal.doubts, *proposal.walls]):
        console.print(f"mind: {wall}", soft_wrap=True, markup=False, style="dark_orange3")
    console.print(proposal.expectation, soft_wrap=True, markup=False)
    console.print(f"wrote {target}", soft_wrap=True, markup=False)


def say_next(console: Console, target: Path, bags: Sequence[Path]) -> None:
    """Which commands come next."""
    console.print("next:")
    given, folder = said_briefly(bags), shlex.quote(str(target))
    if given == MANY:
        console.print(f"  {MANY} stands for the {len(bags)} bags that you gave to init")
    for step in (
        f"nlsid identify {folder} {given}",
        f"nlsid funnel {folder}",
        f"nlsid check {folder}",
        f"nlsid monitor {folder} {given}",
    ):
        console.print(f"  {step}", soft_wrap=True, markup=False, highlight=False)


def tried_table(choice: Choice) -> Table:
    """What was tried, the best first, and what it is held against."""
    table = Table(
        title=f"tried on {choice.held_out.on} that were held out",
        caption="error: of the simulation, in % of the response's spread, with what the data leave "
        "open",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("model: method (steps)")
    table.add_column("error", justify="right")
    judged = choice.ranked
    for row in judged:
        table.add_row(
            escape(str(row.attempt)),
            percent(row.percent),
            style="bold" if row is choice.best else "",
        )
    for row in (row for row in choice.rows if row not in judged):
        table.add_row(escape(str(row.attempt)), escape(row.refusal), style="dim")
    return table


def said_briefly(bags: Sequence[Path]) -> str:
    """The bags in a command: by name if they are few, else their folder, else MANY."""
    if len(bags) <= NAMED:
        return " ".join(shlex.quote(str(bag)) for bag in bags)
    folder = bags[0].parent
    with suppress(BagError):
        if set(expand_bags([folder])) == set(expand_bags(bags)):
            return shlex.quote(str(folder))
    return MANY
