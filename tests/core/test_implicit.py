"""Implicit models: one step, many samples, Jacobians, whole trials, documents."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError, DocumentError, ShapeError, SolverError
from nlsid_core.identification.polynomial.rollout import Rollout, simulate_together
from nlsid_core.models import ImplicitModel, Polynomials, Signal, monotone
from nlsid_core.models.implicit_step import SingleStep
from tests import implicit_models
from tests.implicit_models import coupled, cubic_spring, lagged, quintic
from tests.marks import slow_among

EVERY = {
    "quintic": quintic,
    "coupled": coupled,
    "lagged": lagged,
    "mixed": cubic_spring,
}


@pytest.mark.parametrize("name", EVERY)
def test_newton_and_the_ellipsoid_method_find_the_same_next_state(name: str) -> None:
    model, rng = EVERY[name](), np.random.default_rng(0)
    n, n_v = len(model), model.unknowns
    known = np.concatenate([3.0 * rng.normal(size=(40, n)), 3.0 * rng.normal(size=(40, 1))], axis=1)
    v = model.solve(known, start=known[:, :n_v])
    np.testing.assert_allclose(model.h(np.concatenate([v, known], axis=1)), 0.0, atol=1e-9)
    for row in range(5):
        found = model.ellipsoid(known[row], start=known[row, :n_v])
        np.testing.assert_allclose(found, v[row], atol=1e-5)


@pytest.mark.parametrize("name", EVERY)
def test_without_newton_the_ellipsoid_method_makes_the_step(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, rng = EVERY[name](), np.random.default_rng(4)
    x, w = rng.normal(size=(3, len(model))), rng.normal(size=(3, 1))
    after = model.step(x, w)
    monkeypatch.setattr(monotone, "NEWTON_STEPS", 0)
    np.testing.assert_allclose(model.step(x, w), after, atol=1e-6)


def test_the_ellipsoid_method_says_when_the_stated_monotonicity_is_false() -> None:
    model = quintic()
    lying = ImplicitModel(model.h, model.shift, 1e6, model.states, model.inputs, period=0.1)
    with pytest.raises(SolverError, match="is not 1e\\+06-monotone"):
        lying.ellipsoid(np.array([0.0, 5.0]), start=np.array([0.0]))


def test_an_equation_without_a_root_is_said_to_have_none() -> None:
    """v² + 1 = 0: not monotone at all."""
    model = ImplicitModel(
        Polynomials(np.array([[2, 0], [0, 0]]), np.array([[1.0], [1.0]])),
        Polynomials(np.zeros((0, 1), dtype=np.int64), np.zeros((0, 0))),
        0.5,
        ("v",),
        (),
        period=0.1,
    )
    with pytest.raises(SolverError, match="monotone"):
        model.step(np.zeros((1, 1)), np.zeros((1, 0)))


@pytest.mark.parametrize("name", EVERY)
def test_the_jacobian_of_a_step_equals_central_differences(name: str) -> None:
    model, rng = EVERY[name](), np.random.default_rng(1)
    n = len(model)
    x, w = rng.normal(size=(6, n)), rng.normal(size=(6, 1))
    exact = model.jacobian(model.step(x, w), x, w)
    step = 1e-6
    for j in range(n + 1):
        ahead, behind = (np.concatenate([x, w], axis=1) for _ in range(2))
        ahead[:, j] += step
        behind[:, j] -= step
        after = [model.step(z[:, :n], z[:, n:]) for z in (ahead, behind)]
        np.testing.assert_allclose(exact[:, :, j], (after[0] - after[1]) / (2 * step), atol=1e-6)


@pytest.mark.parametrize("name", EVERY)
def test_trajectories_together_equal_each_alone(name: str) -> None:
    model, rng = EVERY[name](), np.random.default_rng(2)
    x, w = rng.normal(size=(4, len(model))), rng.normal(size=(4, 30, 1))
    together = model.simulate(x, w)
    assert together.shape == (4, 31, len(model))
    for row in range(4):
        alone = model.simulate(x[[row]], w[[row]])
        np.testing.assert_allclose(together[row], alone[0], atol=1e-9)


def test_only_separable_models_come_apart() -> None:
    model = coupled()
    parts = model.separated()
    assert parts is not None
    again = ImplicitModel.separable(
        *parts, monotonicity=0.9, period=0.1, states=model.states, inputs=model.inputs
    )
    rng = np.random.default_rng(3)
    z = rng.normal(size=(5, 5))
    np.testing.assert_allclose(again.h(z), model.h(z), rtol=1e-14)
    assert cubic_spring().separated() is None
    assert lagged().separated() is None


def test_wrong_sizes_and_documents_are_refused() -> None:
    model = coupled()
    with pytest.raises(ShapeError, match="e should have 1 polynomials"):
        ImplicitModel.separable(
            Polynomials(np.array([[1, 0]]), np.ones((1, 2))),
            model.shift,
            monotonicity=0.5,
            period=0.1,
            states=("a",),
            inputs=("u",),
        )
    with pytest.raises(ShapeError, match="h should have 1 to 1 polynomials, has 2"):
        ImplicitModel(model.h, model.shift, 0.5, ("a",), ("u",), period=0.1)
    with pytest.raises(DataError, match="should be positive"):
        ImplicitModel(model.h, model.shift, 0.0, model.states, model.inputs, period=0.1)
    with pytest.raises(ShapeError, match=r"x should be \(B, 2\)"):
        model.step(np.zeros(2), np.zeros((1, 1)))
    document = lagged().document()
    document["shift"]["coefficients"] = [[1.0, 2.0]]
    with pytest.raises((DocumentError, ShapeError)):
        ImplicitModel.from_document(document)


# -- One sample of an implicit model on plain numbers: the same as the step of whole arrays

STEPPED: dict[str, Callable[[], ImplicitModel]] = {
    "quintic": implicit_models.quintic,
    "coupled": implicit_models.coupled,
    "lagged": implicit_models.lagged,
    "cubic spring": implicit_models.cubic_spring,
    "linear": lambda: implicit_models.linear(np.array([[0.6, 0.3], [-0.2, 0.5]])),
}


@pytest.mark.parametrize("name", STEPPED)
@pytest.mark.parametrize("size", slow_among([0.3, 3.0, 300.0], {300.0}))
def test_a_single_step_is_the_step_of_whole_arrays(name: str, size: float) -> None:
    """Also far away, where Newton's full steps fail and the model's own solver takes over."""
    model, rng = STEPPED[name](), np.random.default_rng(0)
    single = SingleStep(model)
    for _ in range(50):
        x = size * rng.normal(size=(3, len(model)))
        w = size * rng.normal(size=len(model.inputs))
        expected = model.step(x, np.tile(w, (3, 1)))
        assert single(x, w) == pytest.approx(expected, rel=1e-8, abs=1e-8)


# -- Implicit models over whole trials: what their own steps give, at microseconds a sample

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
