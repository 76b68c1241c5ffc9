"""Held funnels: inputs are off by what they change in the funnel that is found, and no more."""

from typing import Any

import numpy as np
import pytest

from nlsid_core.design import ContinuousTracking, FunnelDesign, design, plan_motion
from nlsid_core.design.continuous import search
from nlsid_core.design.continuous.held import LONGEST, SHORTEST, Changes, Hold, fastest
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from tests.falling_pendulum import tracking

HOLD = 0.03  # s


@pytest.fixture(scope="module")
def held() -> FunnelDesign:
    """A pendulum whose input is held for so long that its funnel is much smaller."""
    return design(tracking(hold=HOLD))


def changes_in(found: FunnelDesign, rho: Any) -> Changes:
    """dũ/dt in the funnel of a design, or one with other ρ."""
    funnel = ContinuousFunnel(found.funnel.x, found.funnel.P, rho, "", "")
    steps = LSteps(found.model, found.policy, widths=np.zeros((len(funnel.t) - 1, 1)))
    return Changes.of(steps, funnel)


def test_rates_in_a_smaller_funnel_follow_from_those_in_a_larger(held: FunnelDesign) -> None:
    rho = held.funnel.rho
    size = np.linspace(0.2, 1.0, len(rho))
    widths = np.full((len(rho) - 1, 1), 0.3)
    smaller = changes_in(held, size**2 * rho).rates(widths)
    assert changes_in(held, rho).rates(widths, size) == pytest.approx(smaller, rel=1e-9)
    assert (changes_in(held, rho).rates(widths) > 1.05 * smaller).any()


def test_inputs_are_off_by_what_they_change_in_the_funnel_that_is_found(held: FunnelDesign) -> None:
    hold = Hold.of(HOLD, None, 2)
    assert hold is not None
    stated = hold.widths(held.policy, np.asarray(held.proof["rates"]))
    _, least = fastest(changes_in(held, held.funnel.rho), held.policy, hold)
    assert (least <= 1.01 * stated).all()
    assert stated == pytest.approx(least, rel=0.05)
    free = design(tracking(hold=1e-6))
    _, in_all = fastest(changes_in(held, free.funnel.rho), held.policy, hold)
    assert (in_all > 1.1 * stated).any(), "the funnel without a hold is no larger"


@pytest.mark.parametrize("longest", [LONGEST, 0.04, 0.02, 0.0078, 0.0013, SHORTEST])
def test_the_longest_hold_is_found_to_a_factor_in_few_tries(longest: float) -> None:
    tried: list[float] = []

    def held(period: float) -> Any:
        tried.append(period)
        if period > longest:
            raise Infeasible("too long")
        return period

    found: Any = search._longest(held)
    assert longest / 2**0.5 < found * (1 + 1e-9) <= longest * (1 + 1e-9)
    assert len(tried) <= 13


def test_a_hold_of_which_none_is_short_enough_is_refused_in_few_tries() -> None:
    tried: list[float] = []

    def held(period: float) -> Any:
        tried.append(period)
        raise Infeasible("too long")

    with pytest.raises(Infeasible):
        search._longest(held)
    assert min(tried) == SHORTEST
    assert len(tried) < 8


def ankle(halved: int) -> ContinuousTracking:
    """A person leans forward by 5 cm: the centre of mass in m, and the ankle's torque with a lag.

    The torque is that over mass and height, in m/s². So many last intervals are halved.
    """

    def rate(x: Any, u: Any) -> Any:
        return [x[1], 9.81 * np.sin(x[0] / 0.9) + x[2], (u[0] - x[2]) / 0.05]

    end = [0.05, 0, -9.81 * np.sin(0.05 / 0.9)]
    motion = plan_motion(rate, start=[0, 0, 0], end=end, seconds=1, u=[0])
    more = np.arange(len(motion.t) - 1) >= len(motion.t) - 1 - halved
    motion = motion.halved(more)
    return ContinuousTracking(rate, motion, goal=[0.02, 0.06, 1.0], hold=0.005)


@pytest.mark.slow
def test_more_knots_do_not_make_a_held_funnel_narrower() -> None:
    """Knots near the goal, where the feedback turns fastest."""
    widths = [design(ankle(halved)).funnel.widths(0.0)[0] for halved in (0, 1, 8)]
    assert widths[1] > 0.97 * widths[0]
    assert widths[2] > 0.97 * widths[1]
