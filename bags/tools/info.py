"""What is in a bag: topics, rates, jitter, gaps, clocks, losses, sizes.

Memory: two integers a message, and one chunk.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch
from bags.recordings.cdr import Gatherer, UnreadableMessageError
from bags.recordings.definitions import Definition
from bags.recordings.message_types import is_stamped
from bags.signals.arrivals import SOON
from bags.signals.columns import STAMP
from bags.signals.timing import ClockRelation, clock_relation
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

GAP: Final = 5.0  # median intervals without a message
BINS: Final = np.array([0.0, 0.5, 0.8, 0.95, 1.05, 1.25, 2.0, 5.0, np.inf])  # median intervals
BARS: Final = " ▁▂▃▄▅▆▇█"
LOST: Final = " lost"  # how the recorder's counts of lost messages end, after the topic


@dataclass(frozen=True)
class LogTimes:
    """When messages were logged, in ns; of the intervals, in s, NaN with fewer than two messages.

    interval: the median. histogram: intervals per bin of BINS, which are in median intervals.
    """

    first_ns: int = 0
    last_ns: int = 0
    interval: float = float("nan")
    histogram: tuple[int, ...] = ()
    gaps: int = 0
    longest: float = float("nan")

    @property
    def rate(self) -> float:
        """Hz, from the median interval."""
        return 1.0 / self.interval if self.interval > 0 else float("nan")

    @property
    def jitter(self) -> str:
        """The histogram as a line of bars, from half the median interval to five times it."""
        most = max(self.histogram, default=0)
        if not most:
            return ""
        height = [np.ceil((len(BARS) - 1) * n / most) for n in self.histogram]
        return "".join(BARS[int(h)] for h in height)


@dataclass(frozen=True)
class Stamps:
    """Header stamps: how often they go back, and repeat; clock: None if all are 0."""

    backward: int
    duplicates: int
    clock: ClockRelation | None


@dataclass(frozen=True, eq=False)
class TopicInfo:
    """One topic. stamps: None without headers, or if they cannot be read.

    missing: sequence numbers left out, None where nobody counted.
    """

    topic: str
    msgtype: str
    count: int
    size: int
    times: LogTimes = LogTimes()
    stamps: Stamps | None = None
    missing: int | None = None
    unreadable: str = ""

    @property
    def odd(self) -> list[str]:
        """What is wrong with its messages and stamps, in words."""
        odd = []
        if self.stamps is not None and self.stamps.clock is None:
            odd.append("every header stamp is 0: its publisher does not fill it in; use log time")
        elif self.stamps is not None:
            if self.stamps.backward:
                odd.append(f"header stamps go back in {self.stamps.backward} places")
            if self.stamps.duplicates:
                odd.append(f"{self.stamps.duplicates} header stamps repeat the one before")
        if self.missing:
            odd.append(f"{self.missing} sequence numbers are missing: messages were lost")
        if self.unreadable:
            odd.append(f"cannot be read: {self.unreadable[:300]}")
        return odd


@dataclass(frozen=True, eq=False)
class BagInfo:
    """A bag and its topics. ending: why it stops early, None if it is whole.

    notes: where what it states and what is there differ, and records that are no messages.
    """

    path: Path
    files: int
    size: int
    ending: str | None
    custom: Mapping[str, str]
    topics: tuple[TopicInfo, ...]
    notes: tuple[str, ...] = ()

    def lost(self, topic: TopicInfo) -> int | None:
        """Messages lost, by the recorder's count or sequence numbers; None if neither counts."""
        said = self.custom.get(topic.topic + LOST, "")
        if said and not said.isdecimal():
            return None  # of several publishers
        counts = [int(said)] if said else []
        counts += [] if topic.missing is None else [topic.missing]
        return max(counts, default=None)

    @property
    def messages(self) -> int:
        """On all topics."""
        return sum(topic.count for topic in self.topics)

    @property
    def duration(self) -> float:
        """s from the first to the last log time."""
        filled = [topic for topic in self.topics if topic.count]
        if not filled:
            return 0.0
        first = min(topic.times.first_ns for topic in filled)
        last = max(topic.times.last_ns for topic in filled)
        return (last - first) / 1e9


def bag_info(
    path: Path | str,
    *,
    topics: Collection[str] | None = None,
    definitions: Mapping[str, Definition] | None = None,
    progress: Progress = silent,
) -> BagInfo:
    """Read the whole bag once, or these topics; an unfinished one as far as it goes.

    Raises BagError as `Bag` does.
    """
    with Bag(path, unfinished=True, definitions=definitions) as bag:
        found = {
            topic: _Collector(bag, topic, msgtype)
            for topic, msgtype in bag.topics.items()
            if topics is None or topic in topics
        }
        for channel, batch in bag.batches(list(found), progress=progress):
            found[channel.topic].add(batch, bag.strand(channel))
        return BagInfo(
            path=bag.path,
            files=len(bag.files),
            size=sum(file.stat().st_size for file in bag.files),
            ending=bag.ending,
            custom=bag.custom,
            topics=tuple(collector.info() for collector in found.values()),
            notes=(*bag.lost, *bag.disagreements),
        )


@dataclass
class _Collector:
    bag: Bag
    topic: str
    msgtype: str
    size: int = 0
    log_ns: list[IntArray] = field(default_factory=list)
    stamp_ns: list[IntArray] = field(default_factory=list)
    sequence: dict[int, list[IntArray]] = field(default_factory=dict)
    unreadable: str = ""

    def __post_init__(self) -> None:
        self._gatherer: Gatherer | None = None
        try:
            msgtype, types = self.bag.types_on(self.topic)
            if is_stamped(msgtype, types):
                self._gatherer = Gatherer(msgtype, types, STAMP)
        except BagError as error:
            self.unreadable = str(error)

    def add(self, batch: Batch, strand: int) -> None:
        self.size += int(batch.size.sum())
        self.log_ns.append(batch.log_ns)
        self.sequence.setdefault(strand, []).append(batch.sequence)
        if batch.unreadable and not self.unreadable:
            self.unreadable = next(iter(batch.unreadable.values()))
            self._gatherer = None
        if self._gatherer is None:
            return
        try:
            seconds, nanoseconds = (n.astype(np.int64) for n in self._gatherer.gather(batch))
        except UnreadableMessageError as error:
            self.unreadable, self._gatherer = str(error), None
            return
        self.stamp_ns.append(seconds * 10**9 + nanoseconds)

    def info(self) -> TopicInfo:
        count = sum(map(len, self.log_ns))
        if not count:
            return TopicInfo(self.topic, self.msgtype, 0, self.size, unreadable=self.unreadable)
        log_ns = np.concatenate(self.log_ns)
        order = np.argsort(log_ns, kind="stable")
        log_ns = log_ns[order]
        counted = [missing(np.concatenate(parts)) for parts in self.sequence.values()]
        known = [count for count in counted if count is not None]
        stamps = None
        if self._gatherer is not None:
            stamps = _stamps(np.concatenate(self.stamp_ns)[order], log_ns)
        return TopicInfo(
            self.topic,
            self.msgtype,
            count,
            self.size,
            _log_times(log_ns),
            stamps,
            sum(known) if known else None,
            self.unreadable,
        )


def _log_times(log_ns: IntArray) -> LogTimes:
    """What log times (N,) show, ascending, N > 0."""
    first_ns, last_ns = int(log_ns[0]), int(log_ns[-1])
    if len(log_ns) == 1:
        return LogTimes(first_ns, last_ns)
    intervals = np.diff(log_ns) / 1e9
    median = float(np.median(intervals))
    scale = median if median > 0 else float(np.max(intervals)) or 1.0
    return LogTimes(
        first_ns,
        last_ns,
        median,
        tuple(np.histogram(intervals / scale, BINS)[0].tolist()),
        int((intervals > GAP * scale).sum()),
        float(np.max(intervals)),
    )


def _stamps(stamp_ns: IntArray, log_ns: IntArray) -> Stamps:
    steps = np.diff(stamp_ns)
    clock = clock_relation(stamp_ns, log_ns) if stamp_ns.any() else None
    return Stamps(int((steps < 0).sum()), int((steps == 0).sum()), clock)


def missing(sequence: IntArray) -> int | None:
    """Numbers left out by a recorder that counted up from message to message; None otherwise.

    A publisher that came back counts anew: far below, and then for itself.
    """
    counts = [np.diff(np.sort(part)) for part in np.split(sequence, anew(sequence))]
    steps = np.concatenate(counts)
    if not len(steps) or not (steps == 1).sum() > 0.5 * len(steps):
        return None
    return int(np.maximum(steps - 1, 0).sum())


def anew(sequence: IntArray) -> IntArray:
    """Where a count goes back by more than messages overtake each other."""
    return np.flatnonzero(np.diff(sequence) < -SOON) + 1
