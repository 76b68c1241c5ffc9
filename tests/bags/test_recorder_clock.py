"""Log times in simulated time, between two looks at the simulation's clock."""

from bags.signals.arrivals import LogClock


def test_without_a_simulation_it_is_the_walls_time() -> None:
    assert LogClock().at(123) == 123


def test_between_two_looks_it_goes_on_evenly_and_outside_them_it_is_the_newest() -> None:
    clock = LogClock()
    clock.look(1000, 50)
    assert clock.at(900) == 50
    clock.look(2000, 150)
    assert [clock.at(wall) for wall in (1000, 1500, 2000)] == [50, 100, 150]
    assert clock.at(2100) == 150
    assert clock.at(900) == 150


def test_a_simulation_that_begins_again_takes_log_times_back_with_it() -> None:
    clock = LogClock()
    clock.look(1000, 500)
    clock.look(2000, 0)
    assert clock.at(2000) == 0
