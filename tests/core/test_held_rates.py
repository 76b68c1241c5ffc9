"""How fast inputs change in a funnel: the bounds of the search, and how small its proof is."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from nlsid_core.design import FunnelDesign, design
from nlsid_core.design.continuous import search
from nlsid_core.design.continuous.held import Changes
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.design.continuous.rates import curving_states
from nlsid_core.dynamics import PiecewisePolynomial, VectorField
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from tests.falling_pendulum import tracking


@pytest.fixture(scope="module")
def held() -> FunnelDesign:
    """A pendulum whose input is held."""
    return design(tracking(hold=0.01))


@pytest.mark.parametrize(
    ("rate", "expected"),
    [
        (lambda x, u: [x[1] * x[1] + x[0], u[0], u[1]], ()),
        (lambda x, u: [x[1] * x[2] * x[0], x[2] ** 3 + u[0], x[1] ** 2 + u[1]], (2,)),
        (lambda x, u: [x[2] * u[0] * u[1], x[2] * x[1] * x[1], u[1]], (2,)),
        (lambda x, u: [x[0] ** 3, x[1] ** 2 * u[1], u[0]], (0, 1)),
        (lambda x, u: [u[0] * u[0] * u[1], x[0], x[1] ** 3], (0, 1, 2)),
    ],
)
def test_every_cubic_term_has_a_curving_state(rate: Any, expected: tuple[int, ...]) -> None:
    assert curving_states(VectorField.from_function(rate, 3, 2)) == expected


def test_a_proof_of_rates_has_no_products_that_no_cubic_term_needs(held: FunnelDesign) -> None:
    """The angle is cubic; the square of its rate is in no cubic term times anything."""
    proof = held.proof
    unused = proof["basis"].index([0, 2])
    size = len(proof["basis"])
    for piece in proof["rate_pieces"]:
        for factor in piece["squares"]["factors"]:
            wide = [[0] * (size - len(row)) + row for row in factor]
            assert len(wide) < size
            assert not any(row[unused] for row in wide)
        assert not any(any(row[2:]) for row in piece["tau"][0]["squares"]["factors"][0])


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
