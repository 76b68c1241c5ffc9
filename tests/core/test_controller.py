"""The controller in the loop with simulated plants, without ROS."""

import numpy as np
import pytest

from nlsid_core.data.trajectory import Dataset
from nlsid_core.design import OutputTube, OutputTubeDesign, design_output_tube
from nlsid_core.errors import DataError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.plants import ModelPlant
from nlsid_core.running.reading import Reading, Status
from tests.conftest import PERIOD

WIDE = Limits(lowest=-10.0, highest=10.0, stop_rate=1.0)


@pytest.fixture(scope="module")
def moving(design: OutputTubeDesign, train: Dataset) -> OutputTubeDesign:
    """A tube that starts at a speed, so that the policy may also take input away."""
    profile = [(0.0, 0.3), (2.0, 0.3), (5.0, 0.5), (7.0, 0.5)]
    return design_output_tube(
        OutputTube(design.model, train, profile=profile, horizon=7.0, inlet=0.02)
    )


def closed_loop(
    design: OutputTubeDesign, *, noise: float, push: float
) -> tuple[Controller, list[Reading]]:
    """A run on the design's own model, pushed for four samples in the middle."""
    plant = ModelPlant(design.model)
    controller = design.controller(WIDE, 30.0)
    monitor = design.monitor(centre=Centre.PROFILE)
    rng = np.random.default_rng(4)
    n = len(design.model)
    history: list[tuple[float, float]] = []
    readings: list[Reading] = []
    k = 0
    while not controller.ended:
        u, index = controller.u, controller.k
        y = float(plant.measure(np.array([u]))[0]) + noise * rng.standard_normal()
        plant.step(np.array([u]), np.array([push if 20 <= index < 24 else 0.0]))
        if index == 0:
            for j in range(n):
                monitor.update((k - n + j) * PERIOD, *history[j - n])
        if index >= 0:
            readings.append(monitor.update(k * PERIOD, y, u))
        history.append((y, u))
        controller.update(k * PERIOD, y)
        k += 1
    return controller, readings


def test_the_monitor_finds_every_input_to_be_the_policys(moving: OutputTubeDesign) -> None:
    controller, readings = closed_loop(moving, noise=0.002, push=0.0)
    assert controller.ended == "the plan is over"
    assert moving.policy is not None
    assert len(readings) == len(moving.policy)
    assert {reading.status for reading in readings} == {Status.INSIDE}


def test_a_push_beyond_the_budget_is_seen_as_one(moving: OutputTubeDesign) -> None:
    _, readings = closed_loop(moving, noise=0.002, push=2.0)
    worst = min(readings, key=lambda reading: reading.margin)
    assert worst.status is Status.OUTSIDE
    assert "above the level" in worst.reason


def test_stopping_is_no_faster_than_allowed_and_arrives() -> None:
    limits = Limits(lowest=-1.0, highest=1.0, stop_rate=2.0, stop_at=0.25)
    inputs = [1.0]
    while inputs[-1] != 0.25:
        inputs.append(limits.towards_stop(inputs[-1], 0.1))
    assert np.abs(np.diff(inputs)).max() <= 0.2 + 1e-12
    assert len(inputs) == 5
    assert limits.towards_stop(-1.0, 0.1) == pytest.approx(-0.8)


def test_each_input_has_limits_and_a_rest_of_its_own() -> None:
    limits = Limits(
        lowest=np.array([0.0, -2.0]),
        highest=np.array([1.0, 2.0]),
        stop_rate=np.array([1.0, 4.0]),
        stop_at=np.array([0.5, 0.0]),
    )
    np.testing.assert_array_equal(limits.clip(np.array([-1.0, 3.0])), [0.0, 2.0])
    np.testing.assert_allclose(limits.towards_stop(np.array([1.0, -2.0]), 0.1), [0.9, -1.6])
    np.testing.assert_array_equal(limits.towards_stop(np.array([0.55, 0.1]), 0.1), [0.5, 0.0])
    assert limits.at_rest(np.array([0.5, 0.0]))
    assert not limits.at_rest(np.array([0.5, 0.1]))


@pytest.mark.parametrize(
    ("lowest", "highest", "rate"),
    [
        (1, 0, 1),
        (1, 2, 1),
        (-1, 1, 0),
        (np.array([-1.0, 1.0]), 2, 1),
        (np.array([-1.0, -1.0]), np.array([1.0, 1.0, 1.0]), 1),
        (-1, 1, np.array([1.0, 0.0])),
    ],
)
def test_limits_that_make_no_sense_are_refused(lowest: float, highest: float, rate: float) -> None:
    with pytest.raises(DataError, match="limits"):
        Limits(lowest=lowest, highest=highest, stop_rate=rate)
