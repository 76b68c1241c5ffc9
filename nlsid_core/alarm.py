"""`Alarm`: readings into what to act on: warnings, hysteresis, a predicted time to exit.

Getting worse is said at once, always; only getting better can be made to wait. So a sample outside
is never read as anything else, whatever the options.
"""

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from nlsid_core.errors import DataError
from nlsid_core.reading import AnyReading, Status

WINDOW = 8  # samples over which the margin's slope is taken


class State(Enum):
    """What is said of the robot now; between unknown and the others there is no order."""

    UNKNOWN = "unknown"
    INSIDE = "inside"
    WARNING = "warning"
    ASSUMPTION_VIOLATED = "assumption violated"
    OUTSIDE = "outside"


SEVERITY = {
    State.INSIDE: 0,
    State.WARNING: 1,
    State.ASSUMPTION_VIOLATED: 2,
    State.OUTSIDE: 3,
}


@dataclass(frozen=True)
class AlarmOptions:
    """When to warn, and how slowly to believe that things are better.

    warning_margin: warn below this margin. warning_time: warn if the exit is predicted within this
    many s. hysteresis: margin needed above a threshold to come back across it. clear_after: s of
    stamps for which a better state must last before it is said. All 0: the reading as it is.

    Raises DataError on a negative or non-finite number.
    """

    warning_margin: float = 0.0
    warning_time: float = 0.0
    hysteresis: float = 0.0
    clear_after: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0.0):
                raise DataError(f"alarm: {name} is {value}; it should be finite and at least 0")


class Alert(NamedTuple):
    """The state to act on, and s until the margin reaches 0 if it goes on falling as it does now
    (inf: it does not fall, NaN: unknown).
    """

    state: State
    time_to_exit: float


class Alarm:
    """Turns one run's readings into alerts; `update` once per reading, in order."""

    def __init__(self, options: AlarmOptions | None = None) -> None:
        self.options = AlarmOptions() if options is None else options
        self.restart()

    def restart(self) -> None:
        """Forget everything: a new run."""
        self._state = State.UNKNOWN
        self._better_since = math.inf
        self._recent: deque[tuple[float, float]] = deque(maxlen=WINDOW)

    def update(self, reading: AnyReading) -> Alert:
        """The alert for this reading."""
        if reading.status is Status.UNKNOWN:
            self.restart()
            return Alert(State.UNKNOWN, math.nan)
        self._recent.append((reading.t, reading.margin))
        ahead = self._time_to_exit()
        now = self._now(reading, ahead)
        if self._state is State.UNKNOWN or SEVERITY[now] >= SEVERITY[self._state]:
            self._state, self._better_since = now, math.inf
        else:
            self._better_since = min(self._better_since, reading.t)
            if reading.t - self._better_since >= self.options.clear_after:
                self._state, self._better_since = now, math.inf
        return Alert(self._state, ahead)

    def _now(self, reading: AnyReading, ahead: float) -> State:
        """The state of this sample: its status, the warning, and what hysteresis holds back."""
        options, margin = self.options, reading.margin
        if reading.status is Status.OUTSIDE:
            return State.OUTSIDE
        if self._state is State.OUTSIDE and margin < options.hysteresis:
            return State.OUTSIDE
        if reading.status is Status.ASSUMPTION_VIOLATED:
            return State.ASSUMPTION_VIOLATED
        warned = self._state is not State.UNKNOWN and SEVERITY[self._state] > 0
        threshold = options.warning_margin + (options.hysteresis if warned else 0.0)
        low = options.warning_margin > 0.0 and margin < threshold
        return State.WARNING if low or ahead < options.warning_time else State.INSIDE

    def _time_to_exit(self) -> float:
        """The margin over its falling slope, by least squares on the last samples."""
        margin = self._recent[-1][1]
        if margin <= 0.0:
            return 0.0
        if len(self._recent) < 2:
            return math.inf
        count = len(self._recent)
        t_mean = sum(t for t, _ in self._recent) / count
        spread = sum((t - t_mean) ** 2 for t, _ in self._recent)
        slope = sum((t - t_mean) * m for t, m in self._recent) / spread
        return margin / -slope if slope < 0.0 else math.inf
