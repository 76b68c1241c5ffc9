"""A bag while it is recorded: when what came on a topic, until it ends or the disk is full, and the
last seconds of it.
"""

import shutil
from bisect import bisect
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile
from bags.recordings.writer import BagWriter, whole_bag
from bags.signals.timing import Sequence

REMEMBERED = 1000  # looks at a clock; a recorder looks 20 times a second
SNAPSHOT: Final = "snapshot"  # the custom datum of a bag of last seconds: how many of them
COUNTED: Final = ("received", "lost")
UNCOUNTED: Final = "lost messages are not counted: several publishers send on it"
UNFINISHED: Final = "; the bag is unfinished and will be repaired when a recorder starts beside it"


class Arrival(NamedTuple):
    """One serialised message as it came; times in ns since the epoch.

    sequence: its publisher's count; None where the middleware does not say it.
    """

    topic: str
    msgtype: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int | None = None


@dataclass
class LogClock:
    """When messages came, in the time of a simulation; between two looks it goes on evenly.

    A message may have waited for many looks, or from before the first: a later one never gets an
    earlier time than it.
    """

    _walls_ns: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _simulated_ns: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    def look(self, wall_ns: int, simulated_ns: int) -> None:
        """At `wall_ns` the simulation's clock is at `simulated_ns`."""
        self._walls_ns.append(wall_ns)
        self._simulated_ns.append(simulated_ns)

    @property
    def goes(self) -> bool:
        """Whether it was looked at twice, so that its pace is known."""
        return len(self._walls_ns) > 1

    def at(self, wall_ns: int) -> int:
        """The simulated time at `wall_ns`, in ns; the wall's where no clock was looked at."""
        if not self.goes:
            return self._simulated_ns[0] if self._simulated_ns else wall_ns
        later = max(bisect(self._walls_ns, wall_ns, hi=len(self._walls_ns) - 1), 1)
        first, last = self._walls_ns[later - 1], self._walls_ns[later]
        begun, now = self._simulated_ns[later - 1], self._simulated_ns[later]
        gone = (now - begun) * (min(wall_ns, last) - first) // max(last - first, 1)
        return max(begun + gone, 0)


@dataclass
class Recent:
    """The arrivals of the last `seconds`, to be kept when something happened."""

    seconds: float
    _arrivals: deque[Arrival] = field(default_factory=deque)

    def add(self, arrival: Arrival) -> None:
        """Remember this one, forget what is too old."""
        self._arrivals.append(arrival)
        oldest = arrival.log_time_ns - round(self.seconds * 1e9)
        while self._arrivals[0].log_time_ns < oldest:
            self._arrivals.popleft()

    def save(
        self,
        path: Path,
        *,
        definitions: Mapping[str, Definition] | None = None,
        offered: Mapping[str, tuple[Profile, ...]] | None = None,
    ) -> int:
        """Write the remembered messages as a bag; return how many. BagError if it exists.

        definitions: of the topics' types by topic; those that are not in it have standard types.
        offered: the quality of service of each topic's publishers, where it is known.
        """
        profiles = offered or {}
        with whole_bag(path, custom={SNAPSHOT: f"{self.seconds:g} s"}) as bag:
            for topic, definition in (definitions or {}).items():
                said = profiles.get(topic, ())
                bag.add_topic(topic, definition.msgtype, definition=definition, offered=said)
            for arrival in self._arrivals:
                said = profiles.get(arrival.topic, ())
                bag.add_topic(arrival.topic, arrival.msgtype, offered=said)
                bag.write(
                    arrival.topic,
                    arrival.msgtype,
                    arrival.data,
                    log_time_ns=arrival.log_time_ns,
                    publish_time_ns=arrival.publish_time_ns,
                    sequence=arrival.sequence,
                )
        return len(self._arrivals)


class Recording:
    """Messages into a bag, and counts of them.

    `ended` says why the recording ended by itself; what came until then is in the bag. No method
    raises an OSError: a recorder that runs on can still keep snapshots and say what happened.
    """

    def __init__(self, bag: BagWriter, *, least_free: float) -> None:
        self.bag = bag
        self.ended = ""
        self._least_free = least_free  # MB
        self._sequence: dict[str, Sequence] = {}
        self._closed = False

    def expect(self, topic: str) -> None:
        """List a topic although nothing is known of it yet."""
        self._sequence.setdefault(topic, Sequence())

    def add_topic(
        self, topic: str, definition: Definition, offered: tuple[Profile, ...] = ()
    ) -> None:
        """Announce a topic and what its publishers offer; BagError if it holds another type."""
        self.expect(topic)
        self.bag.add_topic(topic, definition.msgtype, definition=definition, offered=offered)

    def add(self, arrival: Arrival) -> None:
        """Take a message."""
        if self._closed:
            return
        topic, msgtype, data, log_ns, publish_ns, number = arrival
        if number is not None:
            self._sequence[topic].update(number)
        times = {"log_time_ns": log_ns, "publish_time_ns": publish_ns}
        try:  # at every message: half the time of `_ending`
            self.bag.write(topic, msgtype, data, **times, sequence=number)
        except OSError as error:
            self._end(str(error))

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add to the bag's metadata."""
        if self._closed:
            return
        with self._ending():
            self.bag.annotate(custom)

    def keep_up(self) -> None:
        """Close the chunk, and the bag if it was taken away or the disk is nearly full; to be
        called regularly.
        """
        if self._closed:
            return
        with self._ending():
            self.bag.close_chunk()
            free = shutil.disk_usage(self.bag.path).free / 1e6
            if free < self._least_free:
                self._end(f"{free:.0f} MB left, {self._least_free:g} are to stay free")

    def close(self) -> None:
        """Write the counts into the bag and close it; once."""
        if self._closed:
            return
        self._closed = True
        ended = {"ended": self.ended} if self.ended else {}
        try:
            self.bag.annotate(self.counts() | ended)
            self.bag.close()
        except OSError as error:
            left = UNFINISHED if self.bag.path.exists() else ""
            self.ended = (self.ended or f"recording stopped: {error}") + left
            self.bag.abandon()

    def counts(self) -> dict[str, str]:
        """What came on each topic, in words."""
        values = {}
        for topic, sequence in self._sequence.items():
            values[f"{topic} received"] = str(self.bag.counts.get(topic, 0))
            values[f"{topic} lost"] = UNCOUNTED if sequence.mixed else str(self._lost_on(topic))
        return values

    def summary(self, most: int) -> dict[str, str]:
        """Sum up all topics, and then give a line to each of the `most` that lose most."""
        counts = self.counts()
        lost = {topic: self._lost_on(topic) for topic in self._sequence}
        values = {
            "topics": len(lost),
            "messages": sum(self.bag.counts.values()),
            "lost": sum(lost.values()),
        }
        lines = {
            topic: ", ".join(f"{what} {counts[f'{topic} {what}']}" for what in COUNTED)
            for topic in sorted(lost, key=lambda topic: -lost[topic])[:most]
        }
        return {name: str(value) for name, value in values.items()} | lines

    def warnings(self) -> list[str]:
        """What a person should look at."""
        silent = [topic for topic in self._sequence if not self.bag.counts.get(topic)]
        losing = [topic for topic in self._sequence if self._lost_on(topic)]
        mixed = [topic for topic in self._sequence if self._sequence[topic].mixed]
        return [
            *(f"nothing on {topic} yet" for topic in silent),
            *(f"messages lost on {topic}" for topic in losing),
            *(f"{topic}: {UNCOUNTED}" for topic in mixed),
        ]

    def _lost_on(self, topic: str) -> int:
        """How many are missing in the publisher's count."""
        sequence = self._sequence[topic]
        return 0 if sequence.mixed else sequence.missing

    @contextmanager
    def _ending(self) -> Iterator[None]:
        """End the recording where the disk refuses."""
        try:
            yield
        except OSError as error:
            self._end(str(error))

    def _end(self, why: str) -> None:
        self.ended = f"recording stopped: {why}"
        self.close()
