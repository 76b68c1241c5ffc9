"""Alerts: worse is said at once, better may have to wait, and outside is never anything else."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlsid_core.errors import DataError
from nlsid_core.running.alarm import Alarm, AlarmOptions, State
from nlsid_core.running.reading import Reading, Status


def reading(k: int, margin: float, *, violated: bool = False) -> Reading:
    """Sample k at 10 Hz."""
    status = Status.ASSUMPTION_VIOLATED if violated else Status.INSIDE
    return Reading(0.1 * k, Status.OUTSIDE if margin < 0 else status, margin)


def states(alarm: Alarm, margins: list[float]) -> list[State]:
    return [alarm.update(reading(k, margin)) for k, margin in enumerate(margins)]


def test_without_options_an_alert_is_the_reading() -> None:
    alarm = Alarm()
    assert states(alarm, [0.9, 0.1, -0.1, 0.1]) == [
        State.INSIDE,
        State.INSIDE,
        State.OUTSIDE,
        State.INSIDE,
    ]
    assert alarm.update(reading(4, 0.5, violated=True)) is State.ASSUMPTION_VIOLATED
    assert alarm.update(Reading(0.5, Status.UNKNOWN)) is State.UNKNOWN


def test_a_low_margin_warns_and_hysteresis_keeps_the_warning() -> None:
    alarm = Alarm(AlarmOptions(warning_margin=0.3, hysteresis=0.1))
    assert states(alarm, [0.5, 0.29, 0.35, 0.41]) == [
        State.INSIDE,
        State.WARNING,
        State.WARNING,
        State.INSIDE,
    ]


def test_better_must_last_and_worse_is_said_at_once() -> None:
    alarm = Alarm(AlarmOptions(clear_after=0.25))
    assert states(alarm, [0.5, -0.1, 0.2, 0.2, -0.1, 0.2, 0.2, 0.2, 0.2]) == [
        State.INSIDE,
        State.OUTSIDE,
        State.OUTSIDE,
        State.OUTSIDE,
        State.OUTSIDE,
        State.OUTSIDE,
        State.OUTSIDE,
        State.OUTSIDE,
        State.INSIDE,
    ]


def test_an_exit_that_is_predicted_soon_is_a_warning() -> None:
    alarm = Alarm(AlarmOptions(warning_time=0.35))
    said = [
        alarm.update(reading(k, 0.5)._replace(time_to_exit=seconds))
        for k, seconds in enumerate((math.inf, 0.4, 0.3, 0.4))
    ]
    assert said == [State.INSIDE, State.INSIDE, State.WARNING, State.INSIDE]


def test_a_margin_that_is_no_number_is_a_warning_where_one_is_asked_for() -> None:
    alarm = Alarm(AlarmOptions(warning_margin=0.1))
    assert alarm.update(reading(0, math.nan)) is State.WARNING


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=40),
    st.builds(
        AlarmOptions,
        warning_margin=st.floats(0.0, 1.0),
        warning_time=st.floats(0.0, 1.0),
        hysteresis=st.floats(0.0, 1.0),
        clear_after=st.floats(0.0, 1.0),
    ),
)
def test_no_option_makes_a_sample_outside_anything_else(
    margins: list[float], options: AlarmOptions
) -> None:
    for margin, state in zip(margins, states(Alarm(options), margins), strict=True):
        if margin < 0:
            assert state is State.OUTSIDE


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_options_that_make_no_sense_are_refused(value: float) -> None:
    with pytest.raises(DataError, match=r"clear_after is .*; it should be finite"):
        AlarmOptions(clear_after=value)
