"""`Watch`: stamped messages in, readings out; the one path for live messages and replayed ones."""

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from bags.monitoring.designs import Design
from bags.signals.grid import seconds
from bags.signals.pairing import Pairing, Sample
from nlsid_core.alarm import Alarm, AlarmOptions, Alert
from nlsid_core.monitor import Nominal
from nlsid_core.reading import AnyReading

HELD = 4096  # samples kept for a run whose start is announced late: 4 s at 1 kHz
WAITING = "waiting for the controller to announce its start"


class Stamped(NamedTuple):
    """A reading and its alert, and the stamp (ns) of the response they judge."""

    stamp_ns: int
    reading: AnyReading
    alert: Alert


class Watch:
    """Pairs responses with commands on message stamps and asks the monitor about each sample.

    A run begins with the first response, or, if `announced`, at the stamp given to `begin`; the
    samples before it then give the observer its state, and runs may follow each other. Time in the
    readings is s since the run's first response or announced start.
    """

    def __init__(
        self,
        design: Design,
        *,
        nominal: Nominal = Nominal.COMMAND,
        options: AlarmOptions | None = None,
        announced: bool = False,
    ) -> None:
        self.design = design
        self.monitor: Any = design.monitor(nominal)  # takes what the design's response gives
        self._alarm = Alarm(options)
        self._announced = announced
        self.restart()

    def warn(self, options: AlarmOptions) -> None:
        """Warn as `options` say from the next sample on."""
        self._alarm.options = options

    def restart(self) -> None:
        """Begin a new run: forget stamps, lags and budget."""
        self.pairing = Pairing()
        self.monitor.restart()
        self._alarm.restart()
        self.origin_ns: int | None = None
        self._newest_ns = 0
        self._recent: deque[Sample] = deque(maxlen=HELD if self._announced else 0)
        self._start_ns: int | None = None
        self._running = not self._announced

    def begin(self, start_ns: int) -> list[Stamped]:
        """The run's sample 0 is the response stamped `start_ns`, past or to come; readings from it.

        A second `begin` is a new run; samples stamped before it, whenever they come, are still of
        the run before, so that verdicts do not depend on when the announcement came.
        """
        recent = list(self._recent)
        self._recent.clear()
        self._recent.extend(sample for sample in recent if sample.stamp_ns < start_ns)
        self._start_ns = start_ns
        if self.origin_ns is None:
            self.origin_ns = start_ns
        return self._judge([sample for sample in recent if sample.stamp_ns >= start_ns])

    def response(self, stamp_ns: int, y: Any) -> list[Stamped]:
        """Feed a response; the readings that can be given now, in order."""
        if self.origin_ns is None:
            self.origin_ns = stamp_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        before = self.pairing.late_responses
        readings = self._judge(self.pairing.response(stamp_ns, y))
        if self.pairing.late_responses > before:
            back = seconds(self._newest_ns, stamp_ns)
            readings += self.missing(f"time went back by {back:g} s on {self.design.response}")
        return readings

    def excitation(self, stamp_ns: int, u: Any) -> list[Stamped]:
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
            if self._start_ns is not None and sample.stamp_ns >= self._start_ns:
                self.origin_ns, self._start_ns = self._start_ns, None
                self._alarm.restart()
                self._give_lags()
            t = seconds(sample.stamp_ns, self.origin_ns)
            self._recent.append(sample)
            if self._running:
                reading = self.monitor.update(t, sample.y, sample.u)
            else:
                reading = self.monitor.waiting(t, sample.y, WAITING)
            judged.append(Stamped(sample.stamp_ns, reading, self._alarm.update(reading)))
        return judged

    def _give_lags(self) -> None:
        """The samples before the start give the observer its state, if it needs any."""
        n = self.monitor.lags
        lags = list(self._recent)[-n:] if n else []
        self._running = True
        self.monitor.restart()
        if len(lags) < n:
            reason = f"only {len(lags)} samples before the run's start; it takes {n}"
            self.monitor.missing(0.0, reason)
        for sample in lags:
            self.monitor.update(seconds(sample.stamp_ns, self.origin_ns or 0), sample.y, sample.u)
