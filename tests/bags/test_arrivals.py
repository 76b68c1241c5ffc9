"""What publishers count, the ring of the last seconds, and log times in simulated time."""

from pathlib import Path

import numpy as np
import pytest

from bags.recordings.bag import Bag
from bags.recordings.quality import LATCHED
from bags.signals.publishers import counted_in_turn
from bags.signals.recording import Arrival, LogClock, Recent
from bags.signals.timing import Sequence
from tests.bag_messages import CMD, CMD_TYPE, START_NS, command


def test_a_publishers_count_tells_what_is_missing_until_there_is_another_publisher() -> None:
    sequence = Sequence()
    for number in (7, 8, 11, 12, 20):
        sequence.update(number)
    assert sequence.missing == 2 + 7
    for number in (5, 6, 8):  # it came back, and was heard from its fifth message on
        sequence.update(number)
    assert sequence.missing == 2 + 7 + 1
    assert not sequence.mixed
    for number in (300, 9, 301, 10):  # another one beside it
        sequence.update(number)
    assert sequence.mixed


@pytest.mark.parametrize(
    ("numbers", "alternates"),
    [
        ([1, 1, 2, 2, 3, 3, 4, 4], True),
        ([7] * 6, False),
        ([1, 9, *range(2, 500), 1], False),  # one sent a message, and long after it one came back
    ],
)
def test_counts_in_step_are_of_two_publishers_unless_the_middleware_does_not_count(
    numbers: list[int], alternates: bool
) -> None:
    sequence = Sequence()
    for number in numbers:
        sequence.update(number)
    assert sequence.alternates == alternates
    assert bool(counted_in_turn(np.array(numbers))) == alternates


def test_the_last_seconds_are_kept_and_nothing_older(tmp_path: Path) -> None:
    recent = Recent(2.0)
    for k in range(100):
        at = START_NS + k * 10**8
        recent.add(Arrival(CMD, CMD_TYPE, command(at, float(k)), at, at))
    assert recent.save(tmp_path / "snapshot", offered={CMD: (LATCHED,)}) == 21
    with Bag(tmp_path / "snapshot") as bag:
        assert bag.offered(CMD) == (LATCHED,)
        data = [message.data for message in bag.messages()]
    assert data == [command(START_NS + k * 10**8, float(k)) for k in range(79, 100)]


# -- Log times in simulated time, between two looks at the simulation's clock


def test_without_a_simulation_it_is_the_walls_time() -> None:
    assert LogClock().at(123) == 123


def test_it_goes_on_evenly_between_two_looks_and_before_the_first_and_ends_at_the_newest() -> None:
    clock = LogClock()
    clock.look(1000, 50)
    assert (clock.at(900), clock.goes) == (50, False)
    clock.look(2000, 150)
    assert [clock.at(wall) for wall in (1000, 1500, 2000)] == [50, 100, 150]
    assert [clock.at(wall) for wall in (900, 2100)] == [40, 150]
    assert clock.at(0) == 0, "a simulation has no time before it began"


def test_a_message_that_waited_for_many_looks_is_not_logged_after_later_ones() -> None:
    clock = LogClock()
    for wall, simulated in ((1000, 0), (2000, 500), (3000, 510), (4000, 600)):
        clock.look(wall, simulated)
    logged = list(map(clock.at, range(1000, 4000, 100)))
    assert logged == sorted(logged)
    assert clock.at(1500) == 250


def test_a_simulation_that_begins_again_takes_log_times_back_with_it() -> None:
    clock = LogClock()
    clock.look(1000, 500)
    clock.look(2000, 0)
    assert clock.at(2000) == 0
