"""Clocks, gaps, delays, repeats."""

from pathlib import Path

import numpy as np
import pytest

import bags
from bags.signals.reader import read_signals
from bags.signals.sampling import Grid
from bags.signals.timing import clock_relation, delay
from nlsid_core.data.repeats import same_excitation
from nlsid_core.errors import BagError, DataError
from tests.bag_messages import COMMAND, PERIOD_NS, SPEED, START_NS, speed_bag


def stamps(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.rint(seconds * 1e9).astype(np.int64)


@pytest.mark.parametrize(
    ("offset", "ppm"), [(0.0, 0.0), (-514_944.0, 0.0), (3.0, 40.0), (0.0, -90.0)]
)
def test_offset_and_drift_between_clocks_are_found_under_latency(offset: float, ppm: float) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0, 600, 0.02)
    latency = 0.001 + rng.exponential(0.004, len(t))
    log_ns = stamps(t + latency)
    stamp_ns = stamps(t + offset + 1e-6 * ppm * t)
    found = clock_relation(stamp_ns, log_ns)
    assert found.offset == pytest.approx(offset - 0.001, abs=2e-3)
    assert 1e6 * found.drift == pytest.approx(ppm, abs=2.0)
    assert (found.drift == 0.0) == (ppm == 0.0)
    assert str(found).startswith("one clock") == (abs(offset) < 1.0 and ppm == 0.0)
    assert found.latency == pytest.approx(0.004 * np.log(2), abs=2e-3)


def test_simulated_time_is_told_by_its_pace() -> None:
    t = np.arange(0, 60, 0.02)
    found = clock_relation(np.rint(0.4e9 * t).astype(np.int64), stamps(t))
    assert found.drift == pytest.approx(-0.6)
    assert str(found) == "stamps run at 0.4 times the pace of log time: simulated time?"


@pytest.mark.parametrize("true", [0.0, 0.13, 0.42])
def test_the_delay_of_a_response_is_found(true: float) -> None:
    rng = np.random.default_rng(6)
    t = np.arange(0, 60, 0.01)
    u = np.repeat(rng.standard_normal(200), 30)
    y = np.interp(t - true, t, u) + 0.1 * rng.standard_normal(len(t))
    found = delay(u, y, 0.01, 2.0)
    assert found.seconds == pytest.approx(true, abs=0.01)
    assert found.correlation > 0.9
    assert delay(u, -y, 0.01, 2.0).correlation < -0.9
    with pytest.raises(DataError, match="a constant signal has no delay"):
        delay(u, np.ones(len(u)), 0.01, 2.0)


def test_repeats_are_told_from_steps_of_another_height() -> None:
    step = np.repeat([0.0, 1.0], 50)
    rng = np.random.default_rng(8)
    assert same_excitation(step, step + 0.01 * rng.standard_normal(100))
    assert not same_excitation(step, 1.2 * step)
    assert not same_excitation(step, step[:80])
    assert not same_excitation(np.ones(100), np.ones(100))


def test_stamps_that_go_back_are_sorted_on_request(tmp_path: Path) -> None:
    order = [0, 2, 1, 3]
    times = [START_NS + k * PERIOD_NS for k in order]
    bag = speed_bag(tmp_path / "x", map(float, order), [0.0] * 4, stamps_ns=times)
    with pytest.raises(BagError, match="time goes back"):
        read_signals(bag, [SPEED])
    assert read_signals(bag, [SPEED], sort=True)[SPEED].values.tolist() == [0, 1, 2, 3]


def test_a_bag_with_a_gap_gives_a_trajectory_per_stretch(tmp_path: Path) -> None:
    ticks = [*range(30), *range(50, 90)]
    times = [START_NS + k * PERIOD_NS for k in ticks]
    values = [float(k) for k in ticks]
    bag = speed_bag(tmp_path / "x", values, values, stamps_ns=times)
    options = {"responses": [SPEED], "excitations": [COMMAND]}
    with pytest.raises(DataError, match="a gap of"):
        bags.read([bag], **options)  # type: ignore[arg-type]
    found = bags.read([bag], grid=Grid(split_gaps=True), **options)  # type: ignore[arg-type]
    assert [(trial.name, len(trial)) for trial in found] == [("x.1", 30), ("x.2", 40)]
    np.testing.assert_array_equal(found.trajectories[1].y[:, 0], np.arange(50.0, 90.0))
    np.testing.assert_array_equal(found.trajectories[1].u[:, 0], np.arange(50.0, 90.0))
