"""`Watch`: stamped messages in, readings out; the one path for live messages and replayed ones."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from bags.signals.grid import seconds
from bags.signals.pairing import Pairing, Sample
from nlsid_core.alarm import Alarm, AlarmOptions, Alert
from nlsid_core.monitor import Monitor, Reading, Status

HELD = 4096  # samples kept while a run's start is not announced yet: 4 s at 1 kHz
WAITING = "waiting for the controller to announce its start"


class Stamped(NamedTuple):
    """A reading and its alert, and the stamp (ns) of the response they judge."""

    stamp_ns: int
    reading: Reading
    alert: Alert


class Watch:
    """Pairs responses with commands on message stamps and asks the monitor about each sample.

    A run begins with the first response, or, if `announced`, at the stamp given to `begin`; the
    samples before it then give the observer its state. Time in the readings is s since the run's
    first response or announced start.
    """

    def __init__(
        self, monitor: Monitor, *, options: AlarmOptions | None = None, announced: bool = False
    ) -> None:
        self.monitor = monitor
        self._alarm = Alarm(options)
        self._announced = announced
        self.restart()

    def restart(self) -> None:
        """Begin a new run: forget stamps, lags and budget."""
        self.pairing = Pairing()
        self.monitor.restart()
        self._alarm.restart()
        self.origin_ns: int | None = None
        self._newest_ns = 0
        self._held: deque[Sample] | None = deque(maxlen=HELD) if self._announced else None
        self._start_ns: int | None = None

    def begin(self, start_ns: int) -> list[Stamped]:
        """The run's sample 0 is the response stamped `start_ns`, past or to come; readings from it.

        A second `begin` is a new run.
        """
        held = list(self._held or ())
        self._held = deque(maxlen=HELD)
        self._start_ns = self.origin_ns = start_ns
        self._alarm.restart()
        return [entry for entry in self._judge(held) if entry.stamp_ns >= start_ns]

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

    def flush(self, until_ns: int | None = None) -> list[Stamped]:
        """Stop waiting for commands: responses stamped up to `until_ns` (None: all)."""
        return self._judge(self.pairing.flush(until_ns))

    def missing(self, reason: str) -> list[Stamped]:
        """The state is missing or stale: unknown from here on."""
        if self.origin_ns is None:
            return []
        t = seconds(self._newest_ns, self.origin_ns)
        reading = self.monitor.missing(t, reason)
        return [Stamped(self._newest_ns, reading, self._alarm.update(reading))]

    def _judge(self, samples: Sequence[Sample]) -> list[Stamped]:
        if self.origin_ns is None:
            return []
        judged = []
        for sample in samples:
            t = seconds(sample.stamp_ns, self.origin_ns)
            if self._held is not None and self._starts(sample):
                self._give_lags()
            if self._held is not None:
                self._held.append(sample)
                reading = Reading(t, Status.UNKNOWN, measured=sample.y, reason=WAITING)
            else:
                reading = self.monitor.update(t, sample.y, sample.u)
            judged.append(Stamped(sample.stamp_ns, reading, self._alarm.update(reading)))
        return judged

    def _starts(self, sample: Sample) -> bool:
        return self._start_ns is not None and sample.stamp_ns >= self._start_ns

    def _give_lags(self) -> None:
        """The samples before the start give the observer its state."""
        n = len(self.monitor.model)
        lags = list(self._held or ())[-n:]
        self._held = None
        self.monitor.restart()
        if len(lags) < n:
            reason = f"only {len(lags)} samples before the run's start; it takes {n}"
            self.monitor.missing(0.0, reason)
        for sample in lags:
            self.monitor.update(seconds(sample.stamp_ns, self.origin_ns or 0), sample.y, sample.u)
