"""Designed funnels in which every solution comes nearer to the motion."""

from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid_core import proofs
from nlsid_core.design import ContinuousTracking, FunnelDesign, design, integrate_nominal
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateRejected, DataError, Infeasible, OptionError
from tests.falling_pendulum import tracking
from tests.funnel_files import FUNNEL, PROOF, Files, bind, copy_of, saved

RATE = 2.0  # 1/s


@pytest.fixture(scope="module")
def decaying() -> FunnelDesign:
    """Pushed from either side."""
    return design(tracking(decay=RATE))


@pytest.fixture
def files(decaying: FunnelDesign, tmp_path: Path) -> Files:
    """Its documents."""
    return saved(decaying, tmp_path)


def excess(found: FunnelDesign, decay: dict[str, float], starts: int = 300) -> float:
    """By how much V of simulated runs is above what is claimed, for the worst two times of each."""
    field, policy, funnel = found.model, found.policy, found.funnel
    rng, worst = np.random.default_rng(3), -np.inf
    rate, floor = decay["rate"], decay["floor"]
    low, high = field.uncertain.T
    for first in (0, len(funnel.t) // 2):
        P = funnel.shape(float(funnel.t[first]))
        z = rng.normal(size=(starts, funnel.n))
        z *= (rng.uniform(0.05, 1, starts) / np.sqrt(np.einsum("ni,ij,nj->n", z, P, z)))[:, None]
        X, w = (
            funnel.nominal(float(funnel.t[first])) + z,
            low + (high - low) * rng.integers(0, 2, (starts, len(low))),
        )
        times = [float(funnel.t[first])]
        levels = [funnel.value(times[0], X)]
        for before, after in pairwise(funnel.t[first:].tolist()):
            X = stepped(lambda t, Y: field(t, Y, policy(t, Y), w), before, X, after - before)  # noqa: B023
            times.append(after)
            levels.append(funnel.value(after, X))
        for i, j in combinations(range(len(times)), 2):
            left = np.exp(-rate * (times[j] - times[i])) * (levels[i] - floor)
            worst = max(worst, float(np.max(levels[j] - floor - np.maximum(left, 0.0))))
    return worst


def stepped(rates: Any, t: float, X: Any, h: float, count: int = 10) -> Any:
    """X h s later, by Runge and Kutta; t + h itself belongs to the next interval."""
    h = h / count
    for k in range(count):
        s = t + k * h
        a = rates(s, X)
        b = rates(s + h / 2, X + h / 2 * a)
        c = rates(s + h / 2, X + h / 2 * b)
        d = rates(s + h * (1 - 1e-12), X + h * c)
        X = X + h / 6 * (a + 2 * b + 2 * c + d)
    return X


def test_every_simulated_solution_comes_nearer_as_fast_as_claimed(decaying: FunnelDesign) -> None:
    decay = decaying.claim["decay"]
    assert decay["rate"] == RATE
    assert 0 < decay["floor"] < 0.05
    assert excess(decaying, decay) < 1e-6
    assert excess(decaying, decay | {"rate": 20 * RATE}) > 0.01, "the runs decide something"
    assert float(decaying.verdict.margin) == pytest.approx(RATE * (1 - decay["floor"]))
    assert f"exp(-{RATE:g} (t2 - t1))" in decaying.verdict.statement


def test_coming_nearer_costs_room(decaying: FunnelDesign) -> None:
    free = design(tracking())
    assert 0.1 < decaying.funnel.volume(0.0) / free.funnel.volume(0.0) < 1


def refused(files: Files, reason: str) -> None:
    """The kernel refuses the documents, all digests fresh."""
    bind(files)
    with pytest.raises(CertificateRejected, match=reason):
        proofs.decide(files[PROOF], files)


def test_what_is_a_little_more_than_was_proved_is_refused(files: Files) -> None:
    for member, factor in (("rate", 1.1), ("floor", 0.5)):
        more = copy_of(files)
        more[PROOF]["claim"]["decay"][member] *= factor
        refused(more, "not positive")
    wider = copy_of(files)
    wider[FUNNEL]["rho"] = [1.3 * rho for rho in wider[FUNNEL]["rho"]]
    refused(wider, "not positive")
    exchanged = copy_of(files)
    for piece in exchanged[PROOF]["proof"]["pieces"]:
        piece["tau"].reverse()
    refused(exchanged, "not positive")
    fewer = copy_of(files)
    del fewer[PROOF]["proof"]["pieces"][5]
    refused(fewer, "a piece of interval .* is missing")
    unclaimed = copy_of(files)
    del unclaimed[PROOF]["claim"]["decay"]
    refused(unclaimed, "'margin' is missing")


@pytest.mark.slow
def test_inputs_that_saturate_or_are_held_and_many_pushes_may_decay_too() -> None:
    """ẋ = x - x³/3 + clip(u), and a point that three winds push."""
    t = np.linspace(0, 0.5, 5)
    field = VectorField.from_function(lambda x, u: x - x**3 / 3 + u, 1, 1)
    nominal = integrate_nominal(field, lambda _: [0.0], t=t, start=[0.0])
    held: dict[str, Any] = {"hold": 0.01, "error": [0.001], "Q": [[1.0]], "R": [[1.0]]}
    for options in ({"limits": [[0, -1.5, 2.0]]}, held):
        found = design(ContinuousTracking(field, nominal, goal=[1.0], decay=1.0, **options))
        assert found.claim["decay"]["floor"] < 0.3
        if "hold" not in options:
            assert excess(found, found.claim["decay"]) < 1e-6
    box = [[-0.02, 0.02]] * 3
    windy = VectorField.from_function(
        lambda x, u, w: np.array([x[1] + w[0], u[0] - x[0] ** 3 + w[1] + w[2]]), 2, 1, uncertain=box
    )
    still = integrate_nominal(windy, lambda _: [0.0], t=t, start=[0.0, 0.0])
    found = design(ContinuousTracking(windy, still, goal=[0.5, 0.5], decay=1.0))
    assert "kappa" in found.proof
    assert excess(found, found.claim["decay"]) < 1e-6


@pytest.mark.slow
def test_a_function_that_is_expanded_may_decay_too() -> None:
    """A pendulum that falls, with its sine."""

    def rates(x: Any, u: Any) -> Any:
        return np.array([x[1], 9.0 * np.sin(x[0]) + u[0]])

    nominal = integrate_nominal(rates, lambda _: [0.0], t=np.linspace(0, 0.5, 9), start=[0.0, 0.0])
    found = design(ContinuousTracking(rates, nominal, goal=[0.2, 1.0], decay=1.0))
    assert found.model.expansion
    assert excess(found, found.claim["decay"]) < 1e-6


def test_what_cannot_decay_is_refused_with_the_reason() -> None:
    for none in (0.0, "2", [1.0], 1j, np.array([1.0]), True):
        with pytest.raises(OptionError, match="decay"):
            tracking(decay=none)
    with pytest.raises(DataError, match="take shape rho"):
        design(tracking(decay=1.0, shape="P"))
    with pytest.raises(Infeasible, match="decay"):
        design(tracking(decay=500.0))
    fifth = VectorField.from_function(lambda x, u: x**5 + u, 1, 1)
    nominal = integrate_nominal(fifth, lambda _: [0.0], t=np.linspace(0, 1, 5), start=[0.0])
    with pytest.raises(DataError, match="degree up to 3, not 5"):
        design(ContinuousTracking(fifth, nominal, goal=[0.1], decay=1.0))
