"""Alerts: a low margin warns, and what is outside is never anything else."""

import math

import pytest

from nlsid_core.running.alarm import State, state_of
from nlsid_core.running.reading import Reading, Status

ROWS = [
    (Status.INSIDE, 0.5, 0.0, State.INSIDE),
    (Status.INSIDE, 0.1, 0.0, State.INSIDE),
    (Status.INSIDE, 0.3, 0.3, State.INSIDE),
    (Status.INSIDE, 0.29, 0.3, State.WARNING),
    (Status.INSIDE, math.nan, 0.1, State.WARNING),
    (Status.INSIDE, math.nan, 0.0, State.INSIDE),
    *((Status.OUTSIDE, -0.1, margin, State.OUTSIDE) for margin in (0.0, 0.5, 1.0)),
    (Status.ASSUMPTION_VIOLATED, 0.1, 0.5, State.ASSUMPTION_VIOLATED),
    (Status.UNKNOWN, math.nan, 0.5, State.UNKNOWN),
]


@pytest.mark.parametrize(("status", "margin", "warning_margin", "said"), ROWS)
def test_only_a_sample_inside_is_ever_warned_of(
    status: Status, margin: float, warning_margin: float, said: State
) -> None:
    assert state_of(Reading(0.0, status, margin), warning_margin) is said
