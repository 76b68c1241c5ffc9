"""The live side of a sampled funnel: verdicts, the assumption, levels, missing samples."""

import math
from dataclasses import replace

import numpy as np
import pytest

from nlsid import Dataset, Monitor, Status, Trajectory
from nlsid_core.design.sampled.design import assume
from nlsid_core.errors import CertificateMismatch, DataError, ShapeError
from nlsid_core.running.reading import Level, Reading
from nlsid_core.running.stage import Stage
from tests.tracked import PERIOD, designed, run, tracked


def readings(recorded: Trajectory) -> list[Reading]:
    """What the monitor says of every sample."""
    design = designed()
    monitor = design.monitor()
    return [
        monitor.update(float(t), y, u)
        for t, y, u in zip(recorded.t, recorded.y, recorded.u, strict=True)
    ]


def test_a_run_as_it_should_be_is_inside_and_ends_in_the_goal() -> None:
    result = readings(run())
    assert {r.status for r in result} == {Status.INSIDE}
    assert all(0 < r.margin <= 1 and 0 <= r.assumption < 1 for r in result)
    assert result[0].level is Level.TUBE
    assert result[-1].level is Level.GOAL


def test_a_kick_breaks_the_assumption_before_the_tube_is_left() -> None:
    result = readings(run(kick=np.array([0.0, 0.3])))
    flagged = next(k for k, r in enumerate(result) if r.status is not Status.INSIDE)
    assert flagged <= 11
    assert result[flagged].status is Status.ASSUMPTION_VIOLATED
    assert "disturbance response" in result[flagged].reason
    assert result[flagged].assumption > 1


def test_a_large_kick_is_outside_and_the_reason_names_the_assumption() -> None:
    result = readings(run(kick=np.array([0.0, 40.0])))
    outside = next(r for r in result if r.status is Status.OUTSIDE)
    assert outside.margin < 0
    assert outside.time_to_exit == 0
    assert "disturbance" in outside.reason
    assert outside.level in (Level.INLET, Level.NONE)


def test_a_growing_deviation_counts_down_to_the_exit() -> None:
    result = readings(run(kick=np.array([0.0, 3.0])))
    falling = [r.time_to_exit for r in result[9:12]]
    assert all(math.isfinite(value) and value >= 0 for value in falling)


def test_a_start_outside_the_inlet_is_flagged_at_once() -> None:
    design = designed()
    far = design.policy.x[0] + np.linalg.solve(
        design.funnel.S[0], [1.5 * design.funnel.radius[0], 0.0]
    )
    assert readings(run(start=far))[0].status is Status.OUTSIDE


def test_another_input_than_the_policys_breaks_the_assumption() -> None:
    recorded = run()
    u = recorded.u.copy()
    u[5] += 0.01
    flagged = readings(replace(recorded, u=u))[5]
    assert flagged.status is Status.ASSUMPTION_VIOLATED
    assert "not the policy's" in flagged.reason


@pytest.mark.parametrize(
    ("t", "y", "u", "reason"),
    [
        (PERIOD, [math.nan, 0.0], [0.0], "state"),
        (PERIOD, [0.0, 0.0], [math.nan], "input"),
        (PERIOD, [0.0, 0.0], None, "input"),
        (3 * PERIOD, [0.0, 0.0], [0.0], "missing"),
        (-PERIOD, [0.0, 0.0], [0.0], "back"),
    ],
)
def test_a_bad_sample_reads_unknown_from_then_on(
    t: float, y: list[float], u: list[float] | None, reason: str
) -> None:
    design = designed()
    monitor = design.monitor()
    recorded = run()
    monitor.update(0.0, recorded.y[0], recorded.u[0])
    reading = monitor.update(t, y, u)
    assert reading.status is Status.UNKNOWN
    assert reason in reading.reason
    assert math.isnan(reading.margin)
    assert monitor.update(2 * PERIOD, recorded.y[1], recorded.u[1]).status is Status.UNKNOWN
    monitor.restart()
    assert monitor.update(9.0, recorded.y[0], recorded.u[0]).status is Status.INSIDE


def test_after_the_horizon_nothing_is_claimed() -> None:
    design, recorded = designed(), run()
    monitor = design.monitor()
    for t, y, u in zip(recorded.t, recorded.y, recorded.u, strict=True):
        monitor.update(float(t), y, u)
    reading = monitor.update(float(recorded.t[-1]) + PERIOD, recorded.y[-1], recorded.u[-1])
    assert reading.status is Status.UNKNOWN
    assert "over" in reading.reason


def test_a_funnel_of_another_policy_is_refused() -> None:
    design = designed()
    with pytest.raises(CertificateMismatch):
        Monitor([Stage(design.model, designed(goal=0.3).policy, design.funnel)])


def test_a_state_of_another_size_is_an_error() -> None:
    design = designed()
    monitor = design.monitor()
    with pytest.raises(ShapeError):
        monitor.update(0.0, [0.0, 0.0, 0.0], [0.0])


def test_the_assumption_is_the_largest_commissioning_run_times_the_safety_factor() -> None:
    base = tracked()
    runs = Dataset(tuple(run(seed=seed) for seed in range(3)))
    assumption = assume(base.model, base.policy, base.feedback, runs, safety_factor=2.0)
    assert assumption.bound >= 2.0 * assumption.measured > 0
    assert [name for name, _ in assumption.measured_on] == ["run_0", "run_1", "run_2"]
    short = replace(runs.trajectories[0], t=np.arange(5.0), y=np.zeros((5, 2)), u=np.zeros(5))
    with pytest.raises(DataError, match="steps"):
        assume(base.model, base.policy, base.feedback, Dataset((short,)))
