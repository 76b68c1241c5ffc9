"""Repeats that are repeats, and repeats that are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from nlsid import Dataset, Degrees, Polynomial, Trajectory
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.polynomial.moment_rie import identify_from_repeats
from nlsid_core.identification.polynomial.moments import offsets_of, repeated_moments
from nlsid_core.identification.repeats import compare_repeats
from tests.repeated import CLASS, OFFSETS, pair


def test_repeats_pass_and_what_is_not_a_repeat_is_named() -> None:
    first, second = pair(1500, 1)
    assert not compare_repeats(first, second)
    other = pair(1500, 2)[1]
    late = replace(second, y=np.roll(second.y, 1))
    stronger = replace(second, y=1.15 * second.y)
    for stranger, reason in (
        (other, "excitations differ"),
        (late, "correlates"),
        (stronger, "correlates"),
    ):
        assert reason in compare_repeats(first, stranger)
        data = Dataset((first, replace(stranger, group=first.group)))
        with pytest.raises(DataError, match="are not repeats"):
            identify_from_repeats(data, CLASS)


def test_true_repeats_are_hardly_ever_refused() -> None:
    assert not any(compare_repeats(*pair(400, seed)) for seed in range(60))


def test_coloured_noise_and_excitation_do_not_look_like_a_false_repeat() -> None:
    refused = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        w, *noises = (lfilter([1.0], [1.0, -0.95], rng.standard_normal(1000)) for _ in range(3))
        t = 0.01 * np.arange(1000)
        runs = [Trajectory(t=t, y=w + noise, u=w, name=str(k)) for k, noise in enumerate(noises)]
        refused += compare_repeats(*runs) != ""
    assert refused <= 1


def test_unusable_repeats_say_what_is_wrong() -> None:
    first, second = pair(400, 1)
    alone = Dataset((replace(first, group=""), replace(second, group="")))
    with pytest.raises(DataError, match="share a `group`"):
        identify_from_repeats(alone, CLASS)
    with pytest.raises(DataError, match="two repeats"):
        repeated_moments([[first]], CLASS, OFFSETS)
    with pytest.raises(DataError, match="common samples"):
        compare_repeats(*pair(50, 1))
    short = pair(2, 1)
    with pytest.raises(DataError, match="needed"):
        repeated_moments([short], CLASS, OFFSETS)
    with pytest.raises(ShapeError, match="one output"):
        offsets_of([replace(first, y=np.zeros((400, 2)), y_names=(), y_units=(), y_paths=())])
    with pytest.raises(DataError, match="left is 2"):
        Polynomial(1, (0,), Degrees(left=2), set="3.8")
