"""What holds at run time for every kind of design with a policy: its monitor, its controller."""

import math
import re
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from nlsid import Monitor, Status
from nlsid_core.design import OutputTubeDesign
from nlsid_core.errors import CertificateMismatch, DataError, ShapeError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.held import Held
from nlsid_core.running.stage import Stage
from tests.continuous_stage import stage
from tests.tracked import PERIOD, designed

WIDE = Limits(lowest=-10.0, highest=10.0, stop_rate=50.0)


class Run(NamedTuple):
    """A stage, and the outputs or states and inputs of a run as it should be.

    Its first `lead` samples only start the observer. others: parts of other designs.
    """

    stage: Stage
    period: float
    y: list[Any]
    u: list[Any]
    others: list[Stage]
    lead: int = 0

    def watched(self, samples: int) -> Monitor:
        """A monitor that has seen so many."""
        centre = Centre.PROFILE if self.lead else Centre.COMMAND
        monitor = Monitor([self.stage], centre=centre)
        for k in range(samples):
            reading = monitor.update(k * self.period, self.y[k], self.u[k])
            assert reading.status is (Status.INSIDE if k >= self.lead else Status.UNKNOWN)
        return monitor

    def controller(self, limits: Limits = WIDE, patience: float = 1.0) -> Controller:
        return Controller(self.stage, limits, patience)


def tube(design: OutputTubeDesign) -> Run:
    """Around a plan."""
    model, policy, funnel = design.model, design.policy, design.funnel
    assert policy is not None
    y, rest = policy.plan(model).y, [policy.u[0]] * len(model)
    others = [
        Stage(model, replace(policy, K=2.0 * policy.K), funnel),
        Stage(replace(model, c=1.0), policy, funnel),
        Stage(replace(model, c=1.0), None, funnel),
    ]
    stated = Stage(model, policy, funnel)
    return Run(stated, model.period, [*y[:1], *y[:1], *y], [*rest, *policy.u], others, len(model))


def sampled(_: OutputTubeDesign) -> Run:
    """Of a measured state."""
    made = designed()
    others = [
        Stage(made.model, replace(made.policy, K=2.0 * made.policy.K), made.funnel),
        Stage(replace(made.model, period=0.03), made.policy, made.funnel),
    ]
    stated = Stage(made.model, made.policy, made.funnel)
    return Run(stated, PERIOD, [*made.policy.x], [*made.policy.u, np.zeros(1)], others)


def continuous(_: OutputTubeDesign) -> Run:
    """Whose input is held."""
    field, policy, funnel = stage()
    held = Held(0.02)
    others = [
        Stage(field, stage(limit=2.0)[1], funnel, held),
        Stage(replace(field, expansion="another"), policy, funnel, held),
    ]
    x = [np.array([0.02 * k]) for k in range(51)]
    return Run(Stage(field, policy, funnel, held), 0.02, x, [np.ones(1)] * 51, others)


KINDS = {"tube": tube, "sampled": sampled, "continuous": continuous}


@pytest.fixture(params=KINDS)
def run(request: pytest.FixtureRequest, design: OutputTubeDesign) -> Run:
    return KINDS[request.param](design)


def test_a_run_as_it_should_be_is_inside_until_the_proof_is_over(run: Run) -> None:
    samples = len(run.y)
    monitor = run.watched(samples)
    after = monitor.update(samples * run.period, run.y[-1], run.u[-1])
    assert after.status is Status.UNKNOWN
    assert "the proof covers" in after.reason


@pytest.mark.parametrize(
    ("when", "what", "reason"),
    [
        (5.0, "state", r"nan\]? at t ="),
        (5.0, "input", "no "),
        (5.0, "no input", "no "),
        (math.nan, "", "stamp is nan"),
        (6.0, "", "of the run is missing"),
        (5.4, "", "from when the next one"),
        (4.0, "", "time went back"),
        (1.0, "", "time went back"),
    ],
)
def test_a_sample_that_cannot_be_judged_ends_the_run(
    run: Run, when: float, what: str, reason: str
) -> None:
    monitor, y, u = run.watched(5), run.y[5], run.u[5]
    u = {"input": math.nan * u, "no input": None}.get(what, u)
    bad = monitor.update(when * run.period, math.nan * y if what == "state" else y, u)
    later = monitor.update(6 * run.period, run.y[6], run.u[6])
    for reading in (bad, later):
        assert reading.status is Status.UNKNOWN
        assert math.isnan(reading.margin)
        assert re.search(reason, reading.reason)
    monitor.restart()
    for k in range(5):
        reading = monitor.update((9 + k) * run.period, run.y[k], run.u[k])
    assert reading.status is Status.INSIDE


def test_another_input_than_the_policys_breaks_the_assumption(run: Run) -> None:
    reading = run.watched(5).update(5 * run.period, run.y[5], run.u[5] + 0.05)
    assert reading.status is Status.ASSUMPTION_VIOLATED
    assert "is not the policy's" in reading.reason


@pytest.mark.parametrize("run", ["tube"], indirect=True)
def test_an_input_beyond_the_range_of_the_model_breaks_the_assumption(run: Run) -> None:
    reading = run.watched(5).update(5 * run.period, run.y[5], 9.0)
    assert reading.status is Status.ASSUMPTION_VIOLATED
    assert "outside the fitted range" in reading.reason


def test_parts_that_do_not_belong_together_are_refused(run: Run) -> None:
    for i, other in enumerate(run.others):
        with pytest.raises(
            CertificateMismatch, match=("another policy", "for another model")[i > 0]
        ):
            Monitor([other])


@pytest.mark.parametrize("run", ["sampled", "continuous"], indirect=True)
def test_a_state_of_another_size_is_an_error(run: Run) -> None:
    with pytest.raises(ShapeError):
        run.watched(0).update(0.0, np.zeros(3), run.u[0])


def test_limits_of_another_number_of_inputs_are_refused_before_anything_moves(run: Run) -> None:
    two = Limits(lowest=np.array([-9.0, -9.0]), highest=9.0, stop_rate=1.0)
    with pytest.raises(DataError, match="limits for 2 inputs; the design has 1"):
        run.controller(two)


def test_limits_that_cut_off_the_plan_are_refused_before_anything_moves(run: Run) -> None:
    with pytest.raises(DataError, match=r"plan's input .* is beyond the limits"):
        run.controller(Limits(lowest=-0.1, highest=0.1, stop_rate=1.0))


def test_a_robot_away_from_the_start_is_waited_for_and_then_given_up(run: Run) -> None:
    controller = run.controller(patience=5 * run.period)
    for k in range(12):
        assert not controller.k >= 0
        controller.update(k * run.period, run.y[0] + 1.5)
    assert f"not at the start of the plan after {5 * run.period:g} s" in controller.ended


@pytest.mark.parametrize(
    ("when", "reason"),
    [
        (3.0, r"nan\]? at t ="),
        (4.0, "is missing"),
        (3.5, "from when the next one"),
        (0.5, "time went back"),
    ],
)
def test_a_sample_that_cannot_be_used_keeps_the_input_and_ends_the_run(
    run: Run, when: float, reason: str
) -> None:
    controller = run.controller()
    for k in range(3):
        controller.update(k * run.period, run.y[k])
    before, y = controller.u, run.y[3] * (math.nan if when == 3.0 else 1.0)
    np.testing.assert_array_equal(controller.update(when * run.period, y), before)
    assert re.search(reason, controller.ended)
