"""What a sample is: the one path from messages to the numbers a model is fitted to and judged by.

`bags.signals.grid` feeds a `Sampler` with a recording, a replay or a live monitor with messages as
they come; the samples are equal bit for bit. What to call for a model's signals:

    sampler = Sampler([y.path for y in ...], [u.path for u in ...], period=model.period)
    sampler.check(topic, msgtype, types)  # once for each of sampler.topics
    for sample in sampler.take(sampler.stamp(data, log_ns), sampler.numbers(topic, data)): ...
    for sample in sampler.flush(until_ns): ...  # stop waiting for other topics

The paths are expressions (`bags.signals.expressions`) and carry the whole rule, so that nothing
besides the model has to be known:

- The clock is one for all signals: header stamps, or with `|clock(log)` on every signal the time
  of logging, live of arrival. Stamps of two clocks are never put together.
- Responses without `|hold(T s)` or `|linear(T s)` are samples as they come: the first response's
  stamps are the samples' stamps, and the others have to be stamped within MATCH periods of it.
- If every response has one of them, samples lie on a grid of one period from the first stamp at
  which every signal has a value. `hold`: the latest value at or before, at most T s old.
  `linear`: on the line between the values before and after, at most T s apart.
- An excitation is the latest command at or before the sample, at most T s old with `|hold(T s)`;
  `|lag(T s)` filters what is held, `A * B` multiplies two such.
- Signals may come from any number of topics, each of one or more of them.
- Responses that are samples as they come and up to MOST_LOST periods apart have `LOST` samples
  between them, a period apart: no response, and the commands of their time if they are known.
- On a grid, a sample between two messages of a response that are more than BRIDGED periods apart is
  `filled` in: identification takes it and counts it, a monitor does not judge it, as nobody
  measured it. Commands are held by nature; that is no loss.
- The first sample is the first with every signal; what came before it is counted, not given.
  Later a signal that is missing is NaN, and `missing` says which and why.

A sample is given as soon as no message that is still to come can change it: topics are in order,
so that is when every topic has been seen at or after it.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from rosbags.typesys.store import Typestore

from bags.recordings.message_types import header_stamp_ns, is_stamped
from bags.signals.expressions import (
    Expression,
    Running,
    factors,
    parse_factors,
    product,
)
from bags.signals.message_reader import MessageReader
from nlsid_core.errors import BagError, apart
from nlsid_core.running.grid import TOLERANCE

MATCH: Final = 0.05  # periods between stamps of one sample on two topics; a loop's usual scatter
BRIDGED: Final = 1.5  # periods between two messages: a sample is missing between them
MOST_LOST: Final = 100  # samples in a row whose commands are kept; then nothing is known
MOST_FILLED: Final = 0.05  # of the samples: with more, data are invented rather than recorded
LOST: Final = "the sample is lost: no message of it came"
FILLED: Final = "filled in"  # how the reason of a sample begins that nobody measured
NOT_FINITE: Final = "not a finite number"
LEAP: Final = 1000  # samples in a row of which every one would be said to be missing
HISTORY: Final = 2**16  # values kept of a signal while no sample comes: a minute at 1 kHz


@dataclass(frozen=True)
class Grid:
    """How the numbers in messages become samples.

    Attributes:
        period: s between samples (None: the median step of the first response).
        max_gap: s without a response that is still filled in, or resampled over (None: 1.5
            periods, so no sample may be missing).
        clock: of all signals, `header` or `log`.
        resample: `none`, `last` or `linear` for responses.
        hold: s for which a command is held (None: as long as max_gap).
        split_gaps: a longer gap ends a trajectory and begins the next, instead of an error.
    """

    period: float | None = None
    max_gap: float | None = None
    clock: str = "header"
    resample: str = "none"
    hold: float | None = None
    split_gaps: bool = False

    def path(self, text: str, *, response: bool) -> str:
        """A signal's text with these rules written into it; what it says itself stays."""
        parts = factors(text)
        if len(parts) > 1:
            return product(self.path(part, response=response) for part in parts)
        recorded = signal = Expression.parse(text)
        if self.clock != "header":
            signal = signal.sampled("clock", unit=self.clock)
        if response and self.resample != "none":
            if self.max_gap is None:
                raise BagError("resampling needs max_gap: the longest time between two values")
            rule = "hold" if self.resample == "last" else "linear"
            signal = signal.sampled(rule, window=self.max_gap)
        if not response and self.hold is not None:
            signal = signal.sampled("hold", window=self.hold)
        return text if signal == recorded else str(signal)


class Sample(NamedTuple):
    """One sample: responses y and excitations u in the order they were named, NaN where missing.

    missing: which signal has no value and why; filled: which response was not measured here but
    bridges a gap, and how long that is. Empty if there is none.
    """

    stamp_ns: int
    y: tuple[float, ...]
    u: tuple[float, ...]
    missing: str = ""
    filled: str = ""


class Sampler:
    """Messages or numbers in, samples out; see the module.

    incomplete: times of samples before the first complete one. late: values that came after a
    sample they belong to was given. late_responses: values of a response whose stamps went back
    behind a sample that was given; duplicate_responses: of the first one, those with the stamp of
    another. They give no sample.

    Raises BagError for signals that are no expressions, on several clocks, or of which some
    responses are samples as they come and others on a grid.
    """

    def __init__(
        self,
        responses: Sequence[str | Expression],
        excitations: Sequence[str | Expression],
        *,
        period: float,
    ) -> None:
        self.responses = tuple(map(_response, responses))
        self.excitations = tuple(map(_factors, excitations))
        if not self.responses or not self.excitations:
            raise BagError("name at least one response and one excitation")
        signals = (*self.responses, *(factor for part in self.excitations for factor in part))
        self.clock = one_clock(signals)
        self.topics = tuple(dict.fromkeys(signal.path.topic for signal in signals))
        self.period_ns = round(period * 1e9)
        gridded = [signal.operation("hold", "linear") is not None for signal in self.responses]
        if any(gridded) and not all(gridded):
            raise BagError(
                f"{self.responses[gridded.index(False)]} is sampled as it comes, "
                f"{self.responses[gridded.index(True)]} on a grid; give every response |hold(T s) "
                "or |linear(T s), or none"
            )
        self.on_grid = all(gridded)
        self._single = all(len(part) == 1 for part in self.excitations)
        self.response_topics = tuple(dict.fromkeys(s.path.topic for s in self.responses))
        self.shared_topics = {s.path.topic for s in signals if s.path.framed}
        self._readers: dict[str, MessageReader] = {}  # of each checked topic
        self._recorded: dict[int, str] = {}  # signal -> unit of the number in its messages
        self._on: dict[str, list[int]] = {topic: [] for topic in self.topics}
        for k, signal in enumerate(signals):
            self._on[signal.path.topic].append(k)
        self._signals = signals
        self.restart()

    def __str__(self) -> str:
        driving = [product(map(str, part)) for part in self.excitations]
        return ", ".join([*map(str, self.responses), *driving])

    def restart(self) -> None:
        """Forget everything but the signals."""
        n = len(self.responses)
        match_ns = round(MATCH * self.period_ns)
        matches = [0, *[match_ns] * (n - 1), *[None] * (len(self._signals) - n)]
        self._kept = [_Kept(s, m) for s, m in zip(self._signals, matches, strict=True)]
        self._running: dict[int, Running] = {
            k: self._signals[k].numbers.running(unit) for k, unit in self._recorded.items()
        }
        self._waiting: list[int] = []
        self._released_ns: float = -math.inf
        self._started = False
        self._next_ns: int | None = None
        self.incomplete = self.late = self.late_responses = self.duplicate_responses = 0

    def check(self, topic: str, msgtype: str, types: Typestore) -> None:
        """BagError unless messages of `msgtype` on `topic` have the signals and their clock."""
        if self.clock == "header" and not is_stamped(msgtype, types):
            signal = next(s for s in self._signals if s.path.topic == topic)
            raise BagError(
                f"{signal}: {topic} ({msgtype}) has no header stamp; a model of it is identified "
                "with `clock: log`, by the times at which messages were logged"
            )
        for k in self._on[topic]:
            signal = self._signals[k]
            signal.path.check(msgtype, types)
            signal.unit(msgtype, types)
            self._recorded[k] = signal.recorded_unit(msgtype, types)
            self._running[k] = signal.numbers.running(self._recorded[k])
        paths = [self._signals[k].path for k in self._on[topic]]
        self._readers[topic] = MessageReader(paths, msgtype, types)

    def stamp(self, data: bytes, log_ns: int) -> int:
        """The stamp (ns) of a serialised message that was logged, or live arrived, at `log_ns`."""
        return log_ns if self.clock == "log" else header_stamp_ns(data)

    def numbers(self, topic: str, data: bytes) -> dict[int, float]:
        """The numbers of a serialised message by their signals; BagError if it has not all.

        Signals are counted through responses first, then every factor of the excitations.
        """
        return dict(zip(self._on[topic], self._readers[topic].numbers(data), strict=True))

    def measures(self, topic: str, data: bytes) -> bool:
        """Whether a message has any of its topic's signals; one of other transforms has none."""
        framed = all(self._signals[k].path.framed for k in self._on[topic])
        return not framed or any(map(math.isfinite, self.numbers(topic, data).values()))

    def unknown(self, topic: str) -> dict[int, float]:
        """What `numbers` gives for a message that cannot be read: NaN of each of its signals."""
        return dict.fromkeys(self._on[topic], math.nan)

    def take(self, stamp_ns: int, numbers: Mapping[int, float]) -> list[Sample]:
        """Take numbers of one message as `numbers` gives them; the samples certain now."""
        for k, value in numbers.items():
            self._operate(k, stamp_ns, value)
        return self._release(-math.inf)

    def feed(self, k: int, stamp_ns: int, value: float) -> list[Sample]:
        """Take a number of signal k (as `numbers` counts), its operations done already."""
        self.add(k, stamp_ns, value)
        return self._release(-math.inf)

    @property
    def newest_command_ns(self) -> float:
        """The newest stamp of a command; -inf before the first."""
        return max(kept.newest_ns for kept in self._kept[len(self.responses) :])

    def flush(self, until_ns: int | None = None) -> list[Sample]:
        """Stop waiting: for commands of samples up to `until_ns`, or for anything (None).

        None: on a grid, up to the last stamp that every response has reached.
        """
        if until_ns is not None:
            return self._release(until_ns)
        if not self.on_grid:
            return self._release(math.inf)
        return self._release(min(kept.newest_ns for kept in self._kept[: len(self.responses)]))

    def _operate(self, k: int, stamp_ns: int, value: float) -> None:
        if self._signals[k].path.framed and math.isnan(value):
            return  # the message has other transforms
        running = self._running.get(k)
        if running is None:
            running = self._running[k] = self._signals[k].numbers.running("")
        if running.remembers and stamp_ns <= self._kept[k].newest_ns:
            if k >= len(self.responses):
                self.late += 1
            elif stamp_ns == self._kept[k].newest_ns:
                self.duplicate_responses += k == 0
            else:
                self.late_responses += 1
            return
        self.add(k, stamp_ns, running.update(stamp_ns, value))

    def add(self, k: int, stamp_ns: int, value: float) -> None:
        """What `feed` takes; the samples come with the next call that gives any."""
        kept = self._kept[k]
        if k == 0 and not self.on_grid:
            at = bisect_left(self._waiting, stamp_ns)
            if stamp_ns == self._released_ns or self._waiting[at : at + 1] == [stamp_ns]:
                self.duplicate_responses += 1
                return
            if stamp_ns < self._released_ns:
                self.late_responses += 1
                return
            self._waiting.insert(at, stamp_ns)
        elif stamp_ns <= self._released_ns:
            self.late += 1
            self.late_responses += k < len(self.responses) and stamp_ns < kept.newest_ns
        kept.add(stamp_ns, value)

    def _release(self, until_ns: float) -> list[Sample]:
        """The samples that are certain, or up to `until_ns` certain but for their commands.

        Infinite: all, as things are.
        """
        given: list[Sample] = []
        n = len(self.responses)
        while True:
            stamp_ns = self._next_stamp()
            if stamp_ns is None:
                return given
            if until_ns < math.inf:
                for kept in self._kept[:n] if stamp_ns <= until_ns else self._kept:
                    if kept.certain_ns < stamp_ns:
                        return given
            given += self._lost_before(stamp_ns)
            self._take_stamp(stamp_ns)
            values = [kept.value_at(stamp_ns) for kept in self._kept]
            self._released_ns = stamp_ns
            if self.on_grid:
                self._leap(values[:n])
            complete = all(map(math.isfinite, values))
            if complete:
                self._started = True
            elif not self._started:
                self.incomplete += 1
                continue
            missing = "" if complete else self._why(stamp_ns, values)
            filled = "" if missing or not self.on_grid else self._filled(stamp_ns)
            u = self._multiplied(values[n:])
            given.append(Sample(stamp_ns, tuple(values[:n]), u, missing, filled))

    def _lost_before(self, stamp_ns: int) -> list[Sample]:
        """The samples that should have come between the last one given and this one."""
        if self.on_grid or not self._started:
            return []
        n = len(self.responses)
        gap_ns = stamp_ns - int(self._released_ns)
        periods = gap_ns / self.period_ns
        count = round(periods)
        if not 1 < count <= MOST_LOST + 1 or abs(periods - count) > TOLERANCE:
            return []
        lost = []
        for left in range(count - 1, 0, -1):
            at = stamp_ns - gap_ns * left // count
            u = self._multiplied([self._commanded(k, at) for k in range(n, len(self._kept))])
            lost.append(Sample(at, (math.nan,) * n, u, LOST))
        return lost

    def _commanded(self, k: int, at_ns: int) -> float:
        """What signal k, which drives, was at a lost sample; NaN if a message with it may be lost.

        That is if it is measured with a response, or if no hold is stated and it is not new.
        """
        kept, value = self._kept[k], self._kept[k].value_at(at_ns)
        lost = self._signals[k].path.topic in self.response_topics
        old = kept.limit_ns == math.inf and at_ns - kept.stamps[0] > BRIDGED * self.period_ns
        return math.nan if lost or old else value

    def _multiplied(self, values: Sequence[float]) -> tuple[float, ...]:
        """The excitations from the values of all their factors."""
        if self._single:
            return tuple(values)
        left = iter(values)
        return tuple(math.prod(next(left) for _ in part) for part in self.excitations)

    def _next_stamp(self) -> int | None:
        if not self.on_grid:
            return self._waiting[0] if self._waiting else None
        if self._next_ns is None:
            firsts = [kept.first_ns for kept in self._kept]
            if None in firsts:
                return None
            self._next_ns = max(first for first in firsts if first is not None)
        return self._next_ns

    def _take_stamp(self, stamp_ns: int) -> None:
        if self.on_grid:
            self._next_ns = stamp_ns + self.period_ns
        else:
            del self._waiting[0]

    def _leap(self, responses: Sequence[float]) -> None:
        """Where a response has no value for more than LEAP samples, the grid goes on at its next.

        Hours without a message, or a clock that was set, are one sample that is missing.
        """
        ends = [
            self._kept[k].after(self._released_ns)
            for k, value in enumerate(responses)
            if not math.isfinite(value)
        ]
        if self._next_ns is not None and ends and (end := max(ends)) < math.inf:
            skipped = int(end - self._next_ns) // self.period_ns
            self._next_ns += self.period_ns * skipped if skipped > LEAP else 0

    def _why(self, stamp_ns: int, values: Sequence[float]) -> str:
        k = next(k for k, value in enumerate(values) if not math.isfinite(value))
        return f"{self._signals[k]}: {self._kept[k].why(stamp_ns)}"

    def _filled(self, stamp_ns: int) -> str:
        """Which response bridges a gap at `stamp_ns`, empty if none does; after `value_at`."""
        for signal, kept in zip(self.responses, self._kept, strict=False):
            gap_ns = kept.gap_ns(stamp_ns)
            if gap_ns > BRIDGED * self.period_ns:
                return f"{FILLED}: {signal} between messages {gap_ns / 1e9:.3g} s apart"
        return ""


class _Kept:
    """The values of one signal that samples still to come may need."""

    def __init__(self, signal: Expression, match_ns: int | None) -> None:
        rule = signal.operation("hold", "linear")
        self.linear = rule is not None and rule.name == "linear"
        self.limit_ns: float = math.inf if rule is None else round(rule.window * 1e9)
        self.match_ns = match_ns if rule is None else None
        lag = signal.operation("lag")
        self.lag_ns: float = 0.0 if lag is None else lag.window * 1e9
        self.stamps: list[int] = []
        self.values: list[float] = []
        self.targets: list[float] = []  # with a lag, what the values go to
        self.newest_ns: float = -math.inf
        self.certain_ns: float = -math.inf  # nothing to come changes what the value is until then
        self.first_ns: int | None = None

    def add(self, stamp_ns: int, value: float) -> None:
        if self.stamps[-1:] == [stamp_ns] and not math.isfinite(self.values[-1]):
            return  # another value does not tell which of the two was acted on
        if self.lag_ns:
            if stamp_ns < self.newest_ns:
                return  # what it made of later values is given already
            reached = self._lagged(stamp_ns, -1) if self.stamps else value
            self.targets.append(value)
            value = reached if math.isfinite(reached) else value
        if stamp_ns >= self.newest_ns:
            self.stamps.append(stamp_ns)
            self.values.append(value)
            self.newest_ns = stamp_ns
            self.certain_ns = stamp_ns + (self.match_ns or 0)
        else:
            at = bisect_right(self.stamps, stamp_ns)
            self.stamps.insert(at, stamp_ns)
            self.values.insert(at, value)
        if len(self.stamps) > HISTORY:
            del self.stamps[0], self.values[0], self.targets[:1]
        if self.first_ns is None and math.isfinite(value):
            self.first_ns = stamp_ns

    def after(self, stamp_ns: float) -> float:
        """The first stamp after `stamp_ns`; infinite if there is none yet."""
        at = bisect_right(self.stamps, stamp_ns)
        return self.stamps[at] if at < len(self.stamps) else math.inf

    def value_at(self, stamp_ns: int) -> float:
        """The value of a sample; older values are forgotten, as samples only get later."""
        if self.match_ns is not None:
            first = bisect_left(self.stamps, stamp_ns - self.match_ns)
            del self.stamps[:first], self.values[:first]
            found = self.stamps and self.stamps[0] <= stamp_ns + self.match_ns
            return self.values[0] if found else math.nan
        after = bisect_right(self.stamps, stamp_ns)
        if not after:
            return math.nan
        del self.stamps[: after - 1], self.values[: after - 1], self.targets[: after - 1]
        before_ns, value = self.stamps[0], self.values[0]
        if before_ns == stamp_ns:
            return value
        if not self.linear:
            value = self._lagged(stamp_ns, 0) if self.lag_ns else value
            return value if stamp_ns - before_ns <= self.limit_ns else math.nan
        if len(self.stamps) < 2 or self.stamps[1] - before_ns > self.limit_ns:
            return math.nan
        share = (stamp_ns - before_ns) / (self.stamps[1] - before_ns)
        return value + (self.values[1] - value) * share

    def gap_ns(self, stamp_ns: int) -> int:
        """From the value at or before `stamp_ns` to the one after; 0 on a value. After `value_at`.

        It is certain as soon as the value is, of a response on a grid.
        """
        if len(self.stamps) < 2 or self.stamps[0] == stamp_ns:
            return 0
        return self.stamps[1] - self.stamps[0]

    def _lagged(self, stamp_ns: int, k: int) -> float:
        """What the lag reaches at `stamp_ns` from value k, its target held."""
        target = self.targets[k]
        left = math.exp((self.stamps[k] - stamp_ns) / self.lag_ns)
        return target + (self.values[k] - target) * left

    def why(self, stamp_ns: int) -> str:
        """Why there is no value, in words."""
        before = bisect_right(self.stamps, stamp_ns) - 1
        if self.match_ns is not None:
            at = bisect_left(self.stamps, stamp_ns - self.match_ns)
            found = at < len(self.stamps) and self.stamps[at] <= stamp_ns + self.match_ns
            return NOT_FINITE if found else "no message with the stamp of the sample"
        if before < 0:
            return "no message with the stamp of the sample"
        if not math.isfinite(self.values[before]):
            return NOT_FINITE
        if self.linear:
            return f"no message for more than {self.limit_ns / 1e9:g} s"
        age, most = apart((stamp_ns - self.stamps[before]) / 1e9, self.limit_ns / 1e9)
        return f"nothing for {age} s; at most {most} s is held"


def said_filled(filled: int, samples: int) -> str:
    """How many of the samples nobody measured, in words; empty if all were measured."""
    return f"{filled} of {samples} samples filled in, not measured" if filled else ""


def one_clock(signals: Sequence[Expression]) -> str:
    """`header` or `log`, whichever all the signals are stamped by; BagError if they are of two."""
    clocks = {str(signal): signal.clock or "header" for signal in signals}
    if len(set(clocks.values())) > 1:
        said = ", ".join(f"{text} by its {clock} time" for text, clock in clocks.items())
        raise BagError(f"signals on two clocks cannot be paired: {said}; choose one clock")
    return next(iter(clocks.values()))


def held_values(
    signal: Expression, stamps: Sequence[int], numbers: Sequence[float], at_ns: Sequence[int]
) -> list[float]:
    """What an excitation with these stamps (ns) is at each of `at_ns`, ascending, however old."""
    kept, k = _Kept(signal, None), 0
    kept.limit_ns = math.inf
    found = []
    for at in at_ns:
        while k < len(stamps) and stamps[k] <= at:
            kept.add(stamps[k], numbers[k])
            k += 1
        found.append(kept.value_at(at))
    return found


def _response(signal: str | Expression) -> Expression:
    found = _factors(signal)
    if len(found) > 1 or found[0].operation("lag"):
        raise BagError(f"{signal}: products and lag are for what drives, not for a response")
    return found[0]


def _factors(signal: str | Expression) -> tuple[Expression, ...]:
    return parse_factors(signal) if isinstance(signal, str) else (signal,)
