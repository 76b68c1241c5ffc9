"""`Watch`: stamped messages in, readings out; the one path for live messages and replayed ones."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bags.designs.wiring import sampler_of
from bags.signals.sampling import LOST, NOT_FINITE, Sample
from bags.signals.timing import seconds
from nlsid_core.designs import AnyDesign
from nlsid_core.running.alarm import State, state_of
from nlsid_core.running.comparison import Centre
from nlsid_core.running.forecast import Forecast
from nlsid_core.running.reading import Reading, Status

HELD = 4096  # samples kept for a run whose start is announced late: 4 s at 1 kHz
WAITING = "waiting for the controller to announce its start"


class Stamped(NamedTuple):
    """A reading, what is said of the robot after it, and the stamp (ns) of the response."""

    stamp_ns: int
    reading: Reading
    state: State


SILENT = 5  # periods that commands may go on after the last response of a recording


class Watch:
    """Makes samples as identification does (`bags.signals.sampling`) and asks the monitor of each.

    A run begins with the first complete sample, or, if `announced`, at the stamp given to `begin`;
    the samples before it then give the observer its state, and runs may follow each other. Time in
    the readings is s since the run's first sample or announced start. samples: since then; lost,
    filled: those of them that nobody measured, and so not judged (`LOST`, `Sample.filled`); judged:
    since a run began, which may have been by itself. `pairing.check` says whether messages have the
    signals, `pairing.stamp` which of their times is the stamp. warning_margin: below which a
    sample that is inside is warned of.
    """

    def __init__(
        self,
        design: AnyDesign,
        *,
        centre: Centre = Centre.COMMAND,
        warning_margin: float = 0.0,
        announced: bool = False,
    ) -> None:
        self.design = design
        self.monitor = design.monitor(centre)
        self.pairing = sampler_of(design)
        self._single = design.is_single
        self._count = len(self.pairing.responses)
        self._framed = any(signal.path.framed for signal in self.pairing.responses)
        self.warning_margin = warning_margin
        self._announced = announced
        self.restart()

    def restart(self) -> None:
        """Begin a new run: forget stamps, lags and budget."""
        self.pairing.restart()
        self.monitor.restart()
        self.origin_ns: int | None = None
        self.samples = self.lost = self.filled = self.judged = 0
        self._newest_ns = 0
        self._newest: dict[str, tuple[int, tuple[float, ...]]] = {}  # of each response topic
        self._recent: deque[Sample] = deque(maxlen=HELD if self._announced else 0)
        self._start_ns: int | None = None
        self._over: tuple[float, str] = (math.inf, "")  # the run's last stamp (ns), and why
        self._running = not self._announced
        self._held: tuple[int, Any] | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether a run is still to be announced."""
        return self._announced and not self._running

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

    def stop(self, last_ns: int, reason: str) -> None:
        """The run at hand has ended with the response stamped `last_ns`: none after it is judged.

        Tubes around a simulation go on, whoever sends the commands.
        """
        if not self.monitor.goes_on:
            self._over = last_ns, reason

    def message(self, topic: str, stamp_ns: int, data: bytes) -> list[Stamped]:
        """Feed a serialised message of a checked topic; the readings that can be given now, in
        order.

        Raises BagError if it cannot be read, or lacks an element that a signal names.
        """
        return self._take(topic, stamp_ns, self.pairing.numbers(topic, data))

    def response(self, stamp_ns: int, y: Any) -> list[Stamped]:
        """Feed every response as one message; the readings that can be given now, in order."""
        return self._take("", stamp_ns, dict(enumerate(_numbers(y))))

    def excitation(self, stamp_ns: int, u: Any) -> list[Stamped]:
        """Feed every command as one message; the readings that can be given now, in order."""
        return self._take("", stamp_ns, dict(enumerate(_numbers(u), start=self._count)))

    def _take(self, topic: str, stamp_ns: int, numbers: Mapping[int, float]) -> list[Stamped]:
        measured = tuple(value for k, value in numbers.items() if k < self._count)
        if not measured:
            return self._judge(self.pairing.take(stamp_ns, numbers))
        if self._framed and not any(map(math.isfinite, measured)):
            return []  # the message has other transforms
        self._newest_ns = max(self._newest_ns, stamp_ns)
        before = self.pairing.late_responses
        newest, self._newest[topic] = self._newest.get(topic), (stamp_ns, measured)
        if newest is not None and newest[0] == stamp_ns and newest != self._newest[topic]:
            return self.missing(f"{self.design.name} has two values at one stamp", doubted=True)
        readings = self._judge(self.pairing.take(stamp_ns, numbers))
        if self.origin_ns is None and not any(map(math.isfinite, measured)):
            said = ", ".join(f"{value:g}" for value in measured)
            return self.missing(f"{self.design.name} is {said}")  # and no sample was before it
        if self.pairing.late_responses > before:
            back = seconds(self._newest_ns, stamp_ns)
            where = topic or self.pairing.responses[0]
            went = f"time went back by {back:g} s on {where}"
            readings += self.missing(went, doubted=True)
        return readings

    def flush(self, until_ns: int | None = None) -> list[Stamped]:
        """Stop waiting for commands: responses stamped up to `until_ns` (None: all)."""
        return self._judge(self.pairing.flush(until_ns))

    def end(self) -> list[Stamped]:
        """The recording is over: what waited, and unknown to its end if only commands went on."""
        said = self.flush()
        silent_ns = self.pairing.newest_command_ns - self._newest_ns
        if not self._newest_ns or silent_ns <= SILENT * self.design.period * 1e9:
            return said
        stamp_ns = self._newest_ns + int(silent_ns)
        t = seconds(stamp_ns, self._newest_ns if self.origin_ns is None else self.origin_ns)
        reason = f"no {self.design.name} in the last {silent_ns * 1e-9:.3g} s of the commands"
        return [*said, self._stamped(stamp_ns, self.monitor.missing(t, reason))]

    def missing(self, reason: str, *, doubted: bool = False) -> list[Stamped]:
        """The state is missing or stale, or its last sample is doubted: unknown from here on."""
        if not self._newest_ns:
            return []
        t = seconds(self._newest_ns, self._newest_ns if self.origin_ns is None else self.origin_ns)
        reading = self.monitor.missing(t, reason, doubted=doubted)
        return [self._stamped(self._newest_ns, reading)]

    def refuse(self, stamp_ns: int, reason: str) -> list[Stamped]:
        """A response that is not to be judged: unknown from here on."""
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return self.missing(reason)

    def unreadable(self, topic: str, stamp_ns: int, reason: str) -> list[Stamped]:
        """A message that cannot be read: unknown from here on; a command is not the one before."""
        said: list[Stamped] = []
        if topic not in self.pairing.response_topics:
            said = self._judge(self.pairing.take(stamp_ns, self.pairing.unknown(topic)))
        return [*said, *self.missing(reason)]

    def _judge(self, samples: Sequence[Sample]) -> list[Stamped]:
        judged = []
        for sample in samples:
            lost = sample.missing == LOST
            if lost and not self.monitor.goes_on:
                continue  # the monitor says which
            if self.origin_ns is None:
                self.origin_ns = sample.stamp_ns
            if self._start_ns is not None and sample.stamp_ns >= self._start_ns:
                self.origin_ns, self._start_ns = self._start_ns, None
                self._over = math.inf, ""
                self._give_lags()
            t = seconds(sample.stamp_ns, self.origin_ns)
            self._recent.append(sample)
            y, u = self._values(sample)
            if not self._running:
                reading = self.monitor.waiting(t, y, WAITING)
            elif sample.stamp_ns > self._over[0]:
                reading = self.monitor.waiting(t, y, f"the run has ended: {self._over[1]}")
            elif (
                sample.missing
                and not self.monitor.goes_on
                and not sample.missing.endswith(NOT_FINITE)  # it says which
            ):
                reading = self.monitor.missing(t, sample.missing)
            else:
                reading = (
                    self.monitor.unmeasured(t, u, sample.missing if lost else sample.filled)
                    if lost or sample.filled
                    else self.monitor.update(t, y, u)
                )
                self.samples += 1
                self.lost += lost
                self.filled += bool(sample.filled)
                judged_now = reading.status is not Status.UNKNOWN
                self.judged = 0 if reading.waits else self.judged + judged_now
                self._held = sample.stamp_ns, u
            judged.append(self._stamped(sample.stamp_ns, reading))
        return judged

    def _stamped(self, stamp_ns: int, reading: Reading) -> Stamped:
        return Stamped(stamp_ns, reading, state_of(reading, self.warning_margin))

    def forecast(self, steps: int) -> tuple[int, Forecast] | None:
        """The newest judged sample's stamp (ns), and the forecast while its command is held.

        None where there is no sample, its command is not known, or the funnel gives no forecast.
        """
        if self._held is None or not self.monitor.goes_on:
            return None
        stamp_ns, u = self._held
        held = np.atleast_1d(np.asarray(u, dtype=np.float64))
        if not np.isfinite(held).all():
            return None
        return stamp_ns, self.monitor.forecast(np.tile(held, (steps, 1)))

    def _give_lags(self) -> None:
        """The samples before the start give the observer its state, if it needs any.

        The monitor is told the start, so that a sample that was lost there is missing.
        """
        n = self.monitor.lags
        lags = list(self._recent)[-n:] if n else []
        self._running = True
        self.monitor.restart(start=0.0)
        if len(lags) < n:
            reason = f"only {len(lags)} samples before the run's start; it takes {n}"
            self.monitor.missing(0.0, reason)
        for sample in lags:
            y, u = self._values(sample)
            self.monitor.update(seconds(sample.stamp_ns, self.origin_ns or 0), y, u)

    def _values(self, sample: Sample) -> tuple[Any, Any]:
        """Numbers of a tube of one output and one input, else arrays."""
        if self._single:
            return sample.y[0], sample.u[0]
        return np.array(sample.y), np.array(sample.u)


def _numbers(value: Any) -> Sequence[float]:
    return (value,) if isinstance(value, float | int) else tuple(map(float, value))
