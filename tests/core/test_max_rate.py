"""The slowest rate that is searched: no model that forgets more slowly than its data can tell."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from nlsid import (
    Dataset,
    Degrees,
    Fit,
    LeastSquares,
    Polynomial,
    Rie,
    Rse,
    Sem,
    Trajectory,
    identify,
)
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import Infeasible, OptionError
from nlsid_core.identification.rates import rate_of_memory, searched_rate
from nlsid_core.models import DifferenceEquation
from tests.marks import slow_among
from tests.repeated import CLASS, pair

SAMPLES = 300


def drifting(poles: list[float], samples: int = SAMPLES, *, seed: int = 0) -> Trajectory:
    """A response of these poles to a command of zero mean, with noise."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, samples)
    y = lfilter([0.0, 1.0], np.poly(poles), u) + 0.05 * rng.standard_normal(samples)
    return Trajectory(t=0.1 * np.arange(samples), y=y, u=u, name=f"trial {seed}")


def radii_of(fit: Fit[DifferenceEquation]) -> FloatArray:
    return np.asarray(np.abs(np.roots(np.concatenate([[1.0], -fit.model.a]))))


def test_the_default_is_the_time_constant_of_the_longest_trial() -> None:
    data = Dataset((drifting([0.5], 40), drifting([0.5], 90, seed=1)))
    assert rate_of_memory(data) == pytest.approx(math.exp(-1 / 90))
    fit = identify(data, Polynomial(1))
    assert fit.max_rate == rate_of_memory(data)
    assert fit.slowest == "slowest rate allowed: 0.9890 (9 s) a sample"
    assert fit.slowest in str(fit)


@pytest.mark.parametrize("method", [Rse(), Sem(certified=True)])
def test_an_integrator_is_answered_by_the_slowest_rate_that_is_allowed(
    method: Rse | Sem,
) -> None:
    data = Dataset((drifting([1.0, 0.4]),))
    fit = identify(data, Polynomial(2), method=method)
    assert fit.proof.rate <= rate_of_memory(data) < 1.0
    assert radii_of(fit).max() == pytest.approx(searched_rate(rate_of_memory(data)), abs=2e-3)
    unheard = identify(data, Polynomial(2), method=method, max_rate=1.0 - 1e-7)
    assert radii_of(unheard).max() > 0.9975, "the limit is what kept the pole"


@pytest.mark.parametrize("rate", slow_among([0.7, 0.9], {0.7}))
@pytest.mark.parametrize(
    "method",
    [Rse(), Sem(certified=True), Rse(4, certified=True)],
    ids=["rse", "sem_certified", "certified"],
)
def test_every_search_keeps_a_rate_that_is_asked_for(rate: float, method: Rse | Sem) -> None:
    data = Dataset((drifting([0.95, 0.3]),))
    fit = identify(data, Polynomial(2), method=method, comparators=(), max_rate=rate)
    assert fit.proof.rate <= rate
    assert fit.errors["train"][method.name] < 100.0


def test_models_with_products_of_lags_and_inputs_keep_it_too() -> None:
    data = Dataset((drifting([0.9], 200),))
    model_class = Polynomial(1, degrees=Degrees(leading=1, lagged=1))
    fit = identify(data, model_class, method=Rse(3, certified=True), comparators=(), max_rate=0.8)
    assert fit.proof.rate <= 0.8


def test_bounds_on_the_identification_error_keep_it() -> None:
    data = Dataset((drifting([0.95, 0.3]),))
    states = identify(data, Polynomial(1, (1,), set="2.19"), max_rate=0.8)
    known = np.zeros((1, 1))
    assert abs(states.model.jacobian(known, known, known)[0, 0, 0]) <= 0.8
    implicit = Polynomial(2, set="2.11")
    for rate in (0.6, 0.999):
        found = identify(data, implicit, method=Rie(), comparators=(), max_rate=rate)
        none = np.zeros((1, 2))
        A = found.model.jacobian(none, none, np.zeros((1, 3)))[0, :, :2]
        assert np.abs(np.linalg.eigvals(A)).max() <= rate
    monotone = identify(Dataset(pair(1500, 1)), CLASS, method=Rie(), max_rate=0.5)
    assert monotone.proof.rate <= 0.5


def test_a_proof_that_is_too_slow_is_said_to_be_and_does_not_count() -> None:
    trial = drifting([0.97])
    exact = replace(trial, y=lfilter([0.0, 1.0], [1.0, -0.97], trial.u[:, 0]))
    data = Dataset((exact,))
    fit = identify(
        data,
        Polynomial(1),
        method=LeastSquares(),
        comparators=(),
        max_rate=0.9,
        allow_unproved=True,
    )
    assert fit.chosen.proof is None
    assert fit.chosen.remark == (
        "proved only at 0.9715 (3.5 s) a sample, slower than the max_rate of 0.9000 (0.95 s)"
    )
    assert fit.chosen.remark in str(fit)
    with pytest.raises(Infeasible, match=r"proved only at 0\.9715"):
        identify(data, Polynomial(1), method=LeastSquares(), comparators=(), max_rate=0.9)
    assert identify(data, Polynomial(1), method=LeastSquares()).proof.rate < 0.972


@pytest.mark.parametrize("rate", [0.0, 1.0, float("nan")])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(OptionError, match="max_rate"):
        identify(Dataset((drifting([0.5]),)), Polynomial(1), max_rate=rate)
