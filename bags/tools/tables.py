"""A bag as tables: a pandas DataFrame, or CSV and Parquet files (extra `export`: pyarrow).

Every field is a column of the type that it has in the message; an array is a list. What is asked
for by a signal's path has a column for each element, and its operations are done. A file is written
part by part and needs the memory of one chunk.
"""

import csv
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch
from bags.recordings.cdr import Numbers
from bags.recordings.mcap_records import NEVER
from bags.recordings.message_types import decode, fields_of
from bags.recordings.writer import refuse_existing
from bags.signals.columns import Columns, TopicReader, joined_columns
from bags.signals.expressions import SIGNAL_CLOCKS, Expression, Running
from bags.signals.reader import expanded
from bags.signals.signal import NO_FIELD, SignalPath, attribute
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

FORMATS: Final = ("csv", "parquet")
MAX_ELEMENTS: Final = 4096  # of an array in the first message; images and clouds are not tables
TIMES: Final = ("log_time_ns", "publish_time_ns", "stamp_ns")
Table = Mapping[str, Any]
Wanted = Mapping[str, Mapping[str, Expression]]  # topic -> column -> what it holds


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

    Rows are in the order of log time. A derivative is NaN until its window is full.

    Args:
        bag: an open bag.
        out: the new folder.
        form: one of FORMATS.
        signals: which, or topics (none: every field of every topic that can be read).
        progress: told how far it is.

    Returns:
        What was written, and what was left out.

    Raises:
        BagError: as `read_signals` for damage, if there is nothing to export, and if `out` exists.
    """
    if form not in FORMATS:
        raise BagError(f"no format '{form}'; there are: {', '.join(FORMATS)}")
    out = Path(out)
    refuse_existing(out)
    left_out: list[str] = []
    wanted = _wanted(bag, signals, left_out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as beside,
        ExitStack() as stack,
    ):
        folder = Path(beside) / out.name
        folder.mkdir()
        files: dict[str, _Csv | _Parquet] = {}
        counts: dict[str, int] = {}
        refused = None if signals else left_out
        for topic, table in _tables(bag, wanted, refused, progress):
            if topic not in files:
                name = topic.strip("/").replace("/", "__")
                while name in {file.path.stem for file in files.values()}:  # /a/b and /a__b
                    name += "_"
                path, kind = folder / f"{name}.{form}", bag.types_on(topic)
                files[topic] = _Csv(path) if form == "csv" else _Parquet(path, wanted[topic], kind)
                stack.callback(files[topic].close)
            files[topic].write(table)
            counts[topic] = counts.get(topic, 0) + len(table[TIMES[0]])
        if not files:
            what = "; ".join(left_out) or "there are no messages"
            raise BagError(f"{bag.path}: nothing was exported: {what}")
        stack.close()
        folder.rename(out)
    return Exported(
        {out / files[topic].path.name: counts[topic] for topic in wanted if topic in files},
        tuple(left_out),
        (*bag.lost, *bag.disagreements),
    )


def frame(
    bag: Bag | Path | str,
    wanted: Sequence[str] | str,
    *,
    clock: str = "header",
    period: float | None = None,
) -> Any:
    """Read topics and signals of a bag as one pandas DataFrame.

    Its index is the time, to the nanosecond. Columns are called as the fields, of several topics
    with the topic before it, `/odom:pose.pose.position.x`. Rows are the messages of the first
    topic, or every `period`; of other topics a row has the newest message at or before it, of a
    transform the newest that has it.

    Args:
        bag: where it is, or one that is open.
        wanted: topics, `/odom`, or signals, `/odom:pose.pose.position.x|to(mm)`; none: all topics.
        clock: `header` (log times of types without a header) or `log`.
        period: s between rows.

    Returns:
        The DataFrame; integers, booleans and strings as such, arrays as NumPy arrays; integers and
        booleans of pandas' nullable types where rows come before them. Its `attrs["left_out"]` says
        which arrays are too long for a table: pixels, points.

    Raises:
        BagError: without pandas, for another clock or a period of 0, as `read_signals` for damage,
            and if nothing is there.
    """
    if clock not in SIGNAL_CLOCKS or (period is not None and not period > 0):
        raise BagError(f"a frame has the clock header or log and a period > 0: {clock}, {period}")
    if find_spec("pandas") is None:
        raise BagError("a frame needs pandas: pip install 'nlsid[export]'")
    import pandas

    parts: dict[str, list[Table]] = {}
    with nullcontext(bag) if isinstance(bag, Bag) else Bag(bag) as source:
        left_out: list[str] = []
        tables = _wanted(source, [wanted] if isinstance(wanted, str) else wanted, left_out)
        for topic, table in _tables(source, tables, None, silent):
            parts.setdefault(topic, []).append(table)
        frames = []
        framed: set[str] = set()
        for topic, columns in tables.items():
            if topic not in parts:
                raise BagError(f"{source.path}: {topic} has no messages")
            rows = {n: np.concatenate([p[n] for p in parts[topic]]) for n in parts[topic][0]}
            by = "stamp_ns" if clock == "header" and "stamp_ns" in rows else "log_time_ns"
            index = pandas.DatetimeIndex(rows[by].view("M8[ns]"), name="time")
            prefix = f"{topic}:" if len(tables) > 1 else ""
            named = {f"{prefix}{n}": v for n, v in rows.items() if n not in TIMES}
            framed |= {f"{prefix}{n}" for n, signal in columns.items() if signal.path.framed}
            frames.append(pandas.DataFrame(named, index).sort_index(kind="stable"))
    joined = frames[0]
    if period is not None:
        first, last = (end(f.index[k] for f in frames) for end, k in ((min, 0), (max, -1)))
        joined = pandas.DataFrame(
            index=pandas.date_range(first, last, freq=pandas.Timedelta(period, "s"), name="time")
        )
    for other in frames[0 if period is not None else 1 :]:
        held = [name for name in other if name in framed]
        other[held] = other[held].ffill()  # the newest message may be of other transforms
        if other.index[0] > joined.index[0]:
            kinds = {
                name: pandas.array(column[:0].to_numpy()).dtype  # which may be missing
                for name, column in other.items()
                if column.dtype.kind in "iub"
            }
            other = other.astype(kinds)  # NaN would make floats of them
        joined = pandas.merge_asof(joined, other, left_index=True, right_index=True)
    joined.attrs["left_out"] = left_out
    return joined


def _wanted(
    bag: Bag, texts: Sequence[str], left_out: list[str]
) -> dict[str, dict[str, Expression]]:
    """The columns of each topic; of none that are named, of all that have messages.

    left_out: gets what of all topics cannot be read.
    """
    found: dict[str, dict[str, Expression]] = {}
    for text in texts:
        if ":" in text:
            for signal in expanded(bag, [text]).values():
                found.setdefault(signal.path.topic, {})[str(signal).partition(":")[2]] = signal
        else:
            found[text] = _every_field(bag, text, left_out)
    for topic in () if texts else dict.fromkeys(c.topic for c in bag.channels if c.count):
        try:
            found[topic] = _every_field(bag, topic, left_out)
        except BagError as error:
            left_out.append(str(error))
    return found


def _every_field(bag: Bag, topic: str, left_out: list[str]) -> dict[str, Expression]:
    """Each field of a topic's messages, those of messages in it by their paths.

    Arrays with more than MAX_ELEMENTS in the first message are left out: pixels and points.
    """
    msgtype, types = bag.types_on(topic)
    columns = {
        text.removesuffix("[*]"): Expression(SignalPath.parse(f"{topic}:{text}"))
        for text in _fields(msgtype, types)
    }
    for _, first in islice(bag.batches([topic]), 1):
        message = decode(first.data(0), msgtype, types)
        for name, signal in list(columns.items()):
            value = _value(message, signal.path)
            if not isinstance(value, str) and np.size(value) > MAX_ELEMENTS:
                left_out.append(f"{topic}:{name}: {np.size(value)} elements; name those you need")
                del columns[name]
    return columns


def _fields(msgtype: str, types: Typestore) -> Iterator[str]:
    """The way to each number, text and array; with `[*]` to arrays of messages."""
    for name, description in fields_of(msgtype, types).items():
        if description[0] == Nodetype.NAME:
            yield from (f"{name}.{inner}" for inner in _fields(str(description[1]), types))
        elif description[0] != Nodetype.BASE and description[1][0][0] == Nodetype.NAME:
            yield f"{name}[*]"
        elif name != NO_FIELD:
            yield name


def _value(message: Any, path: SignalPath) -> Any:
    for step in path.steps:
        message = getattr(message, attribute(step.field))
    return message


def _tables(
    bag: Bag, wanted: Wanted, left_out: list[str] | None, progress: Progress
) -> Iterator[tuple[str, Table]]:
    """(topic, rows) part by part, of each topic in the order of log time.

    left_out: gets why a topic cannot be read, which then ends; None: that is an error.
    """
    topics = {topic: _Topic(bag, topic, columns) for topic, columns in wanted.items()}
    for channel, batch, later_ns in bag.parts(list(topics), progress=progress):
        try:
            if channel.topic in topics:
                yield from topics[channel.topic].add(batch, later_ns)
        except BagError as error:
            if left_out is None:
                raise
            left_out.append(str(error))
            del topics[channel.topic]
    for topic in topics.values():
        yield from topic.rows_until(NEVER)


class _Topic:
    """One topic, whose rows wait until no message with an earlier log time can come."""

    def __init__(self, bag: Bag, topic: str, columns: Mapping[str, Expression]) -> None:
        self._topic = topic
        self._kind = kind = bag.types_on(topic)
        self._signals = columns
        self._decoded = {n: s.path for n, s in columns.items() if s.path.every}
        self._reader = TopicReader(
            bag, topic, {n: s.path for n, s in columns.items() if n not in self._decoded}
        )
        self._waiting: list[Columns] = []
        self._running: dict[str, Running] = {}
        for name, signal in columns.items():
            if signal.numbers.operations:
                signal.unit(*kind)
                self._running[name] = signal.numbers.running(signal.recorded_unit(*kind))

    def add(self, batch: Batch, later_ns: int) -> Iterator[tuple[str, Table]]:
        """Read more messages; `later_ns` as `rows_until`."""
        part = self._reader.read(batch)
        if self._decoded:
            messages = [decode(batch.data(k), *self._kind) for k in range(len(batch))]
            nested = {
                name: np.fromiter((_plain(_value(m, path)) for m in messages), object)
                for name, path in self._decoded.items()
            }
            part = replace(part, values={**part.values, **nested})
        self._waiting.append(part)
        return self.rows_until(later_ns)

    def rows_until(self, later_ns: int) -> Iterator[tuple[str, Table]]:
        """Give the rows with log times before `later_ns`, in order."""
        if not self._waiting or min(int(p.log_ns.min()) for p in self._waiting) >= later_ns:
            return
        part = joined_columns(self._waiting)
        if (np.diff(part.log_ns) < 0).any():
            part = part.select(np.argsort(part.log_ns, kind="stable"))
        count = int(np.searchsorted(part.log_ns, later_ns))
        self._waiting = [part.select(slice(count, None))] if count < len(part) else []
        ready = part.select(slice(count))
        times = zip(TIMES, (ready.log_ns, ready.publish_ns, ready.stamp_ns), strict=True)
        table = {name: column for name, column in times if column is not None}
        yield self._topic, table | {name: self._column(name, ready) for name in self._signals}

    def _column(self, name: str, part: Columns) -> Numbers:
        recorded = part.values[name]
        if name not in self._running:
            return recorded
        logged = part.stamp_ns is None or self._signals[name].clock == "log"
        stamps = part.log_ns if logged or part.stamp_ns is None else part.stamp_ns
        rows = zip(stamps.tolist(), recorded.tolist(), strict=True)
        return np.array([self._running[name].update(*row) for row in rows])


def _plain(value: Any) -> Any:
    """A decoded message as dictionaries and lists."""
    if isinstance(value, list):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if hasattr(value, "__msgtype__"):
        names = [name for name in vars(value) if name != "__msgtype__"]
        return {name: _plain(getattr(value, name)) for name in names}
    return value


class _Csv:
    """Numbers with all digits that tell float64 apart, lists as JSON."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream, lineterminator="\n")

    def write(self, table: Table) -> None:
        if not self._stream.tell():
            self._writer.writerow(table)
        self._writer.writerows(zip(*[_cells(column) for column in table.values()], strict=True))

    def close(self) -> None:
        self._stream.close()


def _cells(column: Numbers) -> list[Any]:
    """A column as the cells of a CSV file."""
    cells: list[Any] = column.tolist()
    if column.dtype != object:
        return cells
    return [cell if isinstance(cell, str) else json.dumps(_plain(cell)) for cell in cells]


class _Parquet:
    """Columns of the types that the messages state, also where the first arrays are empty."""

    def __init__(
        self, path: Path, columns: Mapping[str, Expression], kind: tuple[str, Typestore]
    ) -> None:
        self.path = path
        self._columns, self._kind = columns, kind
        self._writer: Any = None

    def write(self, table: Table) -> None:
        import pyarrow
        from pyarrow import parquet

        if self._writer is None:
            schema = pyarrow.schema([(name, self._type(name, table[name])) for name in table])
            self._writer = parquet.ParquetWriter(self.path, schema, compression="zstd")
        self._writer.write_table(pyarrow.table(dict(table), self._writer.schema))

    def _type(self, name: str, column: Numbers) -> Any:
        """Arrow's type of texts and arrays as stated, of numbers after their operations."""
        import pyarrow

        if column.dtype != object:
            return pyarrow.from_numpy_dtype(column.dtype)
        msgtype, types = self._kind
        found: FieldDesc = (Nodetype.NAME, msgtype)
        for step in self._columns[name].path.steps:
            found = fields_of(str(found[1]), types)[step.field]
        return _arrow(found, types)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def _arrow(found: FieldDesc, types: Typestore) -> Any:
    """Arrow's type of a field."""
    import pyarrow

    if found[0] == Nodetype.NAME:
        fields = fields_of(str(found[1]), types)
        return pyarrow.struct([(attribute(n), _arrow(f, types)) for n, f in fields.items()])
    if found[0] != Nodetype.BASE:
        return pyarrow.list_(_arrow(found[1][0], types))
    name = str(found[1][0])
    return pyarrow.type_for_alias(
        {"byte": "uint8", "char": "uint8", "octet": "uint8", "wstring": "string"}.get(name, name)
    )
