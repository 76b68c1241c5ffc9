"""More knots where P(t) is far from linear, and near what was refused."""

from typing import Any

import numpy as np
import pytest

from nlsid import ContinuousTracking, Nominal, design, integrate_nominal
from nlsid_core.design.continuous.diagnosis import TERMS, Diagnosis, NoFunnel
from nlsid_core.design.continuous.finer import FEW, LOST, Unproved, coarse, halved, lost, most_knots
from nlsid_core.design.continuous.pieces import prove_pieces
from nlsid_core.design.continuous.setting import MOST_KNOTS, Setting, prepare
from nlsid_core.funnels.continuous import ContinuousFunnel


def servo(x: Any, u: Any) -> Any:
    """A cart pushed by a servo with a lag of 20 ms, on a spring that stiffens."""
    return [x[1], 2 * x[2] - x[0] ** 3, 50 * (u[0] - x[2])]


GOAL = [0.1, 0.3, 0.3]


def at_rest(knots: int) -> Nominal:
    """In the origin for 2 s."""
    t = np.linspace(0, 2, knots)
    return integrate_nominal(servo, lambda _: [0.0], t=t, start=np.zeros(3))


def prepared(nominal: Nominal) -> Setting:
    """What the search starts from."""
    return prepare(ContinuousTracking(servo, nominal, goal=GOAL))


def test_a_fast_servo_gets_knots_near_the_goal_and_is_proved_there() -> None:
    found = design(ContinuousTracking(servo, at_rest(13), goal=GOAL))
    assert 13 < len(found.funnel.t) <= most_knots(13)
    spacing = np.diff(found.funnel.t)
    assert spacing[-1] < spacing[0] / 3
    assert found.funnel.widths(0.0)[0] > 0.5 * GOAL[0]  # a quarter of it with the given knots


def test_what_linear_shapes_lose_is_found_where_they_turn_fast() -> None:
    setting = prepared(at_rest(13))
    losses = lost(setting)
    assert losses.argmax() == 11
    assert losses[-1] > 10 * LOST
    assert (losses[:6] < 1e-3).all()
    chosen = coarse(setting, 14)
    assert chosen.tolist() == 11 * [False] + [True]
    assert not coarse(setting, 13).any()
    assert most_knots(12) == 16 + FEW
    assert most_knots(10 * MOST_KNOTS) == MOST_KNOTS


def refused(t: float, *, left: float) -> NoFunnel:
    """At t, with V falling by `left`."""
    taken = dict.fromkeys(TERMS, 0.0) | {"remainder": 1.0}
    return NoFunnel(t, lambda: Diagnosis(t, 1.0 + left, taken, (0.1, 0.1, 0.1)), left)


def test_knots_are_added_near_a_refusal_between_them_and_everywhere_for_a_remainder() -> None:
    few, many = prepared(at_rest(41)), prepared(at_rest(101))
    between, remainder = (refused(1.0, left=left) for left in (0.5, -0.5))
    chosen = halved(few, between, 1 / 32)
    assert chosen is not None
    where = np.flatnonzero(chosen)
    assert where.tolist() == [18, 19, 20, 21]
    intervals = np.isin(range(40), [3, 18])
    unproved = halved(few, Unproved("", 1.0, intervals), 1 / 32)
    assert unproved is not None
    assert np.array_equal(unproved, intervals)
    everywhere = halved(few, remainder, 1 / 32)
    assert everywhere is not None
    assert everywhere.all()
    some = halved(many, remainder, 1 / 2)
    assert some is not None
    assert some.sum() == MOST_KNOTS - 101
    assert abs(np.flatnonzero(some).mean() - 49.5) < 1
    assert halved(prepared(at_rest(MOST_KNOTS)), between, 1 / 32) is None


@pytest.mark.filterwarnings("error")
def test_a_funnel_whose_numbers_overflow_is_not_proved() -> None:
    setting = prepared(at_rest(41))
    rho = np.geomspace(1e-180, 1e-3, 41)
    funnel = ContinuousFunnel(setting.policy.x, setting.P, rho, setting.policy.vector_field, "")
    assert prove_pieces(setting.steps, funnel).unproved


def test_a_shape_that_is_wider_before_the_end_than_equations_reach_is_no_refusal() -> None:
    def valve(x: Any, u: Any) -> Any:
        flow = x[3] * np.sqrt(1 - 0.5 * np.tanh(x[3] / 0.05) * x[2])
        return [x[1], 20 * x[2] - 2 * x[1], 50 * (flow - 0.5 * x[1]) - x[2], 50 * (u[0] - x[3])]

    still = integrate_nominal(valve, lambda _: [0.0], t=np.linspace(0, 0.5, 41), start=np.zeros(4))
    goal = [0.05, 0.3, 0.3, 0.1]
    setting = prepare(ContinuousTracking(valve, still, goal=goal))
    assert setting.margin(setting.rho_final) > 0
