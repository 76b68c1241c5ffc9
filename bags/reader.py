"""Read signals from a bag: numbers with the stamps of the messages they came in."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bags.bag import Bag, Message
from bags.message_types import decode, header_stamp_ns, is_stamped
from bags.signals import SignalPath
from nlsid_core._types import FloatArray, IntArray
from nlsid_core.errors import BagError

HEADER_STAMP: Final = "header stamp"
LOG_TIME: Final = "log time"


@dataclass(frozen=True, eq=False)
class Samples:
    """A signal as recorded; arrays are read-only.

    stamp_ns: (N,) ns since the epoch, not decreasing. values: (N,) finite, in the message's unit.
    clock: where the stamps come from, HEADER_STAMP, or LOG_TIME if the type has no header.
    """

    path: str
    stamp_ns: IntArray
    values: FloatArray
    clock: str = HEADER_STAMP

    def __post_init__(self) -> None:
        self.stamp_ns.setflags(write=False)
        self.values.setflags(write=False)

    def __len__(self) -> int:
        return len(self.stamp_ns)


def read_signals(bag: Path | str, paths: Sequence[str]) -> dict[str, Samples]:
    """The signals `paths` (`topic:field.path[index]`) of a rosbag2 folder or an .mcap file.

    Every path is checked against the types in the bag before a message is read. Raises BagError,
    naming the bag, if the bag is missing, unfinished or damaged; if a topic or field does not
    exist or is no number; if a topic has no messages; if a value is not finite or time goes back.
    """
    with Bag(bag) as source:
        signals = {path: SignalPath.parse(path) for path in paths}
        topics: dict[str, _Topic] = {}
        for path, signal in signals.items():
            if signal.topic not in topics:
                topics[signal.topic] = _Topic(source, signal.topic)
            topics[signal.topic].add(path, signal)
        for message in source.messages(list(topics)):
            topics[message.topic].read(message)
        for topic in topics.values():
            topic.check_stamps(source.count(topic.name))
    return {path: topics[signal.topic].samples(path) for path, signal in signals.items()}


def bag_digest(bag: Path | str) -> str:
    """`sha256:<hex>` of the bag's data file (of its data files, joined in the order of names)."""
    with Bag(bag) as source:
        digest = hashlib.sha256()
        for file in source.files:
            with file.open("rb") as stream:
                while block := stream.read(2**20):
                    digest.update(block)
    return f"sha256:{digest.hexdigest()}"


def bag_metadata(bag: Path | str) -> dict[str, str]:
    """The bag's own key-value pairs (`custom_data`); empty if it has none. BagError as above."""
    with Bag(bag) as source:
        return source.custom


def stamp_text(stamp_ns: int) -> str:
    """A stamp for people: seconds with all nine decimals."""
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(stamp_ns) // 10**9}.{abs(stamp_ns) % 10**9:09d} s"


class _Topic:
    """The signals asked for on one topic, filled message by message."""

    def __init__(self, source: Bag, name: str) -> None:
        self.name = name
        self._where = f"{source.path}: {name}"
        self._bag = source.path
        self._msgtype, self._types = source.types_on(name)
        self._clock = HEADER_STAMP if is_stamped(self._msgtype, self._types) else LOG_TIME
        self._signals: dict[str, SignalPath] = {}
        self._columns: dict[str, list[float]] = {}
        self._stamps: list[int] = []

    def add(self, path: str, signal: SignalPath) -> None:
        try:
            signal.check(self._msgtype, self._types)
        except BagError as error:
            raise BagError(f"{self._bag}: {error}") from error
        self._signals[path] = signal
        self._columns[path] = []

    def read(self, message: Message) -> None:
        try:
            stamped = self._clock == HEADER_STAMP
            stamp = header_stamp_ns(message.data) if stamped else message.log_time_ns
            decoded = decode(message.data, self._msgtype, self._types)
            for path, signal in self._signals.items():
                self._columns[path].append(signal.value(decoded))
        except BagError as error:
            raise BagError(
                f"{self._where}: message {len(self._stamps)} cannot be read: {error}"
            ) from error
        self._stamps.append(stamp)

    def check_stamps(self, expected: int) -> None:
        stamps = self._stamps
        if len(stamps) != expected:
            raise BagError(
                f"{self._where} has {len(stamps)} messages, the bag's index says {expected}; "
                "the bag is damaged"
            )
        if not stamps:
            raise BagError(f"{self._where} has no messages; was its publisher running?")
        if self._clock == HEADER_STAMP and not any(stamps):
            raise BagError(
                f"{self._where}: every header stamp is 0; its publisher does not fill it in"
            )
        steps = np.diff(np.array(stamps, dtype=np.int64))
        if len(back := np.flatnonzero(steps < 0)):
            i = int(back[0])
            raise BagError(
                f"{self._where}: time goes back by {-int(steps[i]) / 1e9:g} s at message {i + 1}: "
                f"{self._clock} {stamp_text(stamps[i])}, then {stamp_text(stamps[i + 1])} "
                f"({len(back)} such {'place' if len(back) == 1 else 'places'})"
            )

    def samples(self, path: str) -> Samples:
        values = np.array(self._columns[path], dtype=np.float64)
        if len(bad := np.flatnonzero(~np.isfinite(values))):
            i = int(bad[0])
            raise BagError(
                f"{self._bag}: {path} is {values[i]} in message {i} at "
                f"{stamp_text(self._stamps[i])} ({len(bad)} of {len(values)} messages "
                "are not finite); record it again or cut the bag there"
            )
        return Samples(path, np.array(self._stamps, dtype=np.int64), values, self._clock)
