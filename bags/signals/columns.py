"""Signals of a bag as columns, topic by topic, in bounded memory.

`TopicReader` turns as many messages at once as a chunk holds; `read_columns` puts the parts
together. Memory: one chunk and its index, and what is returned.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch, LogOrder
from bags.recordings.cdr import STAMP, Gatherer, Numbers, Step, UnreadableMessageError
from bags.recordings.message_types import decode, is_stamped
from bags.signals.publishers import counted_in_turn, two_curves
from bags.signals.signal import SignalPath
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

MAX_ANNOUNCED: Final = 2**22  # messages; a bag's counts are not trusted with more memory at once


@dataclass(frozen=True, eq=False)
class Columns:
    """Signals of one topic over N messages.

    log_ns, publish_ns: (N,) ns. back: where log times go back inside a file (`LogOrder`).
    stamp_ns: (N,) ns, the header's stamps; None without a header.
    values: signal -> (N,), in the message's unit, and of its type of number. sequence: (N,) as the
    recorder counted them.
    """

    topic: str
    log_ns: IntArray
    publish_ns: IntArray
    stamp_ns: IntArray | None
    values: Mapping[str, Numbers]
    sequence: IntArray
    back: Sequence[tuple[int, int, int]] = ()

    def __len__(self) -> int:
        return len(self.log_ns)

    def doubt(self, name: str, *, responds: bool) -> str:
        """Say why the messages that have a signal are of several publishers; else empty.

        A message of other transforms has it not. responds: whether the signal is measured; a
        command may jump as it likes.
        """
        if len(self.back):
            return ""  # a clock was set, and what is here is not in the order in which it came
        values = np.asarray(self.values[name], dtype=np.float64)
        has = np.isfinite(values)
        stamps = self.log_ns if self.stamp_ns is None else self.stamp_ns
        said = counted_in_turn(self.sequence[has])
        return said or (two_curves(stamps[has], values[has]) if responds else "")

    def select(self, rows: IntArray | slice) -> "Columns":
        """The messages `rows`."""
        return replace(
            self,
            log_ns=self.log_ns[rows],
            publish_ns=self.publish_ns[rows],
            stamp_ns=None if self.stamp_ns is None else self.stamp_ns[rows],
            values={name: values[rows] for name, values in self.values.items()},
            sequence=self.sequence[rows],
        )


def joined_columns(parts: Sequence[Columns]) -> Columns:
    """The messages of several parts of one topic, one part behind the other."""
    first = parts[0]
    stamps = [part.stamp_ns for part in parts if part.stamp_ns is not None]
    return replace(
        first,
        log_ns=np.concatenate([part.log_ns for part in parts]),
        publish_ns=np.concatenate([part.publish_ns for part in parts]),
        stamp_ns=np.concatenate(stamps) if stamps else None,
        values={name: np.concatenate([p.values[name] for p in parts]) for name in first.values},
        sequence=np.concatenate([part.sequence for part in parts]),
    )


def read_columns(
    bag: Bag, signals: Mapping[str, SignalPath], *, progress: Progress = silent
) -> dict[str, Columns]:
    """Topic -> its signals over the whole bag, by log time; equal log times as recorded.

    `signals`: the name a column gets -> where it is; none of them with `[*]` (see `expand_path`).
    All are checked against the types in the bag before a message is read. A topic without messages
    gives columns of length 0. Raises BagError where `signals` or the bag are wrong.
    """
    topics: dict[str, dict[str, SignalPath]] = {}
    for name, signal in signals.items():
        check_path(bag, signal)
        topics.setdefault(signal.topic, {})[name] = signal
    readers = {topic: TopicReader(bag, topic, wanted) for topic, wanted in topics.items()}
    growing = {topic: _Growing(bag, topic, list(wanted)) for topic, wanted in topics.items()}
    for channel, batch in bag.batches(list(readers), progress=progress):
        growing[channel.topic].append(channel.key, readers[channel.topic].read(batch))
    return {topic: growing.pop(topic).columns() for topic in topics}


def expand_path(bag: Bag, path: SignalPath) -> list[SignalPath]:
    """The path, with `[*]` the elements that the topic's first message has.

    Raises BagError if it does not fit the topic's type, or if there is no message to count in.
    """
    check_path(bag, path)
    if not path.every:
        return [path]
    first = next((batch for _, batch in bag.batches([path.topic])), None)
    if first is None:
        raise BagError(f"{bag.path}: {path.topic} has no messages, so [*] stands for nothing")
    return path.expand(decode(first.data(0), *bag.types_on(path.topic)))


class TopicReader:
    """Turns batches of one topic into columns; the signals are known to be on it."""

    def __init__(self, bag: Bag, topic: str, signals: Mapping[str, SignalPath]) -> None:
        msgtype, types = bag.types_on(topic)
        self._where = f"{bag.path}: {topic}"
        self._topic = topic
        self._signals = signals
        self._stamped = is_stamped(msgtype, types)
        self._done = 0
        self._kind = msgtype, types
        self._targets = {n: s.targets(msgtype, types) for n, s in signals.items() if not s.framed}
        targets: list[tuple[Step, ...]] = list(STAMP) if self._stamped else []
        targets += [target for group in self._targets.values() for target in group]
        self._gatherer = Gatherer(msgtype, types, targets)

    def read(self, batch: Batch) -> Columns:
        """The columns of a batch; BagError if a message cannot be read or an array changed."""
        try:
            numbers = self._gatherer.gather(batch)
        except UnreadableMessageError as error:
            raise BagError(
                f"{self._where}: message {self._done + error.row} cannot be read: {error}"
            ) from error
        self._done += len(batch)
        at = len(STAMP) if self._stamped else 0
        stamp_ns = None
        if self._stamped:
            stamp_ns = numbers[0].astype(np.int64) * 10**9 + numbers[1].astype(np.int64)
        values: dict[str, Numbers] = {}
        values |= {name: self._framed(batch, s) for name, s in self._signals.items() if s.framed}
        for name, group in self._targets.items():
            values[name] = self._signals[name].combine(numbers[at : at + len(group)])
            at += len(group)
        return Columns(
            self._topic, batch.log_ns, batch.publish_ns, stamp_ns, values, batch.sequence
        )

    def _framed(self, batch: Batch, signal: SignalPath) -> FloatArray:
        """Read by decoding: which message of an array is meant differs from message to message."""
        try:
            found = [signal.value(decode(batch.data(k), *self._kind)) for k in range(len(batch))]
        except BagError as error:
            raise BagError(f"{self._where}: {error}") from error
        return np.array(found)


def check_path(bag: Bag, path: SignalPath) -> None:
    """Raise a BagError that names the bag unless its messages have a number at `path`."""
    try:
        path.check(*bag.types_on(path.topic))
    except BagError as error:
        message = str(error)
        raise BagError(message if str(bag.path) in message else f"{bag.path}: {error}") from error


class _Growing:
    """One topic's columns while they are read: memory for what the bag announces, within reason."""

    def __init__(self, bag: Bag, topic: str, names: Sequence[str]) -> None:
        announced = sum(channel.count for channel in bag.channels if channel.topic == topic)
        capacity = min(announced, MAX_ANNOUNCED)
        self._topic = topic
        self._names = names
        self._stamped = is_stamped(*bag.types_on(topic))
        self._times = np.empty((4 if self._stamped else 3, capacity), dtype=np.int64)
        self._values = np.empty((len(names), capacity))
        self._length = 0
        self._order = LogOrder()

    def append(self, channel: int, part: Columns) -> None:
        self._order.add(channel, part.log_ns)
        start, self._length = self._length, self._length + len(part)
        if self._length > self._times.shape[1]:
            more = max(self._length, 2 * self._times.shape[1]) - start
            self._times = np.pad(self._times[:, :start], ((0, 0), (0, more)))
            self._values = np.pad(self._values[:, :start], ((0, 0), (0, more)))
        here = slice(start, self._length)
        self._times[:3, here] = part.log_ns, part.publish_ns, part.sequence
        if part.stamp_ns is not None:
            self._times[3, here] = part.stamp_ns
        for row, name in enumerate(self._names):
            self._values[row, here] = part.values[name]

    def columns(self) -> Columns:
        """Sort by log time; the sort is stable, so equal log times stay as recorded."""
        times, values = self._times[:, : self._length], self._values[:, : self._length]
        if (np.diff(times[0]) < 0).any():
            order = np.argsort(times[0], kind="stable")
            times, values = times[:, order], values[:, order]
        return Columns(
            self._topic,
            times[0],
            times[1],
            times[3] if self._stamped else None,
            dict(zip(self._names, values, strict=True)),
            times[2],
            self._order.back,
        )
