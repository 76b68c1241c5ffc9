"""Funnels that a disturbance shapes: P(t) from what the pushed linear closed loop reaches."""

from typing import Any

import numpy as np
import pytest

from benchmarks.first_try import Truth, dubins
from benchmarks.thesis.soundness import Simulation
from nlsid_core.design import ContinuousTracking, design, plan_motion
from nlsid_core.dynamics import Nominal
from nlsid_core.errors import Infeasible

TIMES = np.linspace(0, 2, 301)
WIND = 0.8  # m/s across a vehicle at 5 m/s: more than the cost-to-go's P(t) can hold


def drifting(x: Any, u: Any, w: Any) -> Any:
    """Across in m and heading in rad, at 5 m/s in wind."""
    return [5 * np.sin(x[1]) + w[0], u[0]]


def lane_change() -> Nominal:
    return plan_motion(
        lambda x, u: drifting(x, u, np.zeros(1)), start=[0, 0], end=[1, 0], seconds=2, u=[0]
    )


def motor(x: Any, u: Any, w: Any) -> Any:
    """Angle in rad, speed in rad/s, current in A: dry friction, and a torque that nobody knows."""
    return [
        x[1],
        20 * x[2] - 4 * np.tanh(x[1] / 0.5) - 0.5 * x[1] + w[0],
        (u[0] - 2 * x[2] - 0.4 * x[1]) / 0.05,
    ]


@pytest.mark.slow
def test_wind_that_no_cost_to_go_holds_is_held_by_what_it_can_reach() -> None:
    motion = lane_change()
    found = design(ContinuousTracking(drifting, motion, goal=[1, 0.3], uncertain=[[-WIND, WIND]]))
    assert len(found.funnel.t) > len(motion.t)  # P is far from linear somewhere
    assert found.funnel.widths(0.0)[0] > 0.5
    run = Simulation(Truth(drifting, found, 1), found.policy, found.funnel).boundary(
        starts=500, rng=np.random.default_rng(0), substeps=20, adversary=True
    )
    assert run.violations == 0
    assert run.max_v > 0.9  # it is pushed hard, and stays


@pytest.mark.slow
def test_a_wind_that_ends_outside_the_goal_is_refused_with_the_first_reason() -> None:
    problem = ContinuousTracking(drifting, lane_change(), goal=[1, 0.3], uncertain=[[-2, 2]])
    with pytest.raises(Infeasible, match="Because of the disturbance w"):
        design(problem)


def test_a_motion_with_more_knots_is_the_same_motion() -> None:
    motion = lane_change()
    finer = motion.halved(np.arange(len(motion.t) - 1) % 2 == 0)
    assert len(finer.t) == len(motion.t) + len(motion.t) // 2
    assert set(motion.t) < set(finer.t)
    for before, after in ((motion.x, finer.x), (motion.u, finer.u)):
        np.testing.assert_allclose(after(TIMES), before(TIMES), atol=1e-14)


@pytest.mark.slow
def test_an_airplane_in_half_a_metre_per_second_of_wind_is_proved_at_the_first_try() -> None:
    rate, problem = dubins(0.5)
    found = design(problem)
    run = Simulation(Truth(rate, found, 3), found.policy, found.funnel).boundary(
        starts=1000, rng=np.random.default_rng(0), substeps=10
    )
    assert run.violations == 0
    assert found.funnel.widths(0.0)[0] > 0.1


@pytest.mark.slow
def test_a_motor_whose_voltage_is_held_under_an_unknown_torque_is_proved() -> None:
    """What the hold does counts among what pushes; else it is refused."""
    motion = plan_motion(
        lambda x, u: motor(x, u, [0]), start=[0, 0, 0], end=[2, 0, 0], seconds=1.5, u=[0]
    )
    found = design(
        ContinuousTracking(
            motor,
            motion,
            goal=[0.15, 1.0, 0.5],
            limits=[[-12, 12]],
            uncertain=[[-1, 1]],
            hold=0.005,
        )
    )
    ran = Simulation(Truth(motor, found, 1), found.policy, found.funnel).held(
        hold=0.005, error=np.zeros(3), starts=300, rng=np.random.default_rng(0)
    )
    assert ran.violations == 0


@pytest.mark.slow
def test_factors_are_as_near_as_the_scale_that_they_are_written_in_needs() -> None:
    def double(x: Any, u: Any, w: Any) -> Any:
        return [x[1], u[0] + w[0]]

    motion = plan_motion(
        lambda x, u: double(x, u, np.zeros(1)),
        start=[0, 0],
        end=[1, 0],
        seconds=4,
        u=[0],
        limits=[[-1, 1]],
    )
    # The constant of one piece is just above the power of two between two scales, and its factors'
    # just below: the kernel refused what was near enough in the other scale.
    found = design(
        ContinuousTracking(
            double, motion, goal=[0.1, 0.1], limits=[[-1, 1]], uncertain=[[-0.05, 0.05]]
        )
    )
    assert found.funnel.widths(0.0) == pytest.approx([0.4717, 0.6671], rel=1e-3)
