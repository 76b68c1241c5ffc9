"""Signals of a bag as tables: CSV or Parquet (extra `export`: pyarrow).

A table per topic is written part by part and needs the memory of one chunk.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch
from bags.recordings.cdr import Numbers
from bags.recordings.message_types import fields_of
from bags.recordings.storage import NEVER
from bags.signals.columns import Columns, TopicReader, expand_paths, joined_columns
from bags.signals.expressions import Expression, Running
from bags.signals.reader import expanded
from bags.signals.signal import NO_FIELD, SignalPath, numeric_paths
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

FORMATS: Final = ("csv", "parquet")
MAX_COLUMNS: Final = 256  # of one array, when everything is exported; images are not tables
TIMES: Final = ("log_time_ns", "publish_time_ns", "stamp_ns")
Table = Mapping[str, Any]


@dataclass(frozen=True)
class Exported:
    """Rows of each file written; left_out: what of everything is not there, and why.

    notes: where what the bag states and what is there differ.
    """

    counts: Mapping[Path, int]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def export_topics(
    bag: Bag,
    out: Path | str,
    *,
    form: str,
    signals: Sequence[str] = (),
    progress: Progress = silent,
) -> Exported:
    """Write a table per topic in the new folder `out`: times in ns, signals after operations.

    Rows are in the order of log time; a number has the type that it has in the message. A
    derivative is NaN until its window is full.

    Args:
        bag: an open bag.
        out: the new folder.
        form: one of FORMATS.
        signals: which (none: every number in every message that can be read, but for arrays whose
            length changes).
        progress: told how far it is.

    Returns:
        What was written, and what was left out.

    Raises:
        BagError: as `read_signals` for damage, if there is nothing to export, and if `out` exists.
    """
    out = _new(out, form)
    left_out: list[str] = []
    tables: dict[str, dict[str, Expression]] = {}
    if signals:
        for found in expanded(bag, signals).values():
            tables.setdefault(found.path.topic, {})[str(found)] = found
    else:
        tables = _every_number(bag, left_out)
    with _temporary(out) as folder:
        folder.mkdir()
        written = _written(
            bag, tables, folder / f"?.{form}", None if signals else left_out, progress
        )
        if not written:
            what = "; ".join(left_out) or "there are no messages"
            raise BagError(f"{bag.path}: nothing was exported: {what}")
    counts = {out / name: count for name, count in written.items()}
    return Exported(counts, tuple(left_out), (*bag.lost, *bag.disagreements))


def _new(out: Path | str, form: str) -> Path:
    """The place to write to; BagError if something is there, or for an unknown format."""
    if form not in FORMATS:
        raise BagError(f"no format '{form}'; there are: {', '.join(FORMATS)}")
    if form == "parquet" and find_spec("pyarrow") is None:
        raise BagError("Parquet needs pyarrow: pip install 'nlsid[export]', or take csv")
    if Path(out).exists():
        raise BagError(f"{out} exists already; take another name or move it away")
    return Path(out)


@contextmanager
def _temporary(out: Path) -> Iterator[Path]:
    """A place beside `out` that gets its name in the end; nothing is left after an error."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        yield Path(folder) / out.name
        (Path(folder) / out.name).rename(out)


def _every_number(bag: Bag, left_out: list[str]) -> dict[str, dict[str, Expression]]:
    """Topic -> every number of it, of those that have messages and a type that can be read.

    One without any field has no column but its times.
    """
    found: dict[str, dict[str, Expression]] = {}
    for topic in bag.topics:
        if not any(channel.count for channel in bag.channels if channel.topic == topic):
            continue
        paths: list[SignalPath] = []
        try:
            msgtype, types = bag.types_on(topic)
            numbers = [
                SignalPath.parse(f"{topic}:{path}") for path, *_ in numeric_paths(msgtype, types)
            ]
        except BagError as error:
            left_out.append(str(error))
            continue
        for path in numbers:
            try:
                paths += _steady(bag, path) if path.every else [path]
            except BagError as error:
                left_out.append(f"{path}: {error}")
        if paths or fields_of(msgtype, types).keys() <= {NO_FIELD}:
            found[topic] = {str(path): Expression(path) for path in paths}
        elif not numbers:
            left_out.append(f"{topic}: a '{msgtype}' holds no number, and text is not exported")
    return found


def _steady(bag: Bag, path: SignalPath) -> list[SignalPath]:
    """The elements of an array; BagError if some message has more or fewer."""
    if sum(step.every for step in path.steps) > 1:
        raise BagError("arrays in arrays are not laid out in columns")
    elements = expand_paths(bag, [path])
    if len(elements) > MAX_COLUMNS:
        raise BagError(f"{len(elements)} elements; name those you need")
    reader = TopicReader(bag, path.topic, {str(element): element for element in elements})
    for _, batch in bag.batches([path.topic]):
        reader.read(batch)
    return elements


def _written(
    bag: Bag,
    wanted: Mapping[str, Mapping[str, Expression]],
    pattern: Path,
    left_out: list[str] | None,
    progress: Progress,
) -> dict[str, int]:
    """Rows by the files' names; a topic that cannot be read is left out, or with None an error.

    pattern: `folder/?.csv`, of which the question mark is replaced by the topic.
    """
    names: dict[str, str] = {}
    for topic in wanted:
        name = topic.strip("/").replace("/", "__")
        while name in names.values():  # /a/b and /a__b
            name += "_"
        names[topic] = name
    tables = {
        topic: _Table(bag, topic, columns, pattern.with_name(names[topic] + pattern.suffix))
        for topic, columns in wanted.items()
    }
    with ExitStack() as stack:
        for table in tables.values():
            stack.callback(table.close)
        for channel, batch, later_ns in bag.parts(list(tables), progress=progress):
            try:
                if channel.topic in tables:
                    tables[channel.topic].add(batch, later_ns)
            except BagError as error:
                if left_out is None:
                    raise
                left_out.append(str(error))
                tables.pop(channel.topic).remove()
        for table in tables.values():
            table.write_until(NEVER)
    return {table.file.name: table.rows for table in tables.values() if table.rows}


class _Table:
    """The file of one topic, whose rows wait until no message with an earlier log time can come."""

    def __init__(self, bag: Bag, topic: str, columns: Mapping[str, Expression], file: Path) -> None:
        self.file = file
        self.rows = 0
        self._reader = TopicReader(bag, topic, {name: s.path for name, s in columns.items()})
        self._waiting: list[Columns] = []
        self._writer: Any = None
        self._signals = columns
        self._running: dict[str, Running] = {}
        kind = bag.types_on(topic)
        for name, signal in columns.items():
            if signal.numbers.operations:
                signal.unit(*kind)
                self._running[name] = signal.numbers.running(signal.recorded_unit(*kind))

    def add(self, batch: Batch, later_ns: int) -> None:
        """Read more messages; `later_ns` as `write_until`."""
        self._waiting.append(self._reader.read(batch))
        self.write_until(later_ns)

    def write_until(self, later_ns: int) -> None:
        """Write the rows with log times before `later_ns`, in order."""
        if not self._waiting or min(int(p.log_ns.min()) for p in self._waiting) >= later_ns:
            return
        part = joined_columns(self._waiting)
        if (np.diff(part.log_ns) < 0).any():
            part = part.select(np.argsort(part.log_ns, kind="stable"))
        count = int(np.searchsorted(part.log_ns, later_ns))
        self._waiting = [part.select(slice(count, None))] if count < len(part) else []
        ready = part.select(slice(count))
        values = {name: self._value(name, ready) for name in ready.values}
        if self._writer is None:
            self._writer = _WRITERS[self.file.suffix[1:]](self.file)
        self._writer.write(_table(replace(ready, values=values)))
        self.rows += count

    def _value(self, name: str, part: Columns) -> Numbers:
        recorded = part.values[name]
        if name not in self._running:
            return recorded
        logged = part.stamp_ns is None or self._signals[name].clock == "log"
        stamps = part.log_ns if logged or part.stamp_ns is None else part.stamp_ns
        rows = zip(stamps.tolist(), recorded.tolist(), strict=True)
        return np.array([self._running[name].update(*row) for row in rows])

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def remove(self) -> None:
        """Leave nothing of it."""
        self.close()
        self.file.unlink(missing_ok=True)


def _table(part: Columns) -> dict[str, Numbers]:
    times = (part.log_ns, part.publish_ns, part.stamp_ns)
    table: dict[str, Numbers] = {
        name: column for name, column in zip(TIMES, times, strict=True) if column is not None
    }
    return table | {name.partition(":")[2]: values for name, values in part.values.items()}


class _Csv:
    """Numbers with all digits that tell float64 apart."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("w", encoding="utf-8", newline="")
        self._started = False

    def write(self, table: Table) -> None:
        if not self._started:
            self._stream.write(",".join(f'"{name}"' for name in table) + "\n")
            self._started = True
        texts = [[repr(value) for value in column.tolist()] for column in table.values()]
        self._stream.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))

    def close(self) -> None:
        self._stream.close()


class _Parquet:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: Any = None

    def write(self, table: Table) -> None:
        import pyarrow
        from pyarrow import parquet

        rows = pyarrow.table(dict(table))
        if self._writer is None:
            self._writer = parquet.ParquetWriter(self._path, rows.schema, compression="zstd")
        self._writer.write_table(rows)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


_WRITERS: Final[Mapping[str, Callable[[Path], Any]]] = {
    "csv": _Csv,
    "parquet": _Parquet,
}
