"""`Watch`: stamped messages in, readings out; the one path for live messages and replayed ones."""

from collections.abc import Sequence
from typing import NamedTuple

from bags.grid import seconds
from bags.pairing import Pairing, Sample
from nlsid_core.monitor import Monitor, Reading


class Stamped(NamedTuple):
    """A reading and the stamp (ns) of the response it judges."""

    stamp_ns: int
    reading: Reading


class Watch:
    """Pairs responses with commands on message stamps and asks the monitor about each sample.

    Time in the readings is s since the first response.
    """

    def __init__(self, monitor: Monitor) -> None:
        self.monitor = monitor
        self.restart()

    def restart(self) -> None:
        """Begin a new run: forget stamps, lags and budget."""
        self.pairing = Pairing()
        self.monitor.restart()
        self.origin_ns: int | None = None
        self._newest_ns = 0

    def response(self, stamp_ns: int, y: float) -> list[Stamped]:
        """Feed a response; the readings that can be given now, in order."""
        if self.origin_ns is None:
            self.origin_ns = stamp_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        before = self.pairing.late_responses
        readings = self._judge(self.pairing.response(stamp_ns, y))
        if self.pairing.late_responses > before:
            back = seconds(self._newest_ns, stamp_ns)
            readings += self.missing(f"time went back by {back:g} s on {self.monitor.model.y.path}")
        return readings

    def excitation(self, stamp_ns: int, u: float) -> list[Stamped]:
        """Feed a command; the readings that can be given now, in order."""
        return self._judge(self.pairing.excitation(stamp_ns, u))

    def flush(self) -> list[Stamped]:
        """Stop waiting for commands: readings for every response so far."""
        return self._judge(self.pairing.flush())

    def missing(self, reason: str) -> list[Stamped]:
        """The state is missing or stale: unknown from here on."""
        if self.origin_ns is None:
            return []
        t = seconds(self._newest_ns, self.origin_ns)
        return [Stamped(self._newest_ns, self.monitor.missing(t, reason))]

    def _judge(self, samples: Sequence[Sample]) -> list[Stamped]:
        if self.origin_ns is None:
            return []
        return [
            Stamped(
                s.stamp_ns,
                self.monitor.update(seconds(s.stamp_ns, self.origin_ns), s.y, s.u),
            )
            for s in samples
        ]
