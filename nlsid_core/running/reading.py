"""`Reading`: what a monitor says of one sample, whatever the kind of funnel."""

import math
import re
from collections import deque
from collections.abc import Sequence
from enum import Enum
from typing import Final, NamedTuple

TREND: Final = 10  # samples over which the margin's fall is taken
_NUMBER: Final = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?")


class Status(Enum):
    """What a monitor says of a sample, best to worst."""

    UNKNOWN = "unknown"
    INSIDE = "inside"
    ASSUMPTION_VIOLATED = "assumption violated"
    OUTSIDE = "outside"


class Level(Enum):
    """The best of a funnel's sets that the state is in; only a sampled funnel has all three."""

    GOAL = "goal"
    TUBE = "tube"
    INLET = "inlet"
    NONE = "none"


class Reading(NamedTuple):
    """One sample's verdict; a tuple because a monitor makes one per funnel and sample.

    t: s, the sample's stamp. margin: 1 on the nominal, 0 on the boundary, what rounding could hide
    already taken off; NaN if unknown, -inf if the size is not finite. assumption: the part of what
    the assumption allows that is used, 1 is all of it; NaN if it is not measured. time_to_exit: s
    until the margin is 0 if it goes on falling as it does (no proof); inf if it does not fall.
    worst_axis: the axis nearest its bound, an output or a state. nominal, measured: each measured
    signal, in its unit; nominal is empty if unknown. level: see `Level`. reason: why it is not
    inside, empty if it is. assuming: the assumption in words. deviation: from the nominal, on each
    axis in its unit.
    alarm: a second alarm in words, which is no assumption and changes no status; empty if there is
    none. half_widths: of the tube at this sample, of each measured signal in its unit, where they
    follow the commands; else empty.
    """

    t: float
    status: Status
    margin: float = math.nan
    assumption: float = math.nan
    time_to_exit: float = math.nan
    worst_axis: str = ""
    nominal: tuple[float, ...] = ()
    measured: tuple[float, ...] = ()
    level: Level = Level.NONE
    reason: str = ""
    assuming: str = ""
    deviation: Sequence[float] = ()
    alarm: str = ""
    half_widths: Sequence[float] = ()

    @property
    def waits(self) -> bool:
        """Whether a run is still to begin."""
        return self.status is Status.UNKNOWN and self.reason.startswith("waiting for ")

    @property
    def numbers(self) -> dict[str, float]:
        """What is published of it, by name; `nominal[1]` where several signals are measured."""
        values = {
            "margin": self.margin,
            "assumption": self.assumption,
            "time_to_exit": self.time_to_exit,
        }
        for i, measured in enumerate(self.measured):
            which = f"[{i}]" if len(self.measured) > 1 else ""
            values[f"nominal{which}"] = self.nominal[i] if self.nominal else math.nan
            values[f"measured{which}"] = measured
        return values


class Trend:
    """How a run's margin falls over the last samples."""

    def __init__(self) -> None:
        self._margins: deque[tuple[float, float]] = deque(maxlen=TREND)

    def exit_after(self, t: float, margin: float) -> float:
        """S until the margin, now at t s, is 0 if it goes on falling as it did; else inf."""
        before, earlier = self._margins[0] if self._margins else (t, margin)
        self._margins.append((t, margin))
        if not margin > 0.0:
            return 0.0
        return margin * (t - before) / (earlier - margin) if earlier > margin else math.inf


def cause(text: str) -> str:
    """A reason without its numbers: a cause that lasts is one, whatever time it names."""
    return _NUMBER.sub("#", text)


def unsaid(value: object) -> str:
    """Why an input is none, for people; NaN stands for one that did not come too."""
    return "missing, or not a number" if value is None or value != value else f"it is {value}"
