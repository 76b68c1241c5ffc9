"""Copies of a recording under other stamps and names; rest and new trials are none."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid_core.data.calibration import calibration_trials
from nlsid_core.data.shared import shared_stretch
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError


def trial(seed: int, name: str, *, start: float = 0.0, step: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=20), 15)
    y = np.cumsum(0.2 * u) + rng.normal(size=300)
    y[100:160], u[100:160] = 0.0, 0.0  # at rest
    if step:
        y = step * np.round(y / step)
    return Trajectory(
        t=start + 0.5 * np.arange(300), y=y, u=u, name=name, digest=f"sha256:{name:0>64}"
    )


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_a_copy_with_other_stamps_is_found_with_its_times(step: float) -> None:
    train = [trial(1, "a", step=step), trial(2, "b", step=step)]
    copy = replace(train[1].rows(slice(40, 290), "c"), t=7.0 + 0.5 * np.arange(250))
    copy = replace(copy, y=copy.y * (1.0 + 1e-15), digest="")
    found = shared_stretch(train, [trial(3, "d", step=step), copy])
    assert found is not None
    assert (found.name, found.other) == ("c", "b")
    assert found.start - 7.0 == found.other_start - 20.0
    with pytest.raises(DataError, match=r"c has .* samples from .* the same as those of b from"):
        calibration_trials(Dataset(tuple(train)), Dataset((copy,)), least=72)


def test_two_copies_among_the_calibration_trials_are_found() -> None:
    twins = (trial(3, "c"), trial(3, "d", start=10.0))
    with pytest.raises(DataError, match=r"d has .* those of c"):
        calibration_trials(Dataset((trial(1, "a"),)), Dataset(twins), least=72)
    assert shared_stretch(twins, [trial(4, "e")]) is None  # both train: nothing is measured on them


def test_rest_and_other_trials_of_the_same_commands_are_no_copies() -> None:
    first, other = trial(1, "a"), trial(2, "b")
    repeat = replace(first, y=first.y + 1e-3 * np.random.default_rng(0).normal(size=(300, 1)))
    short = first.rows(slice(0, 30), "s")
    still = replace(first, y=np.zeros((300, 1)), name="still")
    twin = replace(still, name="still too")
    assert shared_stretch([first, still], [other, replace(repeat, name="r"), short, twin]) is None
