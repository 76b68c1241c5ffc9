"""Tables (CSV, MAT, HDF5) to a bag of standard messages."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from scipy.io import loadmat

from bags.recordings.message_types import fields_of, is_stamped, standard_types
from bags.recordings.names import did_you_mean, listed
from bags.recordings.writer import BagWriter
from bags.signals.reader import stamp_text
from bags.signals.signal import SignalPath, Step
from nlsid_core._types import FloatArray, IntArray
from nlsid_core.errors import BagError, DataError

MAX_TABLE_BYTES: Final = 2**31
_COLUMN: Final = re.compile(r"(?P<table>[^\[\]]+?)(?:\[(?P<index>\d{1,6})\])?")

Tables = Mapping[str, FloatArray]


@dataclass(frozen=True)
class Assignment:
    """A signal and the column it gets: `/joint_states:position[name=elbow]=angles[3]`."""

    path: SignalPath
    column: str

    @classmethod
    def parse(cls, text: str) -> "Assignment":
        """Read `signal=column`; BagError says what is wrong with it."""
        signal, equals, column = text.rpartition("=")
        if not equals or not column or signal.count("[") != signal.count("]"):
            raise BagError(
                f"'{text}' is not signal=column, e.g. /joint_states:position[name=elbow]=angles[3]"
            )
        path = SignalPath.parse(signal.strip())
        if path.every:
            raise BagError(f"'{text}': name one element for one column")
        return cls(path, column.strip())


def read_tables(files: Sequence[Path | str]) -> dict[str, FloatArray]:
    """Every numeric array of the files: name -> (rows,) or (rows, columns).

    A CSV file without a header is one table by the file's name; with one, each column is a table by
    its own name. In MAT (up to version 7.2) and HDF5 files (MAT 7.3 too) each numeric array is one;
    nothing in them is evaluated. Names that two files share are `file.name`. Raises DataError for a
    file that is none of these or holds no numbers.
    """
    tables: dict[str, FloatArray] = {}
    for path in map(Path, files):
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise DataError(f"{path}: more than {MAX_TABLE_BYTES} bytes; import it in parts")
        readers = {".csv": _csv, ".txt": _csv, ".dat": _csv, ".mat": _mat, ".h5": _hdf5}
        readers |= {".hdf5": _hdf5}
        reader = readers.get(path.suffix.lower())
        if reader is None:
            raise DataError(f"{path}: unknown kind; known are {', '.join(readers)}")
        found = reader(path)
        if not found:
            raise DataError(f"{path} holds no table of numbers")
        for name, table in found.items():
            tables[f"{path.stem}.{name}" if name in tables else name] = table
    return tables


def import_tables(
    files: Sequence[Path | str],
    out: Path | str,
    assignments: Sequence[str],
    *,
    types: Mapping[str, str],
    period: float | None = None,
    time: str | None = None,
    start_ns: int = 0,
    custom: Mapping[str, str] | None = None,
) -> dict[str, int]:
    """Write a bag with one message a row; topic -> how many there are.

    assignments: `signal=column` each; types: topic -> message type, a standard one. Rows are
    `period` s apart, or stamped by the column `time` in s, from `start_ns` on; header stamp, log
    time and publish time are equal. A topic has as many messages as the shortest of its columns.
    What is not assigned is zero or empty. Raises BagError and DataError for what does not fit, and
    if `out` exists.
    """
    if (period is None) == (time is None):
        raise BagError("state either the period of the rows or the column with their times")
    tables = read_tables(files)
    topics: dict[str, dict[SignalPath, FloatArray]] = {}
    for text in assignments:
        parsed = Assignment.parse(text)
        topics.setdefault(parsed.path.topic, {})[parsed.path] = column_of(tables, parsed.column)
    if unknown := set(types) - set(topics):
        raise BagError(f"nothing is assigned to {min(unknown)}, for which a type is given")
    streams = []
    for topic, columns in topics.items():
        if topic not in types:
            raise BagError(
                f"no type for {topic}; state it, e.g. {topic}=sensor_msgs/msg/JointState"
            )
        rows = min(map(len, columns.values()))
        stamps = _stamps(rows, period, None if time is None else column_of(tables, time), start_ns)
        streams.append(_Stream(topic, types[topic], columns, stamps))
    if not streams:
        raise BagError("nothing is assigned, so there is nothing to write")
    with BagWriter(out, custom=custom) as writer:
        events = sorted(
            (int(stamp), k, row)
            for k, stream in enumerate(streams)
            for row, stamp in enumerate(stream.stamps)
        )
        for stamp, k, row in events:
            times = {"log_time_ns": stamp, "publish_time_ns": stamp}
            stream = streams[k]
            writer.write(stream.topic, stream.msgtype, stream.message(row), **times)
        return dict(writer.counts)


def column_of(tables: Tables, name: str) -> FloatArray:
    """The column `table[index]`, or `table` if it has one; DataError lists what there is."""
    match = _COLUMN.fullmatch(name)
    table = match["table"] if match else name
    if table not in tables:
        shapes = listed(f"{n} {'x'.join(map(str, t.shape))}" for n, t in tables.items())
        raise DataError(f"no table '{table}'; there are: {shapes}{did_you_mean(table, tables)}")
    values = tables[table]
    if values.ndim == 1 and not (match and match["index"]):
        return values
    if values.ndim != 2 or not match or match["index"] is None:
        raise DataError(f"'{name}' has shape {values.shape}; name one column, {table}[0]")
    index = int(match["index"])
    if index >= values.shape[1]:
        raise DataError(f"'{name}': the table has columns [0] to [{values.shape[1] - 1}]")
    column: FloatArray = values[:, index]
    return column


class _Stream:
    """The messages of one topic, made row by row from one template."""

    def __init__(
        self, topic: str, msgtype: str, columns: Mapping[SignalPath, FloatArray], stamps: IntArray
    ) -> None:
        store = standard_types()
        fields_of(msgtype, store)
        for path in columns:
            path.check(msgtype, store)
        self.topic, self.msgtype, self.stamps = topic, msgtype, stamps
        self._columns = columns
        self._stamped = is_stamped(msgtype, store)
        self._message = _empty(msgtype)
        for path in columns:
            _make_room(self._message, path.steps)

    def message(self, row: int) -> bytes:
        stamp = int(self.stamps[row])
        if self._stamped:
            header: Any = self._message
            header.header.stamp.sec, header.header.stamp.nanosec = divmod(stamp, 10**9)
        for path, column in self._columns.items():
            path.assign(self._message, float(column[row]))
        return bytes(standard_types().serialize_cdr(self._message, self.msgtype))


def _stamps(rows: int, period: float | None, time: FloatArray | None, start_ns: int) -> IntArray:
    if period is not None:
        if not period > 0:
            raise DataError(f"a period of {period:g} s")
        even: IntArray = start_ns + np.rint(np.arange(rows) * period * 1e9).astype(np.int64)
        return even
    assert time is not None
    if len(time) < rows:
        raise DataError(f"{rows} rows but {len(time)} times")
    stamps: IntArray = start_ns + np.rint(time[:rows] * 1e9).astype(np.int64)
    if len(back := np.flatnonzero(np.diff(stamps) <= 0)):
        raise DataError(
            f"time does not increase after row {back[0]}: {stamp_text(stamps[back[0]])}"
        )
    return stamps


def _csv(path: Path) -> dict[str, FloatArray]:
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        first = stream.readline()
    delimiter = next((mark for mark in (";", ",", "\t") if mark in first), None)
    cells = [cell.strip().strip('"') for cell in first.split(delimiter)]
    titled = not all(_is_number(cell) for cell in cells if cell)
    try:
        table = np.loadtxt(
            path, delimiter=delimiter, skiprows=int(titled), ndmin=2, encoding="utf-8-sig"
        )
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
    if not titled:
        return {path.stem: table[:, 0] if table.shape[1] == 1 else table}
    if len(cells) != table.shape[1]:
        raise DataError(f"{path}: {len(cells)} titles over {table.shape[1]} columns")
    return {cell: table[:, k] for k, cell in enumerate(cells)}


def _mat(path: Path) -> dict[str, FloatArray]:
    try:
        content = loadmat(path, squeeze_me=False)
    except NotImplementedError:
        return _hdf5(path)  # what SciPy says of version 7.3, which is HDF5
    except Exception as error:  # scipy raises what the bytes make it raise
        raise DataError(f"{path} is not a MAT file: {type(error).__name__}: {error}") from error
    return {name: _column(value) for name, value in content.items() if _is_table(value)}


def _hdf5(path: Path) -> dict[str, FloatArray]:
    try:
        import h5py
    except ImportError as error:
        raise DataError(f"{path}: HDF5 needs h5py: pip install 'nlsid[export]'") from error
    found: dict[str, FloatArray] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim in (1, 2) and item.nbytes < MAX_TABLE_BYTES:
            value = item[()]
            if _is_table(value):
                found[name] = _column(value)

    try:
        with h5py.File(path, "r") as content:
            content.visititems(visit)
    except OSError as error:
        raise DataError(f"{path} is not an HDF5 file: {error}") from error
    return found


def _is_table(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.ndim in (1, 2)
        and value.size > 0
        and (np.issubdtype(value.dtype, np.integer) or np.issubdtype(value.dtype, np.floating))
    )


def _column(value: Any) -> FloatArray:
    """As float64; a matrix of one row or column as that row or column."""
    table = np.asarray(value, dtype=np.float64)
    return table.ravel() if table.ndim == 2 and 1 in table.shape else table


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _empty(msgtype: str) -> Any:
    """A message of zeros and empty strings."""
    fields = fields_of(msgtype, standard_types())
    values = [_zero(description) for description in fields.values()]
    return standard_types().types[msgtype](*values)


def _zero(description: FieldDesc) -> Any:
    if description[0] == Nodetype.NAME:
        return _empty(str(description[1]))
    if description[0] == Nodetype.BASE:
        name = description[1][0]
        if name == "bool":
            return False
        return "" if name == "string" else 0.0 if "float" in name else 0
    element, length = description[1]
    count = int(str(length)) if description[0] == Nodetype.ARRAY else 0
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.zeros(count, dtype={"byte": "i1", "char": "u1"}.get(element[1][0], element[1][0]))
    return [_zero(element) for _ in range(count)]


def _make_room(message: Any, steps: Sequence[Step]) -> None:
    """Let the arrays on the way be long enough, and have the named elements."""
    for owner, step in _walk(message, steps):
        array = getattr(owner, step.field)
        if step.key is not None:
            names = getattr(owner, step.key[0])
            if step.key[1] not in names:
                names.append(step.key[1])
            needed = len(names)
        else:
            needed = 0 if step.index is None else step.index + 1
        if isinstance(array, np.ndarray) and len(array) < needed:
            setattr(owner, step.field, np.pad(array, (0, needed - len(array))))


def _walk(message: Any, steps: Sequence[Step]) -> Iterator[tuple[Any, Step]]:
    for k, step in enumerate(steps):
        yield message, step
        if k < len(steps) - 1:
            if step.picks:
                raise BagError(f"'{step.field}': elements that are messages cannot be imported")
            message = getattr(message, step.field)
