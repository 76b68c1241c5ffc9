"""`Alarm`: readings into what to act on: warnings and hysteresis.

Getting worse is said at once, always; only getting better can be made to wait. So a sample outside
is never read as anything else, whatever the options.
"""

import math
from dataclasses import dataclass
from enum import Enum

from nlsid_core.errors import DataError
from nlsid_core.running.reading import Reading, Status


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


class Alarm:
    """Turns one run's readings into states to act on; `update` once per reading, in order."""

    def __init__(self, options: AlarmOptions | None = None) -> None:
        self.options = AlarmOptions() if options is None else options
        self.restart()

    def restart(self) -> None:
        """Forget everything: a new run."""
        self._state = State.UNKNOWN
        self._better_since = math.inf

    def update(self, reading: Reading) -> State:
        """What is said of the robot after this reading."""
        if reading.status is Status.UNKNOWN:  # and what was bad before is not better for it
            self._better_since = math.inf
            return State.UNKNOWN
        now = self._now(reading)
        if self._state is State.UNKNOWN or SEVERITY[now] >= SEVERITY[self._state]:
            self._state, self._better_since = now, math.inf
        else:
            self._better_since = min(self._better_since, reading.t)
            if reading.t - self._better_since >= self.options.clear_after:
                self._state, self._better_since = now, math.inf
        return self._state

    def _now(self, reading: Reading) -> State:
        """The state of this sample: its status, the warning, and what hysteresis holds back."""
        options, margin = self.options, reading.margin
        if reading.status is Status.OUTSIDE:
            return State.OUTSIDE
        if self._state is State.OUTSIDE and not margin >= options.hysteresis:
            return State.OUTSIDE
        if reading.status is Status.ASSUMPTION_VIOLATED:
            return State.ASSUMPTION_VIOLATED
        warned = self._state is not State.UNKNOWN and SEVERITY[self._state] > 0
        threshold = options.warning_margin + (options.hysteresis if warned else 0.0)
        low = options.warning_margin > 0.0 and not margin >= threshold
        return State.WARNING if low or reading.time_to_exit < options.warning_time else State.INSIDE
