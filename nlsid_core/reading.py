"""What a monitor says of one sample."""

import math
from enum import Enum
from typing import NamedTuple


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
