"""Implicit models: solving for the next state, Jacobians, simulation, documents."""

import numpy as np
import pytest

from nlsid_core import files
from nlsid_core.errors import DataError, DocumentError, ShapeError, SolverError
from nlsid_core.models import ImplicitModel, monotone
from nlsid_core.models.polynomials import Polynomials
from tests.implicit_models import coupled, cubic_spring, lagged, quintic

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


@pytest.mark.parametrize("name", EVERY)
def test_a_document_round_trips(name: str) -> None:
    document = EVERY[name]().document()
    text = files.encode(document)
    again = ImplicitModel.from_document(files.parse_document(text)).document()
    assert files.digest(again) == files.digest(document)


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
