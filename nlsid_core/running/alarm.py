"""What is said of the robot after a reading: its status, or a warning before it is too late."""

from enum import Enum

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


def state_of(reading: Reading, warning_margin: float = 0.0) -> State:
    """What is said of the robot: a sample inside with a margin below `warning_margin` is warned of.

    0 warns of none; a margin that is no number is below any other.
    """
    if reading.status is not Status.INSIDE:
        return State(reading.status.value)
    warned = warning_margin > 0.0 and not reading.margin >= warning_margin
    return State.WARNING if warned else State.INSIDE
