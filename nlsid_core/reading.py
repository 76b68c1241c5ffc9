"""What a monitor says of one sample."""

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, TypeAlias


class Status(Enum):
    """What a reading says, best to worst."""

    UNKNOWN = "unknown"
    INSIDE = "inside"
    ASSUMPTION_VIOLATED = "assumption violated"
    OUTSIDE = "outside"


class Nominal(Enum):
    """What the tube is around: the model driven by the received commands, or the policy's plan."""

    COMMAND = "command"
    PROFILE = "profile"


class Reading(NamedTuple):
    """One sample's verdict; a tuple because a monitor makes one per funnel and sample.

    t: s, the sample's stamp. margin: 1 - √((V + e²)/level), 1 on the nominal, 0 on the boundary of
    the tube, NaN if unknown. worst_axis: the axis nearest its bound: `speed +2`, what the past says
    of the speed two samples ahead, or `innovation`. budget_spent: Σe² so far over the budget, 1 is
    all of it. nominal, measured: the output, in its unit. reason: why it is not inside, empty if it
    is.
    """

    t: float
    status: Status
    margin: float = math.nan
    worst_axis: str = ""
    budget_spent: float = math.nan
    nominal: float = math.nan
    measured: float = math.nan
    reason: str = ""

    @property
    def numbers(self) -> dict[str, float]:
        """What is published of it, by name."""
        return {
            "margin": self.margin,
            "budget_spent": self.budget_spent,
            "nominal": self.nominal,
            "measured": self.measured,
        }


class Level(Enum):
    """The best of the three sets of a discrete funnel that the state is in."""

    GOAL = "goal"
    TUBE = "tube"
    INLET = "inlet"
    NONE = "none"


@dataclass(frozen=True)
class TrackingReading:
    """One sample's verdict on a discrete funnel.

    t: s. margin: 1 - |S x̄|/radius, 1 on the nominal, 0 on the tube's boundary, NaN if unknown.
    disturbance: the assumption's own quantity over its bound; above 1 it is violated. level:
    `tube`; `inlet` if the state left the tube but can still reach the goal; `goal` at the end.
    time_to_exit: s until the margin is zero if it goes on falling as it did (no proof); infinite if
    it does not fall. worst_axis: the state furthest out relative to the tube. reason: why the
    status is not inside. deviation: x̂ - x_k, each state in its unit; empty if unknown.
    """

    t: float
    status: Status
    margin: float = math.nan
    disturbance: float = math.nan
    level: Level = Level.NONE
    time_to_exit: float = math.nan
    worst_axis: str = ""
    reason: str = ""
    deviation: tuple[float, ...] = ()

    @property
    def numbers(self) -> dict[str, float]:
        """What is published of it, by name."""
        return {"margin": self.margin, "disturbance": self.disturbance}


AnyReading: TypeAlias = Reading | TrackingReading
