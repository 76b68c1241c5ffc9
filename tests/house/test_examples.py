"""The examples give what they say they give."""

import pytest

from examples import f1tenth


def test_the_f1tenth_example_reaches_the_published_figures() -> None:
    computed, published = f1tenth.run()
    assert computed["error"] == pytest.approx(published["error"], abs=0.05)
    assert computed["inside"] == published["inside"]
