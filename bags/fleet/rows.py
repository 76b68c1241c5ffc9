"""A row for each bag of a fleet, whatever is asked of it, and all rows as one table."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from bags.fleet.bags import COPY, UNREAD, Recordings, same_as
from bags.fleet.manifest import Manifest
from bags.fleet.run import Task, ask
from bags.fleet.workers import Workers
from nlsid_core.errors import DataError
from nlsid_core.files import canonical, write_atomically
from nlsid_core.progress import Progress, silent


@dataclass(frozen=True)
class Row:
    """One bag: a verdict, and what is behind it.

    reason: why it is not good, or not inside. start: the bag's
    first log time, ISO 8601 in UTC, empty if unknown. marks: a second copy of the recording has one
    of them too. said: what else is to be known, in words. numbers: those that are known. known: the
    bag was asked of before.
    """

    bag: str
    verdict: str
    reason: str = ""
    start: str = ""
    marks: tuple[str, ...] = ()
    said: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    known: bool = False

    @classmethod
    def read(cls, content: bytes) -> "Row":
        """The row that `content` wrote."""
        found = json.loads(content)
        return cls(**found | {"marks": tuple(found["marks"])})

    def content(self) -> bytes:
        """The row as JSON, as a worker sends it home."""
        return canonical(asdict(self))

    @property
    def cells(self) -> dict[str, object]:
        """Its line of a table, by the names of the columns."""
        named = {name: value for name, value in asdict(self).items() if isinstance(value, str)}
        return {**named, **self.said, **self.numbers}


def read_rows(
    task: Task,
    bags: Mapping[str, Path],
    *,
    workers: Workers,
    manifest: Path | None = None,
    progress: Progress = silent,
) -> tuple[Row, ...]:
    """Ask of each bag; one that cannot be read is `not read`, a second of a recording a `copy`."""
    recordings = Recordings()
    rows: list[Row] = []
    with Manifest(manifest) as kept:
        for answer in ask(task, bags, workers, kept, progress=progress):
            if answer.reason:
                row = Row(answer.name, UNREAD, answer.reason)
            else:
                row = replace(Row.read(answer.content), known=answer.kept)
            first = recordings.first(row.bag, row.marks)
            if first != row.bag:
                row = Row(row.bag, COPY, same_as(first), start=row.start, known=row.known)
            rows.append(row)
    return tuple(rows)


def iso(stamp_ns: int) -> str:
    """A stamp as a date and time in UTC, to the second; empty for 0."""
    if not stamp_ns:
        return ""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).isoformat(timespec="seconds")


def write_parquet(rows: Sequence[Row], out: Path) -> None:
    """Write a table with a line for each row; DataError without pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise DataError("Parquet needs pyarrow: pip install 'nlsid[fleet]'") from error
    lines = [row.cells for row in rows]
    columns = dict.fromkeys(name for line in lines for name in line)
    table = pa.table({name: [line.get(name) for line in lines] for name in columns})
    stream = io.BytesIO()
    parquet.write_table(table, stream)
    write_atomically(out, stream.getvalue())
