"""Fitness, clocks and losses of every bag of a fleet, as one table."""

from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Final

from bags.chain.config import Config
from bags.chain.steps import read_signals_of
from bags.fleet.bags import COPY, UNREAD
from bags.fleet.rows import Row, iso
from bags.fleet.run import without_name
from bags.fleet.trials import samples_digest
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions, texts_of
from bags.signals.reader import SamplesError, bag_origin
from bags.tools.fitness import Finding, Level, check_fitness
from bags.tools.info import LOST
from nlsid_core.errors import BagError, DataError

BAD, LOOK, GOOD = (level.name.lower() for level in (Level.BAD, Level.LOOK, Level.GOOD))
SERIOUS: Final = (UNREAD, BAD, COPY, LOOK, GOOD)  # the most serious first


@dataclass(frozen=True)
class CheckBag:
    """Is this bag fit to identify the configured robot from, with others?

    A command that one bag holds throughout is no reason against it: other bags have other commands.
    """

    config: Config

    @cached_property
    def asked(self) -> str:
        """The signals, grid, clock and the types' definitions."""
        types = texts_of(read_definitions(self.config.definitions))
        said = self.config.model_dump_json(include={"signals", "grid", "clock"})
        return f"check {version('nlsid')} {said} {types}"

    def __call__(self, bag: Path, name: str) -> bytes:
        """A Row, as JSON. Raises BagError for a bag that no command can read.

        Its verdict is one of SERIOUS. bad: `nlsid identify` leaves it out, or it is not fit. Of its
        numbers `lost` counts the messages that its recorder lost, and `moves` is 1 where a command
        does.
        """
        definitions = read_definitions(self.config.definitions)
        with Bag(bag, definitions=definitions) as source:
            start, custom = iso(source.start_ns), source.custom
            marks = [bag_origin(source)["digest"]]
        refused, numbers = "", {}
        try:
            own = read_signals_of({name: bag}, self.config).trajectories
        except DataError as error:
            if isinstance(error, BagError) and not isinstance(error, SamplesError):
                raise  # it was not read: nothing can be said of what it holds
            refused = f"`nlsid identify` leaves it out: {without_name(str(error), bag, name)}"
        else:
            marks += samples_digest(own)
            numbers["moves"] = float(any((trial.u != trial.u[0]).any() for trial in own))
        (fitness,) = check_fitness(
            [bag],
            excitations=[signal.path for signal in self.config.signals.excitation],
            responses=[signal.path for signal in self.config.signals.response],
            clock=self.config.clock,
            definitions=definitions,
        )
        # Where `nlsid identify` takes the samples, the configured grid has settled what is said of
        # stamps, and what the grid of `nlsid bag check` would leave out is no finding.
        settled = () if refused else ("regularity", "samples")
        findings = [
            replace(
                found,
                level=Level.GOOD if found.check in settled or _is_of_others(found) else found.level,
                what=without_name(found.what, bag, name),
            )
            for found in fitness.findings
            if refused or found.check != "samples" or found.level is Level.GOOD
        ]
        counts = [text for key, text in custom.items() if key.endswith(LOST)]
        if counts:
            numbers["lost"] = float(sum(int(text) for text in counts if text.isdigit()))
        if lost := numbers.get("lost"):
            findings.append(Finding(Level.LOOK, "losses", f"its recorder lost {lost:.0f} messages"))
        if refused:
            findings.insert(0, Finding(Level.BAD, "identify", refused))
        wrong = sorted((f for f in findings if f.level is not Level.GOOD), key=lambda f: -f.level)
        row = Row(
            name,
            verdict=wrong[0].level.name.lower() if wrong else GOOD,
            reason=wrong[0].what if wrong else "",
            start=start,
            marks=tuple(marks),
            said={
                "findings": "\n".join(
                    f"{f.level.name.lower()}: {f.check}: {f.what}" for f in findings
                )
            },
            numbers=numbers,
        )
        return row.content()


def _is_of_others(found: Finding) -> bool:
    """Whether it is about a command that moves too little here: others may have it move."""
    return found.check == "excitation" or (found.check, found.level) == ("delay", Level.LOOK)
