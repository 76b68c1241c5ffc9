"""Fitness, clocks and losses of every bag of a fleet, as one table."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from bags.chain.config import Config
from bags.chain.steps import read_signals_of
from bags.fleet.bags import COPY, UNREAD, Recordings, robots_of, same_as
from bags.fleet.manifest import Manifest
from bags.fleet.run import ask, is_of_content, without_name
from bags.fleet.trials import samples_digest
from bags.fleet.workers import Workers
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions, texts_of
from bags.signals.reader import bag_origin
from bags.tools.fitness import Finding, Level, check_fitness
from bags.tools.info import LOST
from nlsid_core.errors import DataError
from nlsid_core.files import canonical, write_atomically
from nlsid_core.progress import Progress, silent

BAD, LOOK, GOOD = (level.name.lower() for level in (Level.BAD, Level.LOOK, Level.GOOD))
SERIOUS: Final = (UNREAD, BAD, COPY, LOOK, GOOD)  # the most serious first


@dataclass(frozen=True)
class Checked:
    """One bag: a verdict of SERIOUS, and what is behind it.

    bad: `nlsid identify` leaves it out, or it is not fit. start: of the recording, ISO 8601 in UTC,
    empty if unknown. lost: messages that its recorder counted as lost, None if it counted none of
    the topics. clock, gaps: what is wrong there, empty if nothing. trouble: why it is not good;
    findings: all of them. excited: whether a command moves. digest,
    samples: of the recording and of what is identified from; copies are known by either.
    """

    bag: str
    robot: str
    verdict: str
    start: str = ""
    lost: int | None = None
    clock: str = ""
    gaps: str = ""
    trouble: str = ""
    findings: tuple[str, ...] = ()
    excited: bool = False
    digest: str = ""
    samples: str = ""


@dataclass(frozen=True, eq=False)
class FleetCheck:
    """Every bag's row, in order; known: how many were in the manifest before."""

    rows: tuple[Checked, ...]
    known: int

    @property
    def still(self) -> bool:
        """Whether there are bags to identify from, and no command moves in any of them."""
        usable = [row for row in self.rows if row.verdict in (LOOK, GOOD)]
        return bool(usable) and not any(row.excited for row in usable)


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
        """A Checked, as JSON. Raises BagError for a bag that no command can read."""
        definitions = read_definitions(self.config.definitions)
        with Bag(bag, definitions=definitions) as source:
            start_ns, custom, digest = (
                source.start_ns,
                source.custom,
                bag_origin(source)["digest"],
            )
        refused, samples, excited = "", "", False
        try:
            own = read_signals_of({name: bag}, self.config).trajectories
        except DataError as error:
            if not is_of_content(error):
                raise
            refused = f"`nlsid identify` leaves it out: {without_name(str(error), bag, name)}"
        else:
            samples = "".join(samples_digest(own))
            excited = any((trial.u != trial.u[0]).any() for trial in own)
        findings = list(self._findings(bag, name, definitions, taken=not refused))
        counts = [text for key, text in custom.items() if key.endswith(LOST)]
        lost = sum(int(text) for text in counts if text.isdigit()) if counts else None
        if lost:
            findings.append(Finding(Level.LOOK, "losses", f"its recorder lost {lost} messages"))
        if refused:
            findings.insert(0, Finding(Level.BAD, "identify", refused))
        wrong = sorted((f for f in findings if f.level is not Level.GOOD), key=lambda f: -f.level)
        checked = Checked(
            bag=name,
            robot="-",  # told from the others at home
            verdict=wrong[0].level.name.lower() if wrong else GOOD,
            start=iso(start_ns),
            lost=lost,
            clock=next((f.what for f in wrong if f.check == "clock"), ""),
            gaps=next((f.what for f in findings if " the longest " in f.what), ""),
            trouble=wrong[0].what if wrong else "",
            findings=tuple(f"{f.level.name.lower()}: {f.check}: {f.what}" for f in findings),
            excited=excited,
            digest=digest,
            samples=samples,
        )
        return canonical(asdict(checked))

    def _findings(self, bag: Path, name: str, definitions: Any, *, taken: bool) -> list[Finding]:
        """What `nlsid bag check` finds, of one bag among others.

        taken: `nlsid identify` takes its samples, with the configured grid.
        """
        (fitness,) = check_fitness(
            [bag],
            excitations=[signal.path for signal in self.config.signals.excitation],
            responses=[signal.path for signal in self.config.signals.response],
            clock=self.config.clock,
            definitions=definitions,
        )
        return [
            replace(
                found,
                level=Level.GOOD if _is_of_others(found) or (taken and decided) else found.level,
                what=without_name(found.what, bag, name),
            )
            for found in fitness.findings
            for decided in [found.check in ("regularity", "samples")]
            if not (taken and found.check == "samples" and found.level is not Level.GOOD)
        ]


def _is_of_others(found: Finding) -> bool:
    """Whether it is about a command that moves too little here: others may have it move."""
    return found.check == "excitation" or (found.check, found.level) == ("delay", Level.LOOK)


def check_fleet(
    bags: Mapping[str, Path],
    config: Config,
    *,
    workers: Workers,
    manifest: Path | None = None,
    progress: Progress = silent,
) -> FleetCheck:
    """A row a bag, in the order of `bags`; one that cannot be read is `not read`."""
    robots, recordings = robots_of(bags), Recordings()
    rows: list[Checked] = []
    known = 0
    with Manifest(manifest) as kept:
        for answer in ask(CheckBag(config), bags, workers, kept, progress=progress):
            known += answer.kept
            if answer.reason:
                row = Checked(answer.name, "", UNREAD, trouble=answer.reason)
            else:
                row = Checked(**_document(answer.content))
                marks = [mark for mark in (row.digest, row.samples) if mark]
                if (first := recordings.first(row.bag, marks)) != row.bag:
                    row = replace(row, verdict=COPY, trouble=same_as(first))
            rows.append(replace(row, robot=robots[row.bag]))
    return FleetCheck(tuple(rows), known)


def _document(content: bytes) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(content)
    return found | {"findings": tuple(found["findings"])}


def iso(stamp_ns: int) -> str:
    """A stamp as a date and time in UTC, to the second; empty for 0."""
    if not stamp_ns:
        return ""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).isoformat(timespec="seconds")


def write_parquet(rows: Sequence[Any], out: Path) -> None:
    """A table with a row for each of these dataclasses, a column for each field.

    Raises DataError without pyarrow.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise DataError("Parquet needs pyarrow: pip install 'nlsid[fleet]'") from error
    stream = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist([asdict(row) for row in rows]), stream)
    write_atomically(out, stream.getvalue())
