"""`nlsid init`: a first configuration from bags, asked for on a terminal or said by options."""

import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import typer
from rich.console import Console

from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.folders import expand_bags
from bags.setup.candidates import Candidate, Found, look
from bags.setup.proposal import Proposal
from bags.setup.proposing import Chosen, choose, propose
from bags.setup.written import yaml_text
from bags.signals.reader import expanded
from nlsid_core.errors import BagError, DataError
from nlsid_core.files import write_atomically

SHOWN = 9  # candidates in a question
NAMED = 3  # bags that a command names one by one
MANY = "BAGS"


def run_init(
    console: Console, bags: Sequence[Path], target: Path, given: Chosen, *, yes: bool
) -> Proposal:
    """Look, ask what is not said, try it on the bags, write the YAML; DataError if `target` exists.

    Without a terminal what is not said has to be accepted by `yes`.
    """
    if target.exists():
        raise DataError(f"{target} exists already; give another folder, or remove it")
    folders = expand_bags(bags)
    types = read_definitions(given.definitions)
    console.print(f"looking into {len(folders)} bag{'s' * (len(folders) != 1)}", soft_wrap=True)
    found = look(folders, definitions=types)
    with Bag(folders[0], definitions=types) as bag:
        responses, excitations = (
            _expanded(bag, texts) for texts in (given.responses, given.excitations)
        )
    asked = not yes and not (responses and excitations)
    if asked and not sys.stdin.isatty():
        raise DataError(
            "nobody is at a terminal to choose signals: name them with --response and "
            "--excitation, or take the likeliest ones with --yes"
        )
    chosen_u, chosen_y = excitations, responses
    if asked and not chosen_u:
        chosen_u = _ask(console, "What drives the robot?", found.commands(), found, ())
    if asked and not chosen_y:
        chosen_y = _ask(console, "What answers?", found.responses(chosen_u), found, chosen_u)
    chosen_y, chosen_u = choose(found, chosen_y, chosen_u)
    chosen = replace(
        given,
        responses=tuple(chosen_y),
        excitations=tuple(chosen_u),
        named=(*responses, *excitations),
    )
    proposal = propose(
        folders,
        found,
        chosen,
        widen=not excitations and not asked,
        alone=not (responses or asked),
    )
    if not yes:
        _settle(console, proposal)
    if given.definitions:  # a configuration's paths are seen from where it is
        proposal.content["definitions"] = [
            os.path.relpath(path, target.parent) for path in given.definitions
        ]
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, yaml_text(proposal).encode())
    _say(console, proposal, target, bags)
    return proposal


def _expanded(bag: Bag, texts: Sequence[str]) -> list[str]:
    """The signals, one for each element where `[*]` means several."""
    expand = [expanded(bag, [text]) if "[*]" in text else [text] for text in texts]
    return [element for elements in expand for element in elements]


def _say(console: Console, proposal: Proposal, target: Path, bags: Sequence[Path]) -> None:
    """What was chosen and why, what to mind, and which commands come next."""
    roles = ("excitation", "response")
    taken = [signal["path"] for role in roles for signal in proposal.content["signals"][role]]
    for text in taken:
        console.print(f"{text}: {proposal.why[text]}", soft_wrap=True, markup=False)
    for wall in dict.fromkeys([*proposal.doubts, *proposal.walls]):
        console.print(f"mind: {wall}", soft_wrap=True, markup=False, style="dark_orange3")
    console.print(proposal.expectation, soft_wrap=True, markup=False)
    console.print(f"wrote {target}; next:", soft_wrap=True, markup=False)
    given, folder = said_briefly(bags), shlex.quote(str(target.parent))
    if given == MANY:
        console.print(f"  {MANY} stands for the {len(bags)} bags that you gave to init")
    for step in (
        f"nlsid identify {folder} {given}",
        f"nlsid funnel {folder}",
        f"nlsid check {folder}",
        f"nlsid monitor {folder} {given}",
    ):
        console.print(f"  {step}", soft_wrap=True, markup=False, highlight=False)


def _settle(console: Console, proposal: Proposal) -> None:
    """Ask what seems wrong; DataError unless somebody says that it is right."""
    for doubt in dict.fromkeys(proposal.doubts):
        if not sys.stdin.isatty():
            raise DataError(f"{doubt} Give --yes to take it as it is")
        console.print(doubt, soft_wrap=True, markup=False, style="dark_orange3")
        if not typer.confirm("take it as it is?", default=False):
            raise DataError("nothing was written: give what is right")


def said_briefly(bags: Sequence[Path]) -> str:
    """The bags in a command: by name if they are few, else their folder, else MANY."""
    if len(bags) <= NAMED:
        return " ".join(shlex.quote(str(bag)) for bag in bags)
    folder = bags[0].parent
    with suppress(BagError):
        if set(expand_bags([folder])) == set(expand_bags(bags)):
            return shlex.quote(str(folder))
    return MANY


def _ask(
    console: Console,
    question: str,
    candidates: Sequence[Candidate],
    found: Found,
    commands: Sequence[str],
) -> list[str]:
    """Numbers of a list, or a signal's own text; the first one if nothing is typed."""
    if not candidates:
        raise DataError("no number looks like one; name it with --response or --excitation")
    shown = candidates[:SHOWN]
    console.print(question, style="bold")
    for number, candidate in enumerate(shown, start=1):
        pairs = [
            p
            for p in found.pairs
            if (p.response if commands else p.command).text == candidate.text
            and (not commands or p.command.text in commands)
        ]
        told = f"; {pairs[0]}" + ("" if commands else f" by {pairs[0].response.text}")
        console.print(f"  {number}  {candidate}{told}", soft_wrap=True, markup=False)
    while True:
        answer = typer.prompt("numbers, or a signal", default="1").strip()
        parts = [part.strip() for part in answer.split(",") if part.strip()]
        if parts and all(part.isdigit() and 1 <= int(part) <= len(shown) for part in parts):
            return [shown[int(part) - 1].text for part in parts]
        if ":" in answer:
            return [answer]
        console.print(f"1 to {len(shown)}, several with commas, or topic:field")
