"""Fitness, clocks and losses of every bag of a fleet, as one table."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bags.chain.config import Config
from bags.fleet.bags import robot_of
from bags.fleet.manifest import Manifest
from bags.fleet.run import ask
from bags.fleet.workers import Workers
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions, texts_of
from bags.tools.fitness import Finding, Level, check_fitness
from bags.tools.info import LOST
from nlsid_core.errors import BagError, DataError
from nlsid_core.files import canonical, write_atomically
from nlsid_core.progress import Progress, silent

UNREAD = "not read"


@dataclass(frozen=True)
class Checked:
    """One bag: verdict `good`, `look`, `bad` or `not read`, and what is behind it.

    start: of the recording, ISO 8601 in UTC, empty if unknown. lost: messages that its recorder
    counted as lost, None if it counted none of the topics. clock, gaps: what is wrong there, empty
    if nothing. trouble: the most serious finding; findings: all of them.
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


@dataclass(frozen=True)
class CheckBag:
    """Is this bag fit to identify the configured robot from, with others?

    A command that one bag holds throughout is no reason against it: other bags have other commands.
    """

    config: Config

    @cached_property
    def asked(self) -> str:
        """The signals, their clock and the types' definitions."""
        types = texts_of(read_definitions(self.config.definitions))
        said = self.config.model_dump_json(include={"signals", "clock"})
        return f"check {version('nlsid')} {said} {types}"

    def __call__(self, bag: Path, name: str) -> bytes:
        """A Checked, as JSON."""
        definitions = read_definitions(self.config.definitions)
        (fitness,) = check_fitness(
            [bag],
            excitations=[signal.path for signal in self.config.signals.excitation],
            responses=[signal.path for signal in self.config.signals.response],
            clock=self.config.clock,
            definitions=definitions,
        )
        fitness = replace(fitness, findings=tuple(map(_of_one_bag, fitness.findings)))
        start_ns, custom = 0, {}
        try:
            with Bag(bag, unfinished=True, definitions=definitions) as source:
                start_ns, custom = source.start_ns, source.custom
        except BagError:
            assert fitness.verdict is Level.BAD
        counts = [text for key, text in custom.items() if key.endswith(LOST)]
        wrong = sorted(
            (f for f in fitness.findings if f.level is not Level.GOOD), key=lambda f: -f.level
        )
        checked = Checked(
            bag=name,
            robot=robot_of(name),
            verdict=fitness.verdict.name.lower(),
            start=iso(start_ns),
            lost=sum(int(text) for text in counts if text.isdigit()) if counts else None,
            clock=next((f.what for f in wrong if f.check == "clock"), ""),
            gaps=next((f.what for f in wrong if " gaps, " in f.what), ""),
            trouble=wrong[0].what if wrong else "",
            findings=tuple(
                f"{f.level.name.lower()}: {f.check}: {f.what}" for f in fitness.findings
            ),
        )
        return canonical(asdict(checked))


def _of_one_bag(finding: Finding) -> Finding:
    """The finding, of one bag among others."""
    if finding.check != "excitation" or finding.level is not Level.BAD:
        return finding
    return Finding(Level.LOOK, finding.check, f"{finding.what} in this bag alone")


def check_fleet(
    bags: Mapping[str, Path],
    config: Config,
    *,
    workers: Workers,
    manifest: Path | None = None,
    progress: Progress = silent,
) -> list[Checked]:
    """A row a bag, in the order of `bags`; one that cannot be reached is `not read`."""
    with Manifest(manifest) as kept:
        return [
            Checked(answer.name, robot_of(answer.name), UNREAD, trouble=answer.reason)
            if answer.reason
            else Checked(**_document(answer.content))
            for answer in ask(CheckBag(config), bags, workers, kept, progress=progress)
        ]


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
