"""Continuous funnels at run time: held inputs, stages, the end; the same Monitor and Controller."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bags.designs.wiring import read_at, wiring_of
from bags.monitoring.replay import replay_messages
from bags.monitoring.watch import Watch
from nlsid import Design, Monitor, Status, VectorField
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import CertificateMismatch, DataError
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.held import Held
from nlsid_core.running.stage import Stage
from tests.continuous_stage import stage, write_run

HELD = 0.02  # s
LIMITS = Limits(lowest=-20.0, highest=20.0, stop_rate=1.0)


def driven(
    controller: Controller, monitor: Monitor, start: float, *, push: float = 0.0
) -> tuple[list[FloatArray], list[Status]]:
    """The exact solution of ẋ = u between samples, inputs held, until the controller ends."""
    x, said, states = np.array([start]), [], []
    for k in range(200):
        u = controller.update(k * HELD, x)
        states.append(x)
        said.append(monitor.update(k * HELD, x, u).status)
        if controller.ended:
            break
        x = x + HELD * u + (push if k == 20 else 0.0)
    return states, said


def test_a_held_policy_stays_inside_and_ends_before_an_input_would_act_beyond_the_proof() -> None:
    field, policy, funnel = stage()
    controller = Controller(Stage(field, policy, funnel, Held(HELD)), LIMITS, 1.0)
    monitor = Monitor([Stage(field, policy, funnel, Held(HELD))])
    states, said = driven(controller, monitor, 0.15)
    assert set(said) == {Status.INSIDE}
    assert controller.ended == "the proof is over"
    assert len(states) == round(1.0 / HELD) + 1, "the last input acts until the end"
    for k, x in enumerate(states):
        radius = math.sqrt(np.interp(k * HELD, funnel.t, funnel.rho))
        assert abs(x[0] - k * HELD) <= radius


def test_a_reading_says_that_the_input_is_held_and_that_nothing_measures_it() -> None:
    field, policy, funnel = stage()
    x = np.array([0.1])
    reading = Monitor([Stage(field, policy, funnel, Held(HELD))]).update(0.0, x, policy(0.0, x))
    assert (
        reading.assuming == "the policy is applied continuously; here each input is held for 0.02 s"
    )
    assert math.isnan(reading.assumption)
    assert reading.margin == pytest.approx(0.5)
    assert (reading.worst_axis, reading.nominal, reading.measured) == ("x0", (0.0,), (0.1,))
    pushed = VectorField.from_function(lambda x, u, w: [u[0] + w[0]], 1, 1, uncertain=[[-1.0, 1.0]])  # noqa: ARG005
    policy = replace(policy, vector_field=files.digest(pushed.document()))
    funnel = replace(
        funnel, vector_field=policy.vector_field, policy=files.digest(policy.document())
    )
    reading = Monitor([Stage(pushed, policy, funnel, Held(HELD))]).update(0.0, x, policy(0.0, x))
    assert reading.assuming.endswith("held for 0.02 s, and w stays in its box")


def test_a_proved_hold_is_measured_and_nothing_slower_is_run() -> None:
    field, policy, funnel = stage()
    proved = Stage(field, policy, funnel, Held.of_claim({"hold": 0.025}, HELD))
    monitor = Monitor([proved])
    for k, (t, used) in enumerate([(0.0, 0.0), (HELD, 0.8), (2.24 * HELD, 0.992)]):
        reading = monitor.update(t, [t], policy(t, np.array([t])))
        assert (reading.status, reading.assuming) == (
            Status.INSIDE,
            "each input is at most 0.025 s old",
        ), k
        assert reading.assumption == pytest.approx(used)
    monitor = Monitor([proved])
    for t in (0.0, 0.8 * HELD, 2.2 * HELD):  # on the grid, and the last 0.028 s apart
        reading = monitor.update(t, [t], policy(t, np.array([t])))
    assert reading.status is Status.ASSUMPTION_VIOLATED
    said = "held for 0.028 s at t = 0.044 s; proved for 0.025 s"
    assert said in reading.reason
    controller = Controller(proved, LIMITS, 1.0)
    for t in (0.0, 0.8 * HELD, 2.2 * HELD):
        assert controller.ended == ""
        controller.update(t, np.array([t]))
    assert said in controller.ended


@pytest.mark.parametrize("last", [2.2 * HELD, 3.8 * HELD, 1.3 * HELD])
def test_within_a_hold_samples_come_at_any_time_and_may_be_lost_but_not_twice(last: float) -> None:
    proved = Stage(*stage(), Held.of_claim({"hold": 0.05}, HELD))
    controller, monitor = Controller(proved, LIMITS, 1.0), Monitor([proved])
    for t in (0.0, 0.6 * HELD, 1.4 * HELD, last):
        x = np.array([t])
        reading = monitor.update(t, x, controller.update(t, x))
    back = last < 1.4 * HELD
    assert reading.status is (Status.UNKNOWN if back else Status.INSIDE)
    assert ("time went back" in controller.ended) == back


@pytest.mark.parametrize("period", [0.03, 0.025, 0.0201])
def test_a_hold_without_room_for_a_late_sample_is_refused_and_what_is_advised_is_not(
    period: float,
) -> None:
    with pytest.raises(DataError, match=rf"every {period} s.*inputs of at most 0.025 s") as refusal:
        Held(period, 0.025)
    advised = re.search(r"sample every (\S+) s, or design it with hold=(\S+)$", str(refusal.value))
    assert advised
    Held(float(advised[1]), 0.025)
    Held(period, float(advised[2]))


def test_a_state_that_may_be_wrong_is_inside_only_if_all_that_it_may_be_is() -> None:
    field, policy, funnel = stage()
    held = Held(HELD, error=np.array([0.03]))
    for x, status in ((0.16, Status.INSIDE), (0.18, Status.OUTSIDE)):
        monitor = Monitor([Stage(field, policy, funnel, held)])
        reading = monitor.update(0.0, [x], policy(0.0, np.array([x])))
        assert (reading.status, x) == (status, x)
        assert reading.margin == pytest.approx(1 - (x + 0.03) / 0.2)
        assert reading.assuming.endswith("measured to: x0 within 0.03")
    controller = Controller(Stage(field, policy, funnel, held), LIMITS, 0.05)
    for k in range(5):
        controller.update(k * HELD, np.array([0.18]))
    assert "not at the start of the plan" in controller.ended


def test_a_push_is_outside() -> None:
    field, policy, funnel = stage()
    controller = Controller(Stage(field, policy, funnel, Held(HELD)), LIMITS, 1.0)
    _, said = driven(controller, Monitor([Stage(field, policy, funnel, Held(HELD))]), 0.0, push=0.5)
    assert said[20] is Status.INSIDE
    assert said[21] is Status.OUTSIDE


def test_after_the_end_nothing_is_claimed() -> None:
    field, policy, funnel = stage()
    monitor = Monitor([Stage(field, policy, funnel, Held(0.25))])
    for k in range(4):
        assert monitor.update(0.25 * k, [0.25 * k], [1.0]).status is Status.INSIDE
    assert monitor.update(1.0, [1.0], None).status is Status.INSIDE
    reading = monitor.update(1.25, [1.25], [1.0])
    assert (reading.status, reading.reason) == (
        Status.UNKNOWN,
        "the proof covers 1 s; they are over",
    )


def test_stages_are_held_one_after_another_and_each_has_its_own_size() -> None:
    """At 0.8 s of the first stage 0.15 m is outside, at the second's start it is inside."""
    first, second = stage(), stage(1.0, 0.3)
    monitor = Monitor([Stage(*first, Held(0.2)), Stage(*second, Held(0.2))])
    said, stages = [], []
    for k in range(11):
        t = 0.2 * k
        x = np.array([t + (0.15 if 3 < k < 6 else 0.0)])
        policy = first[1] if t < 1.0 - 1e-9 else second[1]
        reading = monitor.update(t, x, policy(t, x))
        said.append(reading.status)
        stages.append(reading.assuming.split(":")[0])
    radius = 0.2 - 0.1 * 0.8
    assert radius < 0.15 < 0.3
    outside = [k for k, status in enumerate(said) if status is Status.OUTSIDE]
    assert outside == [4]
    assert stages == ["stage 1 of 2"] * 5 + ["stage 2 of 2"] * 6
    assert set(said) == {Status.INSIDE, Status.OUTSIDE}
    with pytest.raises(CertificateMismatch, match="do not follow"):
        Monitor([Stage(*second, Held(HELD)), Stage(*first, Held(HELD))])


def test_a_clipped_policy_is_proved_as_it_is_and_other_limits_end_the_run() -> None:
    field, policy, funnel = stage(limit=1.2)
    controller = Controller(Stage(field, policy, funnel, Held(HELD)), LIMITS, 1.0)
    assert controller.update(0.0, np.array([-0.15])) == pytest.approx(1.2)
    narrow = Limits(lowest=-1.1, highest=1.1, stop_rate=1.0)
    controller = Controller(Stage(field, policy, funnel, Held(HELD)), narrow, 1.0)
    controller.update(0.0, np.array([-0.15]))
    assert "is not proved" in controller.ended
    with pytest.raises(DataError, match="beyond the limits"):
        Controller(
            Stage(field, policy, funnel, Held(HELD)),
            Limits(lowest=0.0, highest=0.5, stop_rate=1.0),
            1.0,
        )


def test_a_policy_of_which_nothing_is_proved_runs_from_anywhere_within_the_limits() -> None:
    field, policy, _ = stage()
    unproved = Stage(field, policy, None, Held(HELD))
    controller = Controller(unproved, LIMITS)
    x, samples = np.array([3.0]), 0
    while not controller.ended:
        x = x + HELD * controller.update(samples * HELD, x)
        samples += 1
    assert (controller.ended, samples) == ("the proof is over", round(1.0 / HELD) + 1)
    assert x[0] == pytest.approx(1.0, abs=0.1)
    controller = Controller(unproved, LIMITS)
    controller.update(0.0, np.array([-9.0]))
    assert "is not proved: it is beyond" in controller.ended
    other = VectorField.from_function(lambda x, u: [u[0] - x[0]], 1, 1)
    with pytest.raises(CertificateMismatch, match="policy was made for another model"):
        Controller(unproved._replace(model=other), LIMITS)


def test_a_period_is_asked_for() -> None:
    field, policy, funnel = stage()
    unsaid = Stage(field, policy, funnel)
    for running in (lambda: Monitor([unsaid]), lambda: Controller(unsaid, LIMITS)):
        with pytest.raises(DataError, match="names no time between samples, nor how its policy"):
            running()
    with pytest.raises(DataError, match="period should be s above 0"):
        Held(0.0)


def test_a_design_needs_to_be_told_where_its_signals_are() -> None:
    design: AnyDesign = Design(*stage())
    with pytest.raises(DataError, match="names no signals"):
        read_at(design)
    wired = replace(design, wiring=wiring_of(["/joints:position[0]"], ["/effort:effort[0]"], HELD))
    assert str(read_at(wired)) == "/joints:position[0]"
    watch = Watch(wired, announced=True)
    said = watch.begin(0)
    for k in range(3):
        stamp_ns = round(k * HELD * 1e9)
        x = np.array([k * HELD + 0.05])
        said += watch.response(stamp_ns, x)
        said += watch.excitation(stamp_ns, wired.policy(k * HELD, x))
    assert [entry.reading.status for entry in said] == [Status.INSIDE] * 3


def test_a_recorded_run_is_replayed_from_its_announced_start_bit_for_bit(tmp_path: Path) -> None:
    """The state in one message, the input in another, on a clock of nanoseconds."""
    field, policy, funnel = stage()
    wiring = wiring_of(["/joints:position[0]"], ["/effort:effort[0]"], HELD)
    design: AnyDesign = Design(field, policy, funnel, wiring=wiring)
    controller = Controller(Stage(field, policy, funnel, Held(HELD)), LIMITS, 1.0)
    x: FloatArray = np.array([0.1])
    samples: list[tuple[FloatArray, FloatArray]] = []
    while not controller.ended:
        u = controller.update(len(samples) * HELD, x)
        samples.append((x, u))
        x = x + HELD * u
    period_ns = round(HELD * 1e9)
    write_run(tmp_path / "bag", design, samples)
    replayed = [entry.reading for entry in replay_messages(design, tmp_path / "bag")]
    assert replayed[0].reason == "waiting for the controller to announce its start"
    monitor = Monitor([Stage(field, policy, funnel, Held(HELD))])
    direct = [monitor.update(k * period_ns / 1e9, x, u) for k, (x, u) in enumerate(samples)]
    assert [r.margin for r in replayed[1:]] == [r.margin for r in direct]
    assert {r.status for r in replayed[1:]} == {Status.INSIDE}
