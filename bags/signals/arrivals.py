"""What arrived on a topic: when, how many are missing, and the last seconds of it."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile
from bags.recordings.writer import BagWriter

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
    """When messages came, in the time of a simulation; between two looks it goes on evenly."""

    _before: tuple[int, int] = (0, 0)
    _newest: tuple[int, int] = (0, 0)

    def look(self, wall_ns: int, simulated_ns: int) -> None:
        """At `wall_ns` the simulation's clock is at `simulated_ns`."""
        self._before, self._newest = self._newest, (wall_ns, simulated_ns)

    def at(self, wall_ns: int) -> int:
        """The simulated time at `wall_ns`, in ns; the wall's where no clock was looked at."""
        (first, begun), (last, now) = self._before, self._newest
        if not last:
            return wall_ns
        if not first or not first <= wall_ns <= last:
            return now
        return begun + (now - begun) * (wall_ns - first) // max(last - first, 1)


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
