"""Log times in simulated time, between two looks at the simulation's clock."""

from bags.signals.recording import LogClock


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
