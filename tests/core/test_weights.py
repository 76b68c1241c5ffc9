"""Weights of several outputs: what is minimised is Σ |y - ŷ|²_W, by every method."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from bags.chain.identification_config import Identification
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, OptionError
from nlsid_core.identification import (
    CertifiedRse,
    CertifiedSem,
    Method,
    Rse,
    StateAffineClass,
    identify,
    simulation_percent,
)
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.starts import stable_starts
from nlsid_core.models import StateAffineModel

W = (100.0, 0.01)


@pytest.fixture(scope="module")
def trials() -> Dataset:
    """Two outputs of two resonances, the second in a thousandth of the unit, which one lag misses.

    Each output is a sum of both, so that a model of one lag has to choose.
    """
    rng, made = np.random.default_rng(0), []
    for k in range(2):
        u = np.repeat(rng.normal(size=(40, 1)), 5, axis=0)
        x = np.zeros((len(u), 4))
        for t in range(len(u) - 1):
            for i, (r, angle) in enumerate(((0.9, 0.5), (0.8, 1.4))):
                c, s = r * np.cos(angle), r * np.sin(angle)
                a, b = x[t, 2 * i : 2 * i + 2]
                x[t + 1, 2 * i : 2 * i + 2] = c * a - s * b + u[t, 0], s * a + c * b
        y = np.column_stack([x[:, 0] + 0.5 * x[:, 2], 1000.0 * (x[:, 2] - 0.5 * x[:, 1])])
        made.append(Trajectory(t=0.01 * np.arange(len(u)), y=y, u=u, name=f"run {k}"))
    return Dataset(tuple(made))


def squares(model: StateAffineModel, trials: Dataset) -> FloatArray:
    """(2,) squared errors of the simulation in units of the outputs' spread."""
    spread = np.concatenate([t.y for t in trials]).std(axis=0)
    n = len(model)
    errors = [(t.y - model.simulate(t.u, t.y[:n]))[n:] / spread for t in trials]
    total: FloatArray = (np.concatenate(errors) ** 2).sum(axis=0)
    return total


@pytest.mark.parametrize(
    "method",
    [Rse(iterations=15), pytest.param(CertifiedSem(iterations=5), marks=pytest.mark.slow)],
    ids=lambda method: method.name,
)
def test_weights_decide_which_output_is_fitted(method: Method, trials: Dataset) -> None:
    """By its own measure each fit is better than the other one."""
    found = {
        weights: squares(
            identify(
                trials, StateAffineClass(1, weights=weights), method=method, comparators=()
            ).model,
            trials,
        )
        for weights in (W, W[::-1])
    }
    first, second = found[W], found[W[::-1]]
    assert first @ W < 0.9 * (second @ W)
    assert second @ W[::-1] < 0.9 * (first @ W[::-1])
    assert first[0] < second[0]
    assert second[1] < first[1]


def test_equal_weights_change_nothing_but_the_unit(trials: Dataset) -> None:
    """Σ |y - ŷ|²_W with W = 4 I has the minimum of W = I."""
    models = [
        identify(
            trials, StateAffineClass(1, weights=weights), method=Rse(iterations=8), comparators=()
        ).model
        for weights in (None, (1.0, 1.0), (4.0, 4.0))
    ]
    errors = [simulation_percent(model, trials) for model in models]
    assert errors[0] == errors[1]
    assert errors[2] == pytest.approx(errors[0], rel=1e-6)


def test_a_start_is_the_same_model_whatever_the_weights_are(trials: Dataset) -> None:
    for _, theta in stable_starts(trials, 1):
        poles = []
        for weights in (None, W):
            rows = build_state_affine_rows(trials, StateAffineClass(1, weights=weights))
            model = rows.model(rows.embedded(theta), np.zeros((len(rows.right), 2)).ravel())
            A = -np.linalg.solve(model.G[0].coefficients[0], model.G[1].coefficients[0])
            poles.append(np.diag(model.y_scale) @ A @ np.diag(1.0 / model.y_scale))
        np.testing.assert_allclose(poles[1], poles[0], rtol=1e-10)


def test_the_certified_method_proves_a_weighted_model(trials: Dataset) -> None:
    fit = identify(
        trials, StateAffineClass(1, weights=W), method=CertifiedRse(iterations=1), comparators=()
    )
    assert fit.proof.rate < 1.0


def test_a_configuration_states_them_beside_the_other_options() -> None:
    section = {"model": "state_affine", "lags": 1, "weights": [100, 0.01]}
    assert TypeAdapter(Identification).validate_python(section).model_class == StateAffineClass(
        1, weights=W
    )


@pytest.mark.parametrize("weights", [(), (0.0, 1.0), (-1.0, 1.0), (float("inf"), 1.0)])
def test_weights_that_are_none_are_refused(weights: tuple[float, ...]) -> None:
    with pytest.raises(OptionError, match="finite numbers above 0"):
        StateAffineClass(1, weights=weights)


def test_weights_of_other_outputs_are_refused(trials: Dataset) -> None:
    with pytest.raises(DataError, match="weights has 3 outputs, the data 2"):
        identify(trials, StateAffineClass(1, weights=(1.0, 2.0, 3.0)))
