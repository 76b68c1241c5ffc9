"""Simulation error minimised inside the convex sets: proved, and as low as without a proof."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid import Dataset, Degrees, LeastSquares, Polynomial, Rie, Sem, Trajectory, identify
from nlsid_core import proofs
from nlsid_core.identification import Search
from nlsid_core.identification.polynomial.implicit_descent import ImplicitSet
from nlsid_core.identification.polynomial.implicit_rie import least_squares_coefficients
from nlsid_core.identification.polynomial.implicit_rows import build_implicit_rows
from nlsid_core.identification.starts import as_implicit, linear_start
from tests.repeated import CLASS, run, truth


def noisy(samples: int, seed: int, noise: float = 0.1) -> Dataset:
    return Dataset((run(np.random.default_rng(seed).uniform(-2, 2, samples), noise, seed),))


def resonant(samples: int, seed: int) -> Dataset:
    """A lightly damped response, which no V of the monotone set proves: poles of radius 0.97."""
    rng = np.random.default_rng(seed)
    made = replace(truth(), e=np.array([2.0, 0.0, 0.2]), a=np.array([3.6, -1.9]), c=0.0)
    u = rng.uniform(-1.0, 1.0, samples)
    y = made.simulate(u) + 0.05 * rng.standard_normal(samples)
    return Dataset((Trajectory(t=0.01 * np.arange(samples), y=y, u=u),))


def coupled(samples: int, seed: int) -> Dataset:
    """Two states x⁺ = A x + B u, measured with noise in different units."""
    rng = np.random.default_rng(seed)
    A, B = np.array([[0.9, 0.2], [-0.3, 0.8]]), np.array([[1.0, 0.0], [0.3, -0.5]])
    u, x = rng.uniform(-1.0, 1.0, (samples, 2)), np.zeros((samples, 2))
    for t in range(1, samples):
        x[t] = A @ x[t - 1] + B @ u[t - 1]
    y = (x + 0.4 * rng.standard_normal(x.shape)) * [1.0, 30.0] + [0.0, 5.0]
    return Dataset((Trajectory(t=0.1 * np.arange(samples), y=y, u=u),))


def test_where_the_set_does_not_matter_the_minimum_is_the_free_one() -> None:
    fit = identify(
        noisy(600, 1), CLASS, method=Sem(certified=True), search=Search(comparators=(Sem(), Rie()))
    )
    free, proved = (fit.errors["train"][name] for name in ("sem", "sem_certified"))
    assert proved == pytest.approx(free, rel=1e-4)
    assert proved < 0.95 * fit.errors["train"]["rie"]
    assert fit.proof.rate < 1.0


@pytest.mark.slow
def test_where_the_set_matters_the_model_stays_in_it_and_beats_the_bound() -> None:
    data = resonant(1500, 0)
    model_class = Polynomial(2, (0,), Degrees(left=3), set="3.8")
    fit = identify(
        data, model_class, method=Sem(certified=True), search=Search(comparators=(Sem(), Rie()))
    )
    errors = fit.errors["train"]
    assert errors["sem"] < errors["sem_certified"] < 0.98 * errors["rie"]
    assert fit["sem"].proof is None, "the truth is outside the set"
    assert fit.proof.rate <= fit.max_rate
    decided = proofs.decide(
        fit.proof.document(fit.model, "m.json"), {"m.json": fit.model.document()}
    )
    assert "incremental stability" in decided.statement


@pytest.mark.parametrize(
    "model_class",
    [
        Polynomial(1, (0,), Degrees(left=3), set="2.13"),
        Polynomial(1, (0,), set="2.19"),
        *(
            pytest.param(longer, marks=pytest.mark.slow)
            for longer in (
                Polynomial(2, (0,), Degrees(left=3), set="2.11"),
                Polynomial(1, (0,), Degrees(left=5, past=3), set="2.13"),
                Polynomial(
                    1,
                    (0,),
                    Degrees(left=3, past=2),
                    output_range=((-4.0, 4.0),),
                    input_range=((-2.1, 2.1),),
                    set="2.11",
                ),
            )
        ),
    ],
    ids=str,
)
def test_every_set_of_implicit_models_has_a_proved_minimum_below_its_bounds(
    model_class: Polynomial,
) -> None:
    fit = identify(
        noisy(500, 1),
        model_class,
        method=Sem(certified=True),
        search=Search(comparators=(LeastSquares(), Rie())),
    )
    errors = fit.errors["train"]
    assert errors["sem_certified"] < min(errors["rie"], errors["least_squares"]) * (1 + 1e-9)
    document = fit.proof.document(fit.model, "m.json")
    assert document["claim"]["set"] == model_class.set
    proofs.decide(document, {"m.json": fit.model.document()})


@pytest.mark.slow
def test_linear_models_of_several_measured_states_are_found_and_proved() -> None:
    data, test = coupled(400, 0), coupled(400, 1)
    fit = identify(
        data,
        Polynomial(1, (1,), set="2.19"),
        method=Sem(certified=True),
        search=Search(comparators=(LeastSquares(),)),
        test=test,
    )
    for name in ("train", "test"):
        errors = fit.errors[name]
        assert errors["sem_certified"] < 0.9 * errors["least_squares"], "noise biases the latter"
    none = np.zeros((1, 2))
    A = fit.model.jacobian(none, none, none)[0, :, :2] * [[1.0, 30.0], [1.0 / 30.0, 1.0]]
    assert np.abs(A - [[0.9, 0.2], [-0.3, 0.8]]).max() < 0.05


def test_the_sensitivities_are_those_of_the_simulation() -> None:
    data = noisy(60, 1)
    rows = build_implicit_rows(
        data,
        Polynomial(
            2,
            (0, 1),
            Degrees(left=3, past=2),
            output_range=((-9, 9),),
            input_range=((-3, 3),),
            set="2.11",
        ),
    )
    problem, theta = (
        ImplicitSet(rows, 1.0),
        np.concatenate(least_squares_coefficients(rows)).ravel(),
    )
    direction = np.random.default_rng(0).normal(size=theta.size) * np.abs(theta)
    found = problem.outputs(theta)
    moved = [problem.outputs(theta + s * 1e-6 * direction) for s in (1.0, -1.0)]
    assert found is not None
    assert moved[0] is not None
    assert moved[1] is not None
    change = (moved[0].r - moved[1].r) / 2e-6
    np.testing.assert_allclose(found.J @ direction, change, atol=1e-6 * np.abs(change).max())
    assert problem.cost(theta) == pytest.approx(float(found.r @ found.r))


def test_a_linear_model_begins_as_itself_in_the_other_classes() -> None:
    data = noisy(400, 3)
    start = linear_start(data, 2, (0, 1))
    assert start is not None
    trial = data.trajectories[0]
    expected = start.simulate(trial.u, trial.y[:2])[:, 0]
    straight = build_implicit_rows(data, Polynomial(2, (0, 1), set="3.8"))
    same = straight.model(*as_implicit(start, straight), 1.0).simulate(trial.u, trial.y[:2, 0])
    np.testing.assert_allclose(same, expected, atol=1e-9)
    rows = build_implicit_rows(data, Polynomial(2, (0, 1), Degrees(left=3), set="2.11"))
    found = ImplicitSet(rows, 1.0).outputs(np.concatenate(as_implicit(start, rows)).ravel())
    assert found is not None
    error = (expected - trial.y[:, 0])[2:] / rows.y_scale[1][0]
    np.testing.assert_allclose(found.r, error, atol=1e-9)


@pytest.mark.slow
def test_of_a_random_walk_there_is_a_stable_model_too() -> None:
    u = np.random.default_rng(1).uniform(-1.0, 1.0, 300)
    y = np.cumsum(np.random.default_rng(0).standard_normal(300))
    data = Dataset((Trajectory(t=np.arange(300.0), y=y, u=u),))
    fit = identify(
        data,
        Polynomial(1, (0,), Degrees(left=3), set="3.8"),
        method=Sem(certified=True),
        search=Search(comparators=()),
    )
    assert fit.proof.rate <= fit.max_rate
