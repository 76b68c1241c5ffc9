"""How fast held inputs change in a funnel, and what the search makes of it."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from nlsid_core.design import ContinuousTracking, FunnelDesign, design, plan_motion
from nlsid_core.design.continuous import search
from nlsid_core.design.continuous.held import LONGEST, SHORTEST, Changes, Hold, fastest
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.dynamics import PiecewisePolynomial, VectorField
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
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


@pytest.mark.slow
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


# -- How fast inputs change in a funnel: the bounds of the search


@pytest.mark.parametrize(
    "rate",
    [
        lambda x, u: [x[1] + x[0] ** 2 * x[2], u[0] * u[1] + x[0] * u[0], u[1] - x[2] * x[0]],
        lambda x, u: [x[1] + x[0] ** 2 * x[2], u[0] * x[1] + x[0] * u[0], u[1] - x[2] * x[0]],
        lambda x, u: [x[1] + x[0] ** 2 * x[2], u[0] + x[0], u[1] - x[2] * x[0] + u[0]],
    ],
    ids=["times the other", "one only pushes", "both only push"],
)
def test_rates_bound_what_samples_show_and_not_by_much(rate: Any) -> None:
    """For two inputs: every corner of δ, in |z| ≤ 1."""
    field = VectorField.from_function(rate, 3, 2)
    rng, t = np.random.default_rng(3), np.array([0.0, 2.0])
    x, u, K = (
        PiecewisePolynomial(t, rng.normal(size=(1, 2, *shape))) for shape in ((3,), (2,), (2, 3))
    )
    policy = ContinuousPolicy(x, u, K, "")
    roots = rng.normal(size=(2, 3, 3))
    P = np.array([root @ root.T + np.eye(3) for root in roots])
    funnel = ContinuousFunnel(x, P, np.array([0.3, 0.5]), "", "")
    widths = np.array([[0.3, 0.2]])
    steps = LSteps(field, policy, widths=np.zeros((1, 2)))
    bound = Changes.of(steps, funnel).rates(widths)[0]
    slopes = [np.diff(part.control[0], axis=0)[0] / 2.0 for part in (x, u, K)]
    fastest = np.zeros(2)
    for at in t.tolist():
        z = rng.normal(size=(20000, 3))
        z *= rng.uniform(size=(20000, 1)) ** 0.2 / np.linalg.norm(z, axis=1)[:, None]
        x_bar = z @ np.linalg.inv(np.linalg.cholesky(funnel.shape(at)))
        for signs in product((-1, 1), repeat=2):
            applied = u(at) - x_bar @ K(at).T + np.array(signs) * widths[0]
            error = field(at, x(at) + x_bar, applied, span=0) - slopes[0]
            change = slopes[1] - x_bar @ slopes[2].T - error @ K(at).T
            fastest = np.maximum(fastest, np.abs(change).max(axis=0))
    assert (bound >= fastest).all()
    assert (bound <= 1.2 * fastest).all()


@pytest.mark.slow
def test_a_search_for_the_largest_hold_looks_at_a_funnel_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What δ does to dũ/dt in a funnel does not depend on how long an input is held."""
    sizes: list[float] = []
    of = Changes.of

    def counted(steps: Any, funnel: Any) -> Changes:
        sizes.append(float(funnel.rho[0]))
        return of(steps, funnel)

    monkeypatch.setattr(Changes, "of", counted)
    periods = noted_periods(monkeypatch)
    design(tracking(hold="largest"))
    assert len(periods) > 1
    assert len(sizes) == len(set(sizes))


@pytest.mark.slow
def test_errors_that_leave_no_funnel_without_a_hold_are_the_reason() -> None:
    wrong = r"may be wrong by \[0.05, 0.2\], not even without a hold: input 0 is then off by"
    with pytest.raises(Infeasible, match=wrong):
        design(tracking(error=[0.05, 0.2]))


def noted_periods(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The holds that searches try from now on, in s."""
    periods: list[float] = []
    one = search._held

    def noted(setting: Any, expansion: Any, hold: Any, *rest: Any) -> Any:
        periods.append(hold.period)
        return one(setting, expansion, hold, *rest)

    monkeypatch.setattr(search, "_held", noted)
    return periods
