"""What is in a bag: topics, rates, jitter, gaps; and of its messages clocks, losses and sizes.

The first is read from summaries and indexes where there are some, in 8 bytes a message; the second
from every message, in two more integers each and one chunk.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch
from bags.recordings.cdr import STAMP, Gatherer, UnreadableMessageError
from bags.recordings.definitions import Definition
from bags.recordings.message_types import is_stamped
from bags.recordings.quality import Profile
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import BagError, counted
from nlsid_core.progress import Progress, silent

if TYPE_CHECKING:
    from bags.signals.timing import ClockRelation

GAP: Final = 5.0  # median intervals without a message
LOST: Final = " lost"  # how the recorder's counts of lost messages end, after the topic


class LogTimes(NamedTuple):
    """When messages were logged, in ns; of the intervals, in s, NaN with fewer than two messages.

    rate: Hz, how many intervals there are by how long they last together. interval: the median.
    jitter: s, by which 95 % of them differ from it at most. gaps: intervals above GAP medians.
    """

    first_ns: int = 0
    last_ns: int = 0
    rate: float = float("nan")
    interval: float = float("nan")
    jitter: float = float("nan")
    gaps: int = 0
    longest: float = float("nan")


@dataclass(frozen=True)
class Stamps:
    """Header stamps: how often they go back, and repeat; clock: None if all are 0."""

    backward: int
    duplicates: int
    clock: "ClockRelation | None"


@dataclass(frozen=True, eq=False)
class Messages:
    """What the messages of a topic say. size: bytes. stamps: None without headers.

    missing: sequence numbers left out, None where nobody counted. unreadable: why some cannot be
    read; empty if all can.
    """

    size: int = 0
    stamps: Stamps | None = None
    missing: int | None = None
    unreadable: str = ""

    @property
    def odd(self) -> list[str]:
        """What is wrong with them and with their stamps, in words."""
        stamps = self.stamps or Stamps(0, 0, None)
        is_zero = self.stamps is not None and stamps.clock is None
        odd = {
            "every header stamp is 0: its publisher does not fill it in; use log time": is_zero,
            f"header stamps go back in {counted(stamps.backward, 'place')}": stamps.backward,
            f"{stamps.duplicates} header stamps repeat the one before": (
                stamps.duplicates and not is_zero
            ),
            f"{self.missing} sequence numbers are missing: messages were lost": self.missing,
            f"cannot be read: {self.unreadable[:300]}": self.unreadable,
        }
        return [text for text, holds in odd.items() if holds]


@dataclass(frozen=True, eq=False)
class TopicInfo:
    """One topic. offered: by its publishers. messages: None if they were not read."""

    topic: str
    msgtype: str
    count: int
    times: LogTimes
    offered: tuple[Profile, ...] = ()
    messages: Messages | None = None


@dataclass(frozen=True, eq=False)
class BagInfo:
    """A bag and its topics. ending: why it stops early, None if it is whole.

    made: storage, compression and release of ROS 2, as far as it says them. notes: where what it
    states and what is there differ, and records that are no messages.
    """

    path: Path
    files: int
    size: int
    ending: str | None
    made: Mapping[str, str]
    custom: Mapping[str, str]
    topics: tuple[TopicInfo, ...]
    notes: tuple[str, ...] = ()

    @property
    def messages(self) -> int:
        """On all topics."""
        return sum(topic.count for topic in self.topics)

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first and the last log time; zeros without a message."""
        ends = [(t.times.first_ns, t.times.last_ns) for t in self.topics if t.count]
        firsts, lasts = zip(*ends or [(0, 0)], strict=True)
        return min(firsts), max(lasts)


def bag_info(
    path: Path | str,
    *,
    messages: bool = False,
    topics: Collection[str] | None = None,
    definitions: Mapping[str, Definition] | None = None,
    progress: Progress = silent,
) -> BagInfo:
    """Look into a bag; into an unfinished one as far as it goes.

    Args:
        path: where it is.
        messages: read every message, too.
        topics: only these (None: all).
        definitions: of message types that the bag does not define.
        progress: told how far it is.

    Raises:
        BagError: as `Bag`.
    """
    with Bag(path, unfinished=True, definitions=definitions) as bag:
        wanted = [topic for topic in bag.topics if topics is None or topic in topics]
        looked: dict[str, _Collector] = {}
        times: dict[str, list[IntArray]] = {topic: [] for topic in wanted}
        if messages:
            looked = {topic: _Collector(bag, topic) for topic in wanted}
            for channel, batch in bag.batches(wanted, progress=progress):
                looked[channel.topic].add(batch, bag.strands[channel.key])
                times[channel.topic].append(batch.log_ns)
        else:
            for topic, log_ns in bag.log_times(wanted):
                times[topic].append(log_ns)
        found = []
        for topic, parts in times.items():
            log_ns = np.concatenate([np.empty(0, np.int64), *parts])
            order = np.argsort(log_ns, kind="stable")
            log_ns = log_ns[order]
            said = looked[topic].messages(order, log_ns) if messages else None
            found.append(
                TopicInfo(
                    topic,
                    bag.topics[topic],
                    len(log_ns),
                    _log_times(log_ns),
                    bag.offered(topic),
                    said,
                )
            )
        return BagInfo(
            path=bag.path,
            files=len(bag.files),
            size=sum(file.stat().st_size for file in bag.files),
            ending=bag.ending,
            made={
                **{name: ", ".join(found_in) for name, found_in in bag.kinds.items()},
                "ros_distro": bag.release,
            },
            custom=bag.custom,
            topics=tuple(found),
            notes=(*bag.lost, *bag.disagreements),
        )


@dataclass
class _Collector:
    bag: Bag
    topic: str
    size: int = 0
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

    def messages(self, order: IntArray, log_ns: IntArray) -> Messages:
        """What was found; order: of the messages by their log times."""
        from bags.signals.timing import missing  # only where messages are read

        counted = [missing(np.concatenate(parts)) for parts in self.sequence.values()]
        known = [count for count in counted if count is not None]
        stamps = None
        if self._gatherer is not None and len(log_ns):
            stamps = _stamps(np.concatenate(self.stamp_ns)[order], log_ns)
        return Messages(self.size, stamps, sum(known) if known else None, self.unreadable)


def _log_times(log_ns: IntArray) -> LogTimes:
    """What log times (N,) show, ascending."""
    if not len(log_ns):
        return LogTimes()
    first_ns, last_ns = int(log_ns[0]), int(log_ns[-1])
    if len(log_ns) == 1:
        return LogTimes(first_ns, last_ns)
    intervals = np.diff(log_ns) / 1e9
    median = _quantile(intervals, 0.5)
    scale = median if median > 0 else float(np.max(intervals)) or 1.0
    return LogTimes(
        first_ns,
        last_ns,
        1e9 * len(intervals) / (last_ns - first_ns) if last_ns > first_ns else float("nan"),
        median,
        _quantile(np.abs(intervals - median), 0.95),
        int((intervals > GAP * scale).sum()),
        float(np.max(intervals)),
    )


def _quantile(values: FloatArray, share: float) -> float:
    """As np.quantile, which imports a slow part of NumPy."""
    return float(np.interp(share * (len(values) - 1), np.arange(len(values)), np.sort(values)))


def _stamps(stamp_ns: IntArray, log_ns: IntArray) -> Stamps:
    from bags.signals.timing import clock_relation

    steps = np.diff(stamp_ns)
    clock = clock_relation(stamp_ns, log_ns) if stamp_ns.any() else None
    return Stamps(int((steps < 0).sum()), int((steps == 0).sum()), clock)
