"""The tube holds in simulation when its assumption does; the monitor and its alarm say when not."""

import math

import numpy as np
import pytest

from nlsid import Dataset, Monitor, OutputTube, Status
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.running.alarm import State, state_of
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading
from tests.conftest import PERIOD

ROUNDING = 1e-9  # relative: the monitor evaluates in floating point


def make_monitor(design: OutputTubeDesign, centre: Centre = Centre.COMMAND) -> Monitor:
    return design.monitor(centre=centre)


def run(design: OutputTubeDesign, y: np.ndarray, u: np.ndarray) -> list[Reading]:
    monitor = make_monitor(design)
    return [monitor.update(k * PERIOD, y[k], u[k]) for k in range(len(y))]


def test_the_worst_disturbance_nearly_reaches_the_boundary(
    design: OutputTubeDesign, train: Dataset
) -> None:
    prediction = design_output_tube(
        OutputTube(
            design.model, train, profile=[(0.0, 0.0), (7.0, 0.5)], horizon=7.0, lqr_weights=None
        )
    )
    model, tube, samples = prediction.model, prediction.funnel.tubes[1], 70
    L = tube.L[:, 0]
    response = [1.0] + [float((np.linalg.matrix_power(model.A, k) @ L)[0]) for k in range(samples)]
    worst = np.array(response[:samples][::-1])  # matched to the output at the last sample
    worst *= math.sqrt(tube.level / np.sum(worst**2))
    x = np.zeros(len(model))
    for innovation in worst:
        output = x[0] + innovation
        x = model.A @ x + L * innovation
    assert 0.97 < output / tube.half_widths[0] <= 1


def test_a_sensor_that_reads_60_percent_is_caught_and_named(
    design: OutputTubeDesign, train: Dataset
) -> None:
    for trial in train:
        readings = run(design, 0.6 * trial.y[:, 0], trial.u[:, 0])
        bad = next(r for r in readings if r.status in (Status.OUTSIDE, Status.ASSUMPTION_VIOLATED))
        assert "above the level" in bad.reason
        assert f"t = {bad.t:g} s" in bad.reason


def test_outside_always_comes_with_a_violated_assumption(
    design: OutputTubeDesign, train: Dataset
) -> None:
    trial = train.trajectories[0]
    for scale in np.linspace(0.0, 2.0, 21):
        for reading in run(design, scale * trial.y[:, 0], trial.u[:, 0]):
            if reading.status is Status.OUTSIDE:
                assert "although" not in reading.reason


def test_a_missing_state_ends_a_run_around_the_plan(design: OutputTubeDesign) -> None:
    monitor = make_monitor(design, Centre.PROFILE)
    reading = monitor.missing(1.0, "no speed for 0.1 s")
    assert (reading.status, reading.reason) == (Status.UNKNOWN, "no speed for 0.1 s")
    assert monitor.update(2.0, 0.0, 0.0).status is Status.UNKNOWN


def test_around_the_simulation_the_tube_goes_on_after_the_plan(
    design: OutputTubeDesign, train: Dataset
) -> None:
    trial = train.trajectories[0]
    readings = run(design, trial.y[:, 0], trial.u[:, 0])
    assert len(readings) > design.funnel.settling + 70
    assert {r.status for r in readings[design.funnel.settling :]} == {Status.INSIDE}


# -- Alerts: a low margin warns, and what is outside is never anything else

ROWS = [
    (Status.INSIDE, 0.5, 0.0, State.INSIDE),
    (Status.INSIDE, 0.1, 0.0, State.INSIDE),
    (Status.INSIDE, 0.3, 0.3, State.INSIDE),
    (Status.INSIDE, 0.29, 0.3, State.WARNING),
    (Status.INSIDE, math.nan, 0.1, State.WARNING),
    (Status.INSIDE, math.nan, 0.0, State.INSIDE),
    *((Status.OUTSIDE, -0.1, margin, State.OUTSIDE) for margin in (0.0, 0.5, 1.0)),
    (Status.ASSUMPTION_VIOLATED, 0.1, 0.5, State.ASSUMPTION_VIOLATED),
    (Status.UNKNOWN, math.nan, 0.5, State.UNKNOWN),
]


@pytest.mark.parametrize(("status", "margin", "warning_margin", "said"), ROWS)
def test_only_a_sample_inside_is_ever_warned_of(
    status: Status, margin: float, warning_margin: float, said: State
) -> None:
    assert state_of(Reading(0.0, status, margin), warning_margin) is said
