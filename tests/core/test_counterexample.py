"""What simulated solutions say of a claim that was not proved, against truths in closed form."""

from typing import Any

import numpy as np
import pytest

from nlsid_core.design import ContinuousTracking, design, integrate_nominal
from nlsid_core.design.continuous.counterexample import SCALES, Tried, try_to_miss
from nlsid_core.design.continuous.setting import Setting, prepare
from nlsid_core.dynamics import Nominal
from nlsid_core.errors import Infeasible

SECONDS = 2.0
WIND = 0.3


def decaying(x: Any, w: Any) -> Any:
    """ẋ = w - x: from the motion, x(2) is at most 1 - e⁻² of the largest |w|."""
    return [w[0] - x[0]]


def driven(u: Any) -> Any:
    """ẋ = u."""
    return [u[0]]


def at_rest(m: int) -> Nominal:
    """x = 0 and u = 0."""
    t = np.linspace(0, SECONDS, 21)
    return integrate_nominal(lambda x: [0 * x[0]], lambda _: np.zeros(m), t=t, start=[0.0])


def setting_of(rate: Any, m: int, goal: float, **options: Any) -> Setting:
    """What a search starts from."""
    return prepare(
        rate, at_rest(m), goal=[goal], policy=None, Q=None, R=None, gain="constant", **options
    )


def tried(rate: Any, m: int, goal: float, **options: Any) -> Tried:
    """What simulations say of it."""
    return try_to_miss(setting_of(rate, m, goal, **options))


@pytest.mark.parametrize(("goal", "impossible"), [(0.26, False), (0.259, True)])
def test_the_worst_push_is_found_and_decides_whether_the_goal_is_missed(
    goal: float, impossible: bool
) -> None:
    found = tried(decaying, 0, goal, uncertain=[[-WIND, WIND]])
    worst = WIND * (1 - np.exp(-SECONDS))
    starts = found.widths[0] * SCALES * np.exp(-SECONDS)
    assert found.farthest == pytest.approx((worst + starts) / goal, rel=1e-6)
    assert found.impossible == impossible == (worst > goal)


def test_a_refusal_says_that_a_solution_from_the_motion_misses_the_goal() -> None:
    problem = ContinuousTracking(decaying, at_rest(0), goal=[0.2], uncertain=[[-WIND, WIND]])
    said = r"starts on the motion at 0 s and ends 1\.3 times as far .* while w"
    with pytest.raises(Infeasible, match=f"No funnel of this policy can be proved: .*{said}"):
        design(problem)


def test_errors_of_measurement_push_through_the_feedback() -> None:
    setting = setting_of(driven, 1, 0.1, error=[0.05])
    found = try_to_miss(setting)
    K = np.array([setting.policy.K(t)[0, 0] for t in np.linspace(0, SECONDS, 2001)])
    decay = np.exp(-np.trapezoid(K, dx=SECONDS / 2000))
    assert found.farthest[0] == pytest.approx(0.05 * (1 - decay) / 0.1, rel=1e-3)


@pytest.mark.slow
def test_a_held_input_is_held() -> None:
    """x(k + 1) = (1 - hK)x(k) with a hold of h: here it overshoots, and grows."""
    hold = 0.5
    setting = setting_of(driven, 1, 0.1, hold=hold)
    K = [setting.policy.K(t)[0, 0] for t in np.arange(0, SECONDS, hold)]
    found = try_to_miss(setting)
    grown = abs(np.prod(1 - hold * np.array(K))) * found.widths[0] / 0.1
    assert grown > 1
    assert found.farthest == pytest.approx(SCALES * grown, rel=1e-6)
    with pytest.raises(Infeasible, match=r"with inputs held for 0\.5 s, starts at 0 s within"):
        design(ContinuousTracking(driven, at_rest(1), goal=[0.1], hold=hold))


def test_a_solution_that_runs_away_misses() -> None:
    found = tried(lambda x: [500 * x[0] ** 3], 0, 0.1)
    assert np.isinf(found.farthest[-1])
    assert found.farthest[0] == 0
