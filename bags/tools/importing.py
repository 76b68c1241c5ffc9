"""A table (CSV) to a bag of standard messages."""

import csv
import math
import re
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from bags.recordings.cdr import Step
from bags.recordings.message_types import is_stamped, standard_types
from bags.recordings.names import did_you_mean, listed
from bags.recordings.writer import whole_bag
from bags.signals.reader import stamp_text
from bags.signals.signal import SignalPath
from bags.signals.units import UNITS
from bags.tools.copies import Rows
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import BagError, DataError

MAX_TABLE_BYTES: Final = 2**31
STAMP_SECONDS: Final = 2**31  # builtin_interfaces/msg/Time counts them in an int32
LARGEST: Final = 2**16  # bytes of an empty message, and more
NUMBER: Final = "std_msgs/msg/Float64"  # of a topic with one column, `data`, and no type
SLOW: Final = 1.0  # s between rows, of most robots times in another unit: asked about
EPOCHS: Final = {"ns": 1e17, "us": 1e14, "ms": 1e11, "s": 1e9}  # the least time since 1970 in it
_TIME: Final = re.compile(r"(?P<column>.+)\|unit\((?P<unit>s|ms|us|ns)\)")
_IS_TIME: Final = re.compile(
    r"(?i)(t|time|timestamp|stamp)([ _]?[\[(](s|ms|us|ns)[\])]|_(s|ms|us|ns))?"
)
_TITLE: Final = re.compile(r".+?(?:[ _]?[\[(](?P<a>\w+)[\])]|_(?P<b>s|ms|us|ns))")


@dataclass(frozen=True)
class Imported:
    """Messages on each topic; how the times were understood, in words."""

    counts: dict[str, int]
    times: str


def read_table(file: Path | str) -> dict[str, FloatArray]:
    """Read the numbers of a CSV file, (rows,) by the columns' titles in its first line.

    An empty cell is NaN, and a column without a number is left out. Raises DataError, with the
    line, for lines of another length and for a text among numbers, and for a file without titles
    or numbers.
    """
    path = Path(file)
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise DataError(f"{path}: more than {MAX_TABLE_BYTES} bytes; import it in parts")
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
        first = stream.readline()
        delimiter = next((mark for mark in (";", ",", "\t") if mark in first), ",")
        stream.seek(0)
        lines = csv.reader(stream, delimiter=delimiter, skipinitialspace=True)
        titles = [title.strip() for title in next(lines, [])]
        if titles and all(_number(title) is not None for title in titles):
            raise DataError(
                f"{path}: its first line holds numbers; write the columns' titles there"
            )
        if twice := next((title for title in titles if titles.count(title) > 1), None):
            raise DataError(f"{path}: two columns are called '{twice}'")
        columns = [array("d") for _ in titles]
        words: dict[str, str] = {}  # title -> the first cell that is no number
        for cells in lines:
            if cells and len(cells) != len(titles):
                where = f"in line {lines.line_num}, {len(titles)} in line 1"
                raise DataError(f"{path}: {len(cells)} cells {where}")
            for title, column, cell in zip(titles, columns, cells, strict=False):
                number = _number(cell)
                if number is None:
                    words.setdefault(title, f"'{cell}' in line {lines.line_num}")
                    number = math.nan
                column.append(number)
    tables = {title: np.array(column) for title, column in zip(titles, columns, strict=True)}
    tables = {title: column for title, column in tables.items() if not np.isnan(column).all()}
    if not tables:
        raise DataError(f"{path} holds no table of numbers")
    if mixed := next((title for title in tables if title in words), None):
        raise DataError(f"{path}: {words[mixed]}, column '{mixed}' is no number")
    return tables


def _number(text: str) -> float | None:
    """The number in a cell, NaN in an empty one; None if it is no number."""
    try:
        return float(text) if text.strip() else math.nan
    except ValueError:
        return None


def _column(tables: Mapping[str, FloatArray], title: str) -> FloatArray:
    if title not in tables:
        raise DataError(
            f"no column of numbers '{title}'; there are: {listed(tables)}"
            f"{did_you_mean(title, tables)}"
        )
    return tables[title]


def _assigned(text: str) -> tuple[SignalPath, str]:
    """A signal and its column, of `/joints:position[name=elbow]=angle`; BagError if neither."""
    signal, equals, column = text.rpartition("=")
    if not equals or not column or signal.count("[") != signal.count("]"):
        raise BagError(
            f"'{text}' is not signal=column, e.g. /joint_states:position[name=elbow]=angle"
        )
    path = SignalPath.parse(signal.strip())
    if path.every:
        raise BagError(f"'{text}': name one element for one column")
    return path, column.strip()


def _every_column(titles: Iterable[str], time: str | None) -> list[tuple[SignalPath, str]]:
    """All but the times, each as the number of a topic called as the column is."""
    times = _unit_of(time or "")[0]
    words = {title: re.findall("[A-Za-z0-9]+", title) for title in titles if title != times}
    named = {title: re.sub("^(?![A-Za-z])", "column_", "_".join(words[title])) for title in words}
    if len(set(named.values())) < len(named):
        raise BagError(f"two of {listed(named)} make one topic: name them, -s /NAME:data=COLUMN")
    return [(SignalPath.parse(f"/{name}:data"), title) for title, name in named.items()]


def import_table(
    file: Path | str,
    out: Path | str,
    assignments: Sequence[str],
    *,
    types: Mapping[str, str],
    rows: Rows,
    custom: Mapping[str, str] | None = None,
) -> Imported:
    """Write a bag with one message a row.

    Header stamp, log time and publish time are equal. What is not assigned is zero or empty.

    Args:
        file: the table.
        out: the bag.
        assignments: `signal=column` each; none: every column but the times is a topic's number.
        types: topic -> message type, a standard one; a number where only `topic:data` is assigned.
        rows: when the rows were recorded; without a period or a column, by the one named as time.
        custom: key-value pairs of the bag's own.

    Returns:
        How many messages there are, and how the times were understood.

    Raises:
        BagError, DataError: for what does not fit, and if `out` exists.
    """
    tables = read_table(file)
    if rows.period is None and rows.time is None:
        rows = replace(rows, time=next(filter(_IS_TIME.fullmatch, tables), None))
    if (rows.period is None) == (rows.time is None):
        raise BagError(
            "state either the period of the rows (--period) or the column with their times "
            f"(--time); there are: {listed(tables)}"
        )
    topics: dict[str, dict[SignalPath, FloatArray]] = {}
    assigned = list(map(_assigned, assignments)) or _every_column(tables, rows.time)
    for path, column in assigned:
        topics.setdefault(path.topic, {})[path] = _column(tables, column)
    if unknown := set(types) - set(topics):
        raise BagError(f"nothing is assigned to {min(unknown)}, for which a type is given")
    if not topics:
        raise BagError(f"{file} has no column of numbers but '{rows.time}'")
    times, unit = _times(tables, rows)
    stamps = _stamps(times, round(rows.start * 1e9))
    streams = []
    for topic, columns in topics.items():
        is_number = [str(path) for path in columns] == [f"{topic}:data"]
        msgtype = types.get(topic, NUMBER if is_number else "")
        if not msgtype:
            raise BagError(
                f"no type for {topic}; state it, e.g. --type {topic}=sensor_msgs/msg/JointState"
            )
        streams.append(_Stream(topic, msgtype, columns))
    said = _said_times(times, rows, unit)
    with whole_bag(out, custom=custom) as writer:
        for row, stamp in enumerate(stamps.tolist()):
            for stream in streams:
                data = stream.message(row, stamp)
                times_ns = {"log_time_ns": stamp, "publish_time_ns": stamp}
                writer.write(stream.topic, stream.msgtype, data, **times_ns)
        return Imported(dict(writer.counts), said)


def _unit_of(time: str) -> tuple[str, str]:
    """The column, and the unit that stands behind it or in its title; empty if none does."""
    if match := _TIME.fullmatch(time):
        return match["column"], match["unit"]
    match = _TITLE.fullmatch(time)
    unit = "" if match is None else match["a"] or match["b"]
    return time, unit if unit in UNITS and UNITS[unit].kind == "time" else ""


def _times(tables: Mapping[str, FloatArray], rows: Rows) -> tuple[FloatArray, str]:
    """Times of the rows in s, and the unit that the column has them in.

    Raises DataError for times that may well be in another unit than s.
    """
    if rows.time is None:
        assert rows.period is not None
        if not rows.period > 0:
            raise DataError(f"a period of {rows.period:g} s")
        return np.arange(len(next(iter(tables.values())))) * rows.period, "s"
    name, unit = _unit_of(rows.time)
    times = _column(tables, name)
    if len(unknown := np.flatnonzero(~np.isfinite(times))):
        raise DataError(f"no time in row {unknown[0]} ({len(unknown)} such rows)")
    since_1970 = [unit for unit, least in EPOCHS.items() if len(times) and times[0] >= least]
    found = unit or (since_1970[0] if since_1970 else "s")
    seconds: FloatArray = times * UNITS[found].scale
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    if step >= SLOW and not unit and not since_1970:
        raise DataError(
            f"the times of '{name}' are {step:g} apart, {len(times)} rows over "
            f"{np.ptp(times):g}: say which unit they are in, --time '{name}|unit(ms)' or "
            f"'{name}|unit(s)'; known are s, ms, us and ns"
        )
    return seconds, found


def _said_times(seconds: FloatArray, rows: Rows, unit: str) -> str:
    duration = float(np.ptp(seconds)) if len(seconds) else 0.0
    by = "" if rows.time is None else f" by the column {_unit_of(rows.time)[0]}, taken as {unit}"
    rate = f", {(len(seconds) - 1) / duration:.4g} Hz" if duration > 0 else ""
    return f"{len(seconds)} rows over {duration:.4g} s{rate}{by}"


class _Stream:
    """The messages of one topic, made row by row from one template."""

    def __init__(self, topic: str, msgtype: str, columns: Mapping[SignalPath, FloatArray]) -> None:
        store = standard_types()
        if msgtype not in store.types:
            raise BagError(
                f"'{msgtype}' is no ROS 2 Jazzy common interface, which a table is imported as"
                f"{did_you_mean(msgtype, store.types)}"
            )
        for path in columns:
            path.check(msgtype, store)
        self.topic, self.msgtype = topic, msgtype
        self._columns = columns
        self._stamped = is_stamped(msgtype, store)
        kind = store.get_msgdef(msgtype)
        zeros = memoryview(bytes(LARGEST))  # in ROS 1 an empty string, too, is zeros
        self._message, _ = kind.deserialize_ros1(zeros, 0, kind.cls, store)
        for path in columns:
            _make_room(self._message, path.steps)

    def message(self, row: int, stamp: int) -> bytes:
        if self._stamped:
            header: Any = self._message
            header.header.stamp.sec, header.header.stamp.nanosec = divmod(stamp, 10**9)
        for path, column in self._columns.items():
            path.assign(self._message, float(column[row]))
        return bytes(standard_types().serialize_cdr(self._message, self.msgtype))


def _stamps(times: FloatArray, start_ns: int) -> IntArray:
    """Times in s as stamps; DataError for those that no message can have."""
    seconds = start_ns / 1e9 + times
    if len(wrong := np.flatnonzero((seconds < 0) | (seconds >= STAMP_SECONDS))):
        first = seconds[wrong[0]]
        remedy = "name the column's unit, --time 'column|unit(ms)', or another --start"
        if first < 0:
            later = start_ns / 1e9 + math.ceil(-float(np.min(seconds)))
            remedy = f"--start {later:.0f} moves all times to after 0"
        raise DataError(
            f"the time of row {wrong[0]} is {first:.15g} s since 1970 ({len(wrong)} such rows); "
            f"stamps go from 0 to {STAMP_SECONDS} s: {remedy}"
        )
    stamps: IntArray = start_ns + np.rint(times * 1e9).astype(np.int64)
    if len(back := np.flatnonzero(np.diff(stamps) <= 0)):
        raise DataError(
            f"time does not increase after row {back[0]}: {stamp_text(stamps[back[0]])} "
            f"({len(back)} such rows); keep one of the rows with one time"
        )
    return stamps


def _make_room(message: Any, steps: Sequence[Step]) -> None:
    """Let the array at the end of the way be long enough, and have the named element."""
    *outer, last = steps
    for step in outer:
        if step.picks:
            raise BagError(f"'{step.field}': elements that are messages cannot be imported")
        message = getattr(message, step.field)
    array = getattr(message, last.field)
    needed = 0 if last.index is None else last.index + 1
    if last.key is not None:
        names = getattr(message, last.key[0])
        if last.key[1] not in names:
            names.append(last.key[1])
        needed = len(names)
    if isinstance(array, np.ndarray) and len(array) < needed:
        setattr(message, last.field, np.pad(array, (0, needed - len(array))))
