"""Signals of a bag as tables: CSV, npz or Parquet (extra `export`: pyarrow).

One table per topic is written part by part and needs the memory of one chunk (npz: of the topic).
One table on a common grid needs the memory of its columns.
"""

import io
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch
from bags.recordings.cdr import Numbers
from bags.recordings.definitions import Definition
from bags.recordings.message_types import fields_of
from bags.recordings.storage import NEVER
from bags.signals.columns import Columns, TopicReader, expand_paths, joined_columns
from bags.signals.expressions import Expression, Running
from bags.signals.grid import seconds
from bags.signals.reader import expanded, read_signals
from bags.signals.resample import Method, resample
from bags.signals.signal import NO_FIELD, SignalPath, numeric_paths
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import BagError, DataError
from nlsid_core.progress import Progress, silent

FORMATS: Final = ("csv", "npz", "parquet")
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
    path: Path | str,
    out: Path | str,
    *,
    form: str,
    signals: Sequence[str] | None = None,
    unfinished: bool = False,
    definitions: Mapping[str, Definition] | None = None,
    progress: Progress = silent,
) -> Exported:
    """One table per topic in the new folder `out`: times in ns, the signals after their operations.

    Rows are in the order of log time; a number has the type that it has in the message. A
    derivative is NaN until its window is full. signals: which (None: every number in every message
    that can be read, but for arrays whose length changes). Raises BagError as `read_signals` does
    for damage, if there is nothing to export, and if `out` exists.
    """
    _check_format(form)
    out = Path(out)
    if out.exists():
        raise BagError(f"{out} exists already; name another folder or move it away")
    with Bag(path, unfinished=unfinished, definitions=definitions) as bag:
        left_out: list[str] = []
        tables: dict[str, dict[str, Expression]] = {}
        if signals:
            for found in expanded(bag, signals).values():
                tables.setdefault(found.path.topic, {})[str(found)] = found
        else:
            tables = _every_number(bag, left_out)
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
            folder_path = Path(folder) / out.name
            folder_path.mkdir()
            written = _Tables(bag, tables, folder_path, form)
            written.write(progress, None if signals else left_out)
            if not written.rows:
                what = "; ".join(left_out) or "there are no messages"
                raise BagError(f"{path}: nothing was exported: {what}")
            folder_path.rename(out)
        notes = (*bag.lost, *bag.disagreements)
    return Exported(
        {out / name: count for name, count in written.rows.items()}, tuple(left_out), notes
    )


def export_grid(
    path: Path | str,
    out: Path | str,
    *,
    form: str,
    signals: Sequence[str],
    period: float,
    method: Method = "linear",
    hold: Sequence[str] = (),
    max_gap: float,
    clock: str = "header",
    unfinished: bool = False,
    definitions: Mapping[str, Definition] | None = None,
) -> dict[str, float]:
    """One table on a common grid of `period` s: t in s since the first common stamp, and signals.

    hold: the signals (of `signals`) that are commands; the others are resampled by `method`.
    clock: `header` or `log`, for all of them.
    Returns each signal's error bound (see `resample`). Raises BagError and DataError as
    `read_signals` and `resample` do, and if `out` exists.
    """
    _check_format(form)
    out = Path(out)
    if out.exists():
        raise BagError(f"{out} exists already; name another file or move it away")
    stamped = "log time" if clock == "log" else None
    read = read_signals(
        path, signals, clock=stamped, unfinished=unfinished, definitions=definitions
    )
    if len({samples.clock for samples in read.values()}) > 1:
        said = "; ".join(f"{name} has a {samples.clock}" for name, samples in read.items())
        raise BagError(f"{path}: times of two clocks cannot share a grid: {said}; set --clock log")
    if unknown := set(hold) - read.keys():
        raise BagError(f"hold: {min(unknown)} is not one of the signals")
    first = max(int(s.stamp_ns[0]) for s in read.values())
    last = min(int(s.stamp_ns[-1]) for s in read.values())
    period_ns = round(period * 1e9)
    if period_ns <= 0 or last - first < period_ns:
        raise DataError(f"{path}: the signals overlap in {(last - first) / 1e9:g} s, less than two")
    grid = first + period_ns * np.arange(1 + (last - first) // period_ns)
    table: dict[str, Any] = {"t": seconds(grid, first)}
    errors = {}
    for name, samples in read.items():
        how: Method = "hold" if name in hold else method
        found = resample(samples, grid, method=how, max_gap=max_gap)
        table[name], errors[name] = found.values, found.error + _rounding(samples.values)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        part = Path(folder) / out.name
        with _WRITERS[form](part) as writer:
            writer.write(table)
        part.rename(out)
    return errors


def _rounding(values: FloatArray) -> float:
    """How far integers may be from their float64: beyond 2^53 not each has one."""
    largest = float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values)))
    return float(np.spacing(largest) / 2) if largest >= 2**53 else 0.0


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
            texts = [f"{topic}:{path}" for path, *_ in numeric_paths(msgtype, types)]
        except BagError as error:
            left_out.append(str(error))
            continue
        for path in map(SignalPath.parse, texts):
            try:
                paths += _steady(bag, path) if path.every else [path]
            except BagError as error:
                left_out.append(f"{path}: {error}")
        if paths or fields_of(msgtype, types).keys() <= {NO_FIELD}:
            found[topic] = {str(path): Expression(path) for path in paths}
        elif not texts:
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


class _Tables:
    """The tables of all topics. rows: of each file."""

    def __init__(
        self, bag: Bag, tables: Mapping[str, Mapping[str, Expression]], folder: Path, form: str
    ) -> None:
        self.rows: dict[str, int] = {}
        self._bag, self._folder, self._form = bag, folder, form
        self._tables = {topic: _Table(bag, topic, columns) for topic, columns in tables.items()}
        self._writers: dict[str, tuple[str, Any]] = {}

    def write(self, progress: Progress, left_out: list[str] | None) -> None:
        """Write them all; a topic that cannot be read is left out, or with None an error."""
        total, done = sum(c.count for c in self._bag.channels if c.topic in self._tables), 0
        try:
            for channel, batch, later_ns in self._bag.parts(list(self._tables)):
                try:
                    if channel.topic in self._tables:
                        self._append(
                            channel.topic, self._tables[channel.topic].add(batch, later_ns)
                        )
                except BagError as error:
                    if left_out is None:
                        raise
                    left_out.append(str(error))
                    self._remove(channel.topic)
                done += len(batch)
                progress("reading", done / max(total, 1))
            for topic, table in self._tables.items():
                self._append(topic, table.ready(NEVER))
        finally:
            for _, writer in self._writers.values():
                writer.close()

    def _append(self, topic: str, part: Columns | None) -> None:
        if part is None or not len(part):
            return
        if topic not in self._writers:
            name = topic.strip("/").replace("/", "__")
            while f"{name}.{self._form}" in self.rows:  # /a/b and /a__b
                name += "_"
            name += f".{self._form}"
            self._writers[topic] = name, _WRITERS[self._form](self._folder / name)
        name, writer = self._writers[topic]
        writer.write(_table(part))
        self.rows[name] = self.rows.get(name, 0) + len(part)

    def _remove(self, topic: str) -> None:
        del self._tables[topic]
        if topic in self._writers:
            name, writer = self._writers.pop(topic)
            writer.close()
            (self._folder / name).unlink()
            del self.rows[name]


class _Table:
    """The rows of one topic, which wait until no message with an earlier log time can come."""

    def __init__(self, bag: Bag, topic: str, columns: Mapping[str, Expression]) -> None:
        self._reader = TopicReader(bag, topic, {name: s.path for name, s in columns.items()})
        self._operations = _Operations(bag, columns)
        self._waiting: list[Columns] = []

    def add(self, batch: Batch, later_ns: int) -> Columns | None:
        """Read more messages; the rows that are ready."""
        self._waiting.append(self._reader.read(batch))
        return self.ready(later_ns)

    def ready(self, later_ns: int) -> Columns | None:
        """The rows with log times before `later_ns`, in order; None if there are none."""
        if not self._waiting or min(int(p.log_ns.min()) for p in self._waiting) >= later_ns:
            return None
        part = joined_columns(self._waiting)
        if (np.diff(part.log_ns) < 0).any():
            part = part.select(np.argsort(part.log_ns, kind="stable"))
        count = int(np.searchsorted(part.log_ns, later_ns))
        self._waiting = [part.select(slice(count, None))] if count < len(part) else []
        return self._operations.on(part.select(slice(count)))


class _Operations:
    """What is to be done to the signals of each topic, part by part."""

    def __init__(self, bag: Bag, columns: Mapping[str, Expression]) -> None:
        self._running: dict[str, Running] = {}
        self._signals = columns
        for name, signal in columns.items():
            if signal.numbers.operations:
                kind = bag.types_on(signal.path.topic)
                signal.unit(*kind)
                self._running[name] = signal.numbers.running(signal.recorded_unit(*kind))

    def on(self, part: Columns) -> Columns:
        values = {name: self._value(name, part) for name in part.values}
        return replace(part, values=values)

    def _value(self, name: str, part: Columns) -> Numbers:
        recorded = part.values[name]
        if name not in self._running:
            return recorded
        logged = part.stamp_ns is None or self._signals[name].clock == "log"
        stamps = part.log_ns if logged or part.stamp_ns is None else part.stamp_ns
        rows = zip(stamps.tolist(), recorded.tolist(), strict=True)
        return np.array([self._running[name].update(*row) for row in rows])


def _table(part: Columns) -> dict[str, Numbers]:
    times = (part.log_ns, part.publish_ns, part.stamp_ns)
    table: dict[str, Numbers] = {
        name: column for name, column in zip(TIMES, times, strict=True) if column is not None
    }
    return table | {name.partition(":")[2]: values for name, values in part.values.items()}


class TableWriter(Protocol):
    """A file that takes a table part by part; all parts have the same columns."""

    def write(self, table: Table) -> None:
        """Append rows."""

    def close(self) -> None:
        """Finish the file."""

    def __enter__(self) -> "TableWriter":
        """Use it in a with block."""

    def __exit__(self, *_: object) -> None:
        """Finish the file."""


class _Closing(ABC):
    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Csv(_Closing):
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


class _Npz(_Closing):
    def __init__(self, path: Path) -> None:
        self._path = path
        self._parts: list[Table] = []

    def write(self, table: Table) -> None:
        self._parts.append(table)

    def close(self) -> None:
        arrays = {n: np.concatenate([p[n] for p in self._parts]) for n in self._parts[0]}
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        self._path.write_bytes(stream.getvalue())


class _Parquet(_Closing):
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
    "npz": _Npz,
    "parquet": _Parquet,
}


def _check_format(form: str) -> None:
    if form not in FORMATS:
        raise BagError(f"no format '{form}'; there are: {', '.join(FORMATS)}")
    if form == "parquet" and find_spec("pyarrow") is None:
        raise BagError("Parquet needs pyarrow: pip install 'nlsid[export]', or take csv or npz")
