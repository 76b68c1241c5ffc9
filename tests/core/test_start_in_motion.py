"""Runs of robots that are in motion: the start is bounded, and claims begin when it has faded."""

import math
from typing import Any

import numpy as np
import pytest

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Reading, Status
from nlsid_core.running.start import FADED, start_in_motion
from nlsid_core.running.stepping import Stepper
from tests.core.kernel.tube_claims import MODELS, dataset, design

BOUNDED = ("linear", "quadratic", "moving_lags", "two_outputs", "implicit_box")


def in_range(name: str, rng: np.random.Generator, samples: int) -> FloatArray:
    """Inputs (samples, n_u) that jump between the ends of the model's range and within it."""
    made = design(name)
    model, box = made.model, made.funnel.u_box
    ranges = np.atleast_2d(box if box is not None else model.u_range)
    parts = rng.choice([0.0, 1.0, 0.5], p=[0.45, 0.45, 0.1], size=(samples // 4 + 1, len(ranges)))
    return np.asarray((ranges[:, 0] + parts.repeat(4, axis=0) * np.ptp(ranges, axis=1))[:samples])


@pytest.mark.parametrize("name", BOUNDED)
def test_wherever_the_robot_was_driven_the_start_has_faded_when_claims_begin(name: str) -> None:
    made, rng = design(name), np.random.default_rng(0)
    model, funnel = made.model, made.funnel
    start = start_in_motion(model, [funnel])
    tubes = [tube for tube in funnel.tubes if tube.rho < 1.0]
    largest = 0.0
    for _ in range(10):
        u = in_range(name, rng, 200 + start.samples)
        robot, ours = Stepper(model), Stepper(model)
        lags = funnel.settling
        x = robot.begin(np.zeros((lags, len(robot.y))), u[:lags])[None]
        for now in u[lags:200]:
            _, x = robot.advance(x, now)
        z = start.x[None]
        ours.rest(u[200])
        for k, now in enumerate(u[200:], 1):
            _, x = robot.advance(x, now)
            _, z = ours.advance(z, now)
            part = max(float((x - z)[0] @ t.P @ (x - z)[0]) / t.level for t in tubes)
            largest = max(largest, part)
            assert part <= FADED or k < start.samples
    assert largest > FADED, "else nothing had to fade"


def readings(name: str, centre: Centre, y: FloatArray, u: FloatArray) -> list[Reading]:
    made = design(name)
    monitor = Monitor(made.model, None, made.funnel, centre=centre)
    return [monitor.update(k * made.model.period, y[k], u[k]) for k in range(len(y))]


def moving(name: str, bad: int = 0) -> tuple[Any, ...]:
    """Outputs and inputs of a model's trial from its middle on; the first `bad` outputs are off."""
    trial = dataset(MODELS[name](), 300, 1, 400).trajectories[0]
    y, u = trial.y[100:].copy(), trial.u[100:]
    y[:bad] += 100.0 * design(name).funnel.half_widths
    return y, u


@pytest.mark.parametrize("name", ["linear", "two_outputs", "following"])
def test_a_start_that_is_measured_wrongly_counts_only_where_the_start_is_measured(
    name: str,
) -> None:
    made = design(name)
    samples = start_in_motion(made.model, [made.funnel]).samples
    y, u = moving(name, made.funnel.settling)
    assert samples < len(y)
    measured, faded = (readings(name, c, y, u) for c in (Centre.COMMAND, Centre.MOTION))
    assert Status.ASSUMPTION_VIOLATED in {reading.status for reading in measured}
    assert {reading.status for reading in faded[:samples]} == {Status.UNKNOWN}
    assert faded[0].reason == f"waiting for the first {samples} samples: the start fades"
    assert Status.UNKNOWN not in {reading.status for reading in faded[samples:]}
    if name != "following":
        assert {reading.status for reading in faded[samples:]} == {Status.INSIDE}


def test_outputs_may_be_missing_while_the_start_fades_and_commands_may_not() -> None:
    made = design("linear")
    samples = start_in_motion(made.model, [made.funnel]).samples
    y, u = moving("linear")
    y[3] = math.nan
    assert readings("linear", Centre.MOTION, y, u)[samples].status is Status.INSIDE
    u = u.copy()
    u[3] = math.nan
    said = readings("linear", Centre.MOTION, y, u)
    assert said[samples + 3].reason.endswith("(missing, or not a number): nothing is claimed")
    alone = readings("linear", Centre.MOTION, moving("linear")[0], u)
    assert alone[3].reason.endswith("(missing, or not a number): nothing is claimed")
    assert said[samples + 4].status is Status.INSIDE


@pytest.mark.parametrize("name", ["monotone", "cascade", "implicit_ray"])
def test_a_model_that_states_no_input_range_has_no_bounded_start(name: str) -> None:
    made = design(name)
    with pytest.raises(DataError, match="states no range of its inputs"):
        Monitor(made.model, None, made.funnel, centre=Centre.MOTION)
