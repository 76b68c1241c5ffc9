"""The times of a recording: offset and drift between clocks, losses, commands held, delays."""

from dataclasses import dataclass
from typing import Final, overload

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import DataError

SEGMENTS: Final = 50  # of the recording, each giving its least latency to the line of the drift
SAME_CLOCK: Final = 1.0  # s; latencies stay below, an offset between clocks rarely does
DRIFT_SIGNIFICANT: Final = 5.0  # times the scatter of the segments about the line
OWN_PACE: Final = 1e-3  # s per s; two real clocks differ by less
DRIFT_LEAST: Final = 1e-3  # s over the recording; less than a message's latency says nothing
SOON: Final = 100  # messages: a publisher does not begin anew twice in so many
STREAMED: Final = 10  # commands of a bag from which on their intervals say how they are sent;
ENDED: Final = 3.0  # of the longest of these: without a command for longer they have ended
RELATED: Final = 0.3  # correlation of command and response below which they may be unrelated


@overload
def seconds(stamp_ns: IntArray, origin_ns: int) -> FloatArray: ...
@overload
def seconds(stamp_ns: int, origin_ns: int) -> float: ...
def seconds(stamp_ns: IntArray | int, origin_ns: int) -> FloatArray | float:
    """Stamps in ns as float seconds after `origin_ns`: the one place where the unit changes.

    The difference is taken in integers and divided once, so equal stamps give equal seconds.
    """
    return (stamp_ns - origin_ns) / 1e9


@dataclass
class Sequence:
    """Messages that a publisher counted and the bag lacks.

    A count that begins anew is a publisher that came back. One that goes back, or stays, again
    within SOON messages is that of several publishers, of which the middleware does not say who
    sent what: `mixed`, and from then on `missing` says nothing.
    """

    missing: int = 0
    mixed: bool = False
    _last: int | None = None
    _counts: bool = False
    _since_back: int = SOON
    _in_turn: bool = False  # whether it went back so soon after the time before

    def update(self, number: int) -> None:
        """Take the next message's number."""
        last, self._last = self._last, number
        self._since_back += 1
        if last is None or (number == last and not self._counts):  # the middleware may not count
            return
        if number > last:
            self._counts = True
            self.missing += number - last - 1
            return
        self._in_turn = self._since_back <= SOON
        self.mixed |= self._in_turn
        self._since_back = 0

    @property
    def alternates(self) -> bool:
        """Whether several publishers sent the last messages."""
        return self._in_turn and self._since_back <= SOON


@dataclass(frozen=True)
class Held:
    """For how long commands are held. longest: s from one to the next.

    tail: s of responses after the last command, where those have come to an end; 0 if the last one
    is held too, and is counted in `longest`.
    """

    longest: float
    tail: float


def held(stamp_ns: IntArray, until_ns: int) -> Held:
    """How long commands with these stamps (N,) were held while responses came, to `until_ns`."""
    intervals = np.diff(stamp_ns[stamp_ns < until_ns]) / 1e9
    between = float(intervals.max(initial=0.0))
    tail = max((until_ns - int(stamp_ns[-1])) / 1e9, 0.0)
    if len(intervals) >= STREAMED and tail > ENDED * between:
        return Held(between, tail)
    return Held(max(between, tail), 0.0)


@dataclass(frozen=True)
class ClockRelation:
    """Header stamps against log times.

    offset: s, stamp minus log time at the start, for the message that came through fastest.
    drift: s per s, by which the stamps' clock runs faster; 0 if none can be told from the scatter.
    latency: s, median time from stamp to log beyond the fastest message's. spread: s, its 95 %.
    """

    offset: float
    drift: float
    latency: float
    spread: float

    def __str__(self) -> str:
        if abs(self.offset) < SAME_CLOCK and not self.drift:
            return (
                f"one clock, logged {abs(1e3 * self.offset):.3g} ms after the stamp at the soonest"
            )
        if abs(self.drift) > OWN_PACE:
            return f"stamps run at {1 + self.drift:.4g} times the pace of log time: simulated time?"
        drift = f", drifting {1e6 * self.drift:+.3g} ppm" if self.drift else ", constant"
        return f"stamps {self.offset:+.3f} s from log time{drift}"


def clock_relation(stamp_ns: IntArray, log_ns: IntArray) -> ClockRelation:
    """How the header stamps (N,) relate to the log times (N,) of the same messages, N > 0.

    A message is logged after it is stamped, by a latency that varies: the offset between the clocks
    shows in the messages that came through fastest. The drift is the slope of a line through the
    fastest of each of 50 parts.
    """
    if not len(stamp_ns):
        raise DataError("no messages, so no relation between their clocks")
    origin = int(stamp_ns[0]) - int(log_ns[0])
    ahead = ((stamp_ns - log_ns) - origin) / 1e9
    t = (log_ns - log_ns[0]) / 1e9
    slope = _drift(t, ahead)
    level = ahead - slope * t
    offset = float(level.max())
    latency, spread = np.quantile(offset - level, (0.5, 0.95))
    return ClockRelation(origin / 1e9 + offset, slope, float(latency), float(spread))


def _drift(t: FloatArray, ahead: FloatArray) -> float:
    if len(t) < 2 * SEGMENTS or t[-1] <= t[0]:
        return 0.0
    parts = np.array_split(np.arange(len(t)), SEGMENTS)
    best = [part[np.argmax(ahead[part])] for part in parts]
    x, y = t[best], ahead[best]
    slope, level = np.polyfit(x - x.mean(), y, 1)
    scatter = float(np.std(y - slope * (x - x.mean()) - level))
    total = abs(slope) * float(t[-1] - t[0])
    return 0.0 if total < max(DRIFT_LEAST, DRIFT_SIGNIFICANT * scatter) else float(slope)


def missing(sequence: IntArray) -> int | None:
    """Numbers left out by a recorder that counted up from message to message; None otherwise.

    A publisher that came back counts anew: far below, by more than messages overtake each other,
    and then for itself.
    """
    anew = np.flatnonzero(np.diff(sequence) < -SOON) + 1
    steps = np.concatenate([np.diff(np.sort(part)) for part in np.split(sequence, anew)])
    if not len(steps) or not (steps == 1).sum() > 0.5 * len(steps):
        return None
    return int(np.maximum(steps - 1, 0).sum())


@dataclass(frozen=True)
class Delay:
    """seconds: by which the response follows the command. correlation: there, -1 to 1."""

    seconds: float
    correlation: float


def correlation(y: FloatArray, u: FloatArray) -> FloatArray:
    """Σ_t y(t + k) u(t) at the lags k = 0 … N-1 of two signals (N,)."""
    size = 2 * len(y)  # so long that nothing comes round
    found: FloatArray = np.fft.irfft(np.fft.rfft(y, size) * np.fft.rfft(u, size).conj(), size)
    return found[: len(y)]


def delay(command: FloatArray, response: FloatArray, period: float, max_delay: float) -> Delay:
    """The delay (N,) samples `period` s apart show: where command and response correlate most.

    Of two signals on one grid the normalised cross-correlation about their means, over delays from
    0 to `max_delay` s, refined by a parabola through its peak. A lag in the response counts as
    part of the delay. Raises DataError if either is constant or `max_delay` leaves no overlap.

    Source: C. Knapp, G. Carter, IEEE Trans. ASSP 24 (1976) 320, the unweighted correlator.
    """
    most = min(round(max_delay / period), len(command) - 2)
    if most < 1 or len(command) != len(response):
        raise DataError(f"{len(command)} samples leave no delay of up to {max_delay:g} s to find")
    u, y = command - command.mean(), response - response.mean()
    if not (u @ u > 0 and y @ y > 0):
        raise DataError("a constant signal has no delay")
    overlap = len(u) - np.arange(most + 1)
    found = correlation(y, u)[: most + 1] * (len(u) / overlap)
    found = found / np.sqrt((u @ u) * (y @ y))
    k = int(np.argmax(np.abs(found)))
    shift = 0.0
    if 0 < k < len(found) - 1:
        before, here, after = np.abs(found[k - 1 : k + 2])
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return Delay((k + shift) * period, float(np.clip(found[k], -1.0, 1.0)))
