"""The examples give what they say they give."""

import pytest

from examples import f1tenth, integrator


@pytest.mark.slow
def test_the_f1tenth_example_reaches_the_published_figures() -> None:
    computed, published = f1tenth.run()
    assert computed["error"] == pytest.approx(published["error"], abs=0.05)
    assert computed["inside"] == published["inside"]


@pytest.mark.slow
def test_displacements_of_new_drives_are_within_what_the_tube_of_the_washed_out_position_says() -> (
    None
):
    computed, bounds = integrator.run()
    assert computed["100 new drives"] < bounds["washed out"] < 0.5 * bounds["velocity"]
