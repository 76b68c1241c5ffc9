"""Implicit models over whole trials: what their own steps give, at microseconds a sample."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.identification.polynomial.rollout import Rollout, simulate_together
from nlsid_core.models import ImplicitModel, Signal
from nlsid_core.models.polynomials import Polynomials
from tests import implicit_models

INPUT = (Signal("u", "V"),)


def recorded(model: ImplicitModel, window: tuple[tuple[int, int], ...]) -> ImplicitModel:
    """The model as one of recorded signals."""
    return replace(
        model, y=tuple(Signal(f"y{i}", "m") for i in range(model.unknowns)), u=INPUT, window=window
    )


MODELS = {
    "two lags": recorded(implicit_models.lagged(1.2, -0.5), ((0, 0),)),
    "a product with the input": recorded(implicit_models.cubic_spring(), ((0, 1),)),
    "two outputs": recorded(implicit_models.coupled(), ((0, 1),)),
    "far from a contraction": recorded(implicit_models.quintic(), ((0, 2),)),
}


def trial_of(model: ImplicitModel, samples: int, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    y = rng.uniform(-1.0, 1.0, (samples, model.unknowns))
    u = rng.uniform(-2.0, 2.0, samples)
    return Trajectory(t=0.1 * np.arange(samples), y=y, u=u, name=f"trial {seed}")


def stepped(model: ImplicitModel, trial: Trajectory) -> FloatArray:
    """The model's own steps, one after the other."""
    h, n_v = model.history, model.unknowns
    x = np.concatenate([trial.y[h - k] for k in range(1, model.lags + 1)])
    outputs = [*trial.y[:h]]
    for w in model.windows(trial.u):
        x = model.step(x[None], w[None])[0]
        outputs.append(x[:n_v])
    return np.array(outputs)


@pytest.mark.parametrize("name", MODELS)
def test_all_samples_together_are_the_models_own_steps(name: str) -> None:
    model = MODELS[name]
    trials = [trial_of(model, samples, samples) for samples in (40, 7, 150)]
    found = simulate_together(model, trials)
    assert Rollout(model, trials).solved(model.h.coefficients) is not None, "by Newton's method"
    for trial, outputs in zip(trials, found, strict=True):
        np.testing.assert_allclose(outputs, stepped(model, trial), atol=1e-11)


@pytest.mark.parametrize("name", MODELS)
def test_the_jacobian_is_that_of_the_equations(name: str) -> None:
    model = MODELS[name]
    rollout = Rollout(model, [trial_of(model, 9, 0), trial_of(model, 8, 1)])
    weights = rollout.weights(model.h.coefficients)
    y = np.random.default_rng(2).uniform(-1.0, 1.0, rollout.measured.shape)
    direction = np.where(rollout.free[:, None], np.random.default_rng(3).normal(size=y.shape), 0.0)
    step = 1e-6
    moved = [rollout.residual(y + s * step * direction, weights)[0] for s in (1, -1)]
    change = (moved[0] - moved[1]) / (2.0 * step)
    jacobian = rollout.linearised(rollout.residual(y, weights)[1])
    np.testing.assert_allclose(jacobian.solve(change[:, :, None])[:, :, 0], direction, atol=1e-7)


def test_a_model_that_diverges_is_infinite_from_there() -> None:
    model = MODELS["two lags"]
    coefficients = np.array(model.h.coefficients)
    cubic = model.h.exponents[:, 0] == 3
    coefficients[cubic] = 0.0
    coefficients[model.h.exponents[:, 1] == 1] = -30.0
    wild = replace(model, h=Polynomials(model.h.exponents, coefficients))
    trial = trial_of(model, 60, 0)
    (outputs,) = simulate_together(wild, [trial])
    first = int(np.argmax(~np.isfinite(outputs[:, 0])))
    assert 20 < first < 60, "3 y(t) = 30 y(t-1) + … passes 1e30 after about thirty samples"
    assert np.isinf(outputs[first:]).all()


def test_where_newton_does_not_settle_the_samples_are_stepped() -> None:
    """v + 9v⁵ = 4x³ + w from outputs of 30: not a contraction there."""
    quintic = MODELS["far from a contraction"]
    coefficients = np.where(quintic.h.exponents[:, [1]] == 3, -40.0, quintic.h.coefficients)
    steep = replace(quintic, h=Polynomials(quintic.h.exponents, coefficients))
    trial = trial_of(steep, 400, 5)
    far = replace(trial, y=30.0 * trial.y)
    assert Rollout(steep, [far]).solved(coefficients) is None
    (outputs,) = simulate_together(steep, [far])
    np.testing.assert_allclose(outputs[:20], stepped(steep, far)[:20], rtol=1e-9)
