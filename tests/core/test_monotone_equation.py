"""Monotone equations: the model, its identification, and its proof on pairs of solutions."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification import LeastSquares, Polynomial, identify, prove_stability
from nlsid_core.identification.polynomial.implicit_rie import ImplicitFit
from nlsid_core.models import MonotoneEquation
from nlsid_core.models.monotone_equation import increasing, is_increasing, solve_increasing
from tests.repeated import pair, percent, truth, without_bias


@pytest.fixture(scope="module")
def fit() -> ImplicitFit:
    return without_bias(*pair(4000, 1))


@pytest.mark.parametrize("e", [(1.0, 0.0, 0.0), (3.0, 1.0, 1.0), (0.1, 0.0, 5.0), (1.0, -1.7, 1.0)])
def test_an_increasing_cubic_is_inverted_from_any_guess(e: tuple[float, float, float]) -> None:
    for v in (-1e4, -3.0, -1e-9, 0.0, 0.2, 7.0, 1e5):
        target = ((e[2] * v + e[1]) * v + e[0]) * v
        for guess in (0.0, -50.0, 1e3, v):
            found = solve_increasing(e, target, guess)
            slope = (3 * e[2] * v + 2 * e[1]) * v + e[0]
            sizes = abs(e[2] * v**3) + abs(e[1] * v**2) + abs(e[0] * v)
            assert abs(found - v) <= 1e-13 * (abs(v) + sizes / slope) + 1e-300


def test_a_function_that_is_not_increasing_is_refused() -> None:
    assert is_increasing(np.array([1.0, 1.7, 1.0]))
    assert not is_increasing(np.array([1.0, 1.75, 1.0]))
    assert not is_increasing(np.array([3.0, 3.0, 1.0])), "the slope vanishes at -1"
    for e in ([0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.0, 0.0, -1.0]):
        with pytest.raises(DataError, match="increasing"):
            replace(truth(), e=np.array(e))


@pytest.mark.parametrize("e", [(1.0, 0.0, -5e-13), (1.0, 1e-9, -1e-12), (1.0, -1e-7, 0.0)])
def test_what_a_solver_keeps_increasing_to_rounding_increases(
    e: tuple[float, float, float],
) -> None:
    assert is_increasing(increasing(np.array(e)))
    np.testing.assert_allclose(increasing(np.array(e)), e, atol=2e-7)


def test_simulation_solves_the_equation_and_documents_round_trip() -> None:
    model = replace(
        truth(),
        y_offset=0.3,
        u_offset=np.array([0.1]),
        window=((0, 0), (0, 3)),
        b=np.array([1.0, -0.4]),
    )
    u = np.random.default_rng(0).standard_normal(200)
    y = model.simulate(u, np.array([0.2, -0.1, 0.4])) - 0.3
    left = ((1.0 * y + 0.6) * y + 3.0) * y
    right = 0.1 + 1.2 * y[2:-1] - 0.5 * y[1:-2] + (u[3:] - 0.1) - 0.4 * (u[:-3] - 0.1)
    np.testing.assert_allclose(left[3:], right, atol=1e-13)
    again = MonotoneEquation.from_document(json.loads(json.dumps(model.document())))
    assert again.document() == model.document()
    np.testing.assert_array_equal(again.simulate(u), model.simulate(u))


def test_the_truth_is_found_and_proved(fit: ImplicitFit) -> None:
    assert percent(fit.model) < 2.0
    assert 0.0 < fit.proof.rate < 1.0


def test_the_proof_holds_on_pairs_of_solutions(fit: ImplicitFit) -> None:
    rng, P = np.random.default_rng(0), fit.proof.P
    for _ in range(20):
        u = rng.uniform(-20.0, 20.0, 40)
        first, second = (fit.model.simulate(u, rng.normal(scale=5.0, size=2)) for _ in range(2))
        gap = first - second
        V = np.array([[gap[t], gap[t - 1]] @ P @ [gap[t], gap[t - 1]] for t in range(1, 40)])
        assert (V[1:] <= fit.proof.rate**2 * V[:-1] * (1 + 1e-9) + 1e-20).all()


def test_a_lightly_damped_linear_equation_is_proved_as_the_linear_model_it_equals() -> None:
    model = replace(truth(), e=np.array([2.0, 0.0, 0.0]), a=np.array([3.6, -1.9]))
    proof = prove_stability(model)
    assert proof is not None
    assert np.sqrt(0.95) < proof.rate < 0.98, "poles of radius √0.95"
    unbounded = prove_stability(replace(model, e=np.array([2.0, 0.0, 1e-3])))
    assert unbounded is None, "with a slope without bound it is not positive real"


def test_a_resonance_is_identified_by_a_linear_equation() -> None:
    """Least squares finds it, and what it found is proved, although it is no minimiser of (3.8)."""
    resonant = replace(truth(), e=np.array([2.0, 0.0, 0.0]), a=np.array([3.6, -1.9]), c=0.0)
    u = np.random.default_rng(2).uniform(-1.0, 1.0, 1500)
    data = Dataset((Trajectory(t=0.01 * np.arange(1500), y=resonant.simulate(u), u=u),))
    fit = identify(data, Polynomial(2, (0,), set="3.8"), method=LeastSquares())
    assert fit.errors["train"]["least_squares"] < 1e-6
    assert fit.proof.rate < 0.98
