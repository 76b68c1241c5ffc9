"""What arrived on a topic: when, how many are missing, and the last seconds of it."""

from bisect import bisect
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile
from bags.recordings.writer import BagWriter

REMEMBERED = 1000  # looks at a clock; a recorder looks 20 times a second
SNAPSHOT: Final = "snapshot"  # the custom datum of a bag of last seconds: how many of them


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
        """Write a bag of what is remembered; how many messages. Raises BagError if it exists.

        definitions: of the topics' types by topic; those that are not in it have standard types.
        offered: the quality of service of each topic's publishers, where it is known.
        """
        profiles = offered or {}
        with BagWriter(path, custom={SNAPSHOT: f"{self.seconds:g} s"}) as bag:
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
