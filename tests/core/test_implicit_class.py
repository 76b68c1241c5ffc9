"""Implicit models searched in each stable set: bounds that hold, known truths, what is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification import (
    Degrees,
    LeastSquares,
    Polynomial,
    Search,
    identify,
    simulate_trial,
)
from nlsid_core.identification.polynomial.implicit_rie import minimise_implicit_rie
from nlsid_core.identification.polynomial.implicit_rows import build_implicit_rows
from nlsid_core.identification.polynomial.options import StableSet
from nlsid_core.models import ImplicitModel

WIDE = ((-30.0, 30.0),) * 3
STATE = (1,)  # delays where the output is the state
SPRING = Polynomial(1, STATE, Degrees(left=3), set="2.11")
CLASSES = [
    SPRING,
    Polynomial(1, STATE, Degrees(left=5, past=3), set="2.13"),
    Polynomial(1, STATE, set="2.19"),
    Polynomial(2, (0, 1), Degrees(left=3), set="2.11"),
    Polynomial(
        1,
        STATE,
        Degrees(left=3, past=3, lagged=1),
        output_range=((-4.0, 4.0),),
        input_range=((-2.5, 2.5),),
        set="2.13",
    ),
    Polynomial(
        2,
        STATE,
        Degrees(left=3, past=3),
        output_range=((-4.0, 4.0),),
        input_range=((-2.5, 2.5),),
        set="2.11",
    ),
]


def spring(
    samples: int, seed: int, *, noise: float, gain: float = 1.0, mean: float = 0.0
) -> Trajectory:
    """v + v³/2 = 0.6 x + u, measured in other units."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-2.0, 2.0, samples), np.zeros(samples)
    for t in range(1, samples):
        r = 0.6 * x[t - 1] + u[t - 1]
        root = np.cbrt(r + np.sqrt(r**2 + 8.0 / 27.0))  # Cardano: v³ + 2v = 2r
        x[t] = root - 2.0 / (3.0 * root)
    y = gain * (x + noise * rng.standard_normal(samples)) + mean
    return Trajectory(t=0.01 * np.arange(samples), y=y, u=u, name=f"run {seed}")


def decay(a: float, samples: int, noise: float) -> Dataset:
    """x⁺ = a x + u."""
    rng = np.random.default_rng(3)
    u, x = rng.uniform(-1.0, 1.0, samples), np.zeros(samples)
    for t in range(1, samples):
        x[t] = a * x[t - 1] + u[t - 1]
    y = x + noise * rng.standard_normal(samples)
    return Dataset((Trajectory(t=0.01 * np.arange(samples), y=y, u=u, name="decay"),))


def slopes(model: ImplicitModel) -> np.ndarray:
    """h's coefficients of v, v³, x, w over that of v."""
    at = {tuple(row): k for k, row in enumerate(model.h.exponents.tolist())}
    rows = [at[key] for key in ((1, 0, 0), (3, 0, 0), (0, 1, 0), (0, 0, 1))]
    return np.asarray(model.h.coefficients[rows, 0] / model.h.coefficients[rows[0], 0])


@pytest.mark.parametrize("model_class", CLASSES, ids=str)
def test_the_bound_is_above_the_simulation_error_in_every_set(model_class: Polynomial) -> None:
    for noise in (0.02, 0.3):
        data = Dataset((spring(150, 0, noise=noise), spring(110, 1, noise=noise)))
        rows = build_implicit_rows(data, model_class)
        fit = minimise_implicit_rie(rows)
        h, lags = fit.model.history, model_class.lags
        weight, spread = np.diag(rows.weight), float(rows.y_scale[1][0])
        total, count = 0.0, 0
        for trial in data:
            error = (trial.y - simulate_trial(fit.model, trial))[:, 0] / spread
            states = np.column_stack([error[h - k : len(trial) - k] for k in range(1, lags + 1)])
            total += float((states**2 @ weight).sum())
            count += len(states)
        assert 0.0 < total / count <= fit.bound


def test_the_linear_bound_is_the_best_there_is_of_first_order() -> None:
    """Proposition 3.1: |x⁺ - ax - bw|²/(1 - |a|)², which is also Proposition 2.19's lower bound."""
    data = decay(0.7, 400, 0.1)
    bound = minimise_implicit_rie(build_implicit_rows(data, CLASSES[2])).bound
    trial = data.trajectories[0]
    y, u = ((part - part.mean()) / part.std() for part in (trial.y[:, 0], trial.u[:, 0]))
    right = np.column_stack([u[:-1], np.ones(len(u) - 1)])
    values = []
    for a in np.linspace(-0.9, 0.9, 1801):
        left = y[1:] - a * y[:-1]
        error = left - right @ np.linalg.lstsq(right, left, rcond=None)[0]
        values.append(float(np.mean(error**2)) / (1.0 - abs(a)) ** 2)
    assert min(values) * (1.0 - 1e-6) <= bound <= 1.011 * min(values)


@pytest.mark.parametrize("name", ["2.11", "2.13"])
def test_a_cubic_spring_without_noise_is_found(name: StableSet) -> None:
    data = Dataset((spring(300, 0, noise=0.0),))
    fit = identify(data, replace(SPRING, set=name), search=Search(comparators=()))
    np.testing.assert_allclose(slopes(fit.model), [1.0, 0.5, -0.6, -1.0], atol=2e-3)
    assert fit.errors["train"]["rie"] < 0.05


def test_a_cubic_spring_is_found_within_the_noise_where_a_linear_model_is_far_off() -> None:
    data = Dataset((spring(700, 0, noise=0.01), spring(500, 1, noise=0.01)))
    test = Dataset((spring(300, 7, noise=0.0),))
    fit = identify(data, SPRING, test=test)
    linear = identify(data, Polynomial(1, (1,), set="2.19"), test=test)
    noise = 100.0 * 0.01 / float(test.trajectories[0].y.std())
    assert fit.errors["test"]["rie"] < noise
    assert linear.errors["test"]["least_squares"] > 10.0 * noise
    np.testing.assert_allclose(slopes(fit.model), [1.0, 0.5, -0.6, -1.0], atol=0.05)


@pytest.mark.parametrize("name", ["2.11", "2.13"])
def test_units_and_offsets_of_the_signals_change_nothing(name: StableSet) -> None:
    plain, large, small = (
        identify(
            Dataset((spring(200, 0, noise=0.01, gain=g, mean=m),)),
            replace(SPRING, set=name),
            search=Search(comparators=()),
        ).errors["train"]["rie"]
        for g, m in ((1.0, 0.0), (1e3, 4e3), (1e-3, -5e-3))
    )
    assert large == pytest.approx(plain, abs=1e-3)
    assert small == pytest.approx(plain, abs=1e-3)


def test_the_nearest_stable_model_of_an_unstable_truth_is_found_and_least_squares_not_proved() -> (
    None
):
    fit = identify(decay(1.02, 100, 0.0), SPRING, search=Search(comparators=[LeastSquares()]))
    assert fit["least_squares"].proof is None
    assert fit.errors["train"]["least_squares"] < 0.1 < fit.errors["train"]["rie"]
    assert fit.proof.rate == 1.0
    assert "proved, no rate" in str(fit)
    assert "squared spreads of the outputs, at most 0." in str(fit)


# -- files ---------------------------------------------------------------------------------------


def test_the_document_keeps_signals_and_refuses_a_wrong_window() -> None:
    model = identify(
        Dataset((spring(200, 0, noise=0.01),)), CLASSES[3], search=Search(comparators=())
    ).model
    document = model.document()
    again = ImplicitModel.from_document(document)
    assert (again.y, again.u, again.window) == (model.y, model.u, ((0, 0), (0, 1)))
    assert again.document() == document
    damages: tuple[dict[str, Any], ...] = (
        {"window": [[0, -1], [0, 1]]},
        {"window": [[3, 0], [0, 1]]},
        {"window": []},
        {"u": ["u"]},
    )
    for damage in damages:
        with pytest.raises(DataError):
            ImplicitModel.from_document(document | damage)


# -- bad input -----------------------------------------------------------------------------------


def two_inputs(samples: int) -> Dataset:
    """A first-order response to two random inputs."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=(samples, 2))
    y = lfilter([0.0, 1.0], [1.0, -0.7], u[:, 0] + 0.3 * u[:, 1] ** 3)
    y = y + 0.01 * rng.normal(size=samples)
    return Dataset((Trajectory(t=0.1 * np.arange(samples), y=y, u=u, name="two"),))


def test_many_terms_of_the_inputs_alone_cost_a_search_little() -> None:
    data = two_inputs(2000)
    fit = identify(
        data,
        Polynomial(4, degrees=Degrees(left=3, inputs=3), set="2.11"),
        search=Search(comparators=()),
    )
    assert fit.chosen.proof is not None
    assert len(fit.model.h.exponents) > 285


def test_terms_in_the_inputs_alone_are_their_least_squares() -> None:
    data = two_inputs(400)
    rows = build_implicit_rows(data, Polynomial(2, degrees=Degrees(left=3, inputs=2), set="2.11"))
    found = minimise_implicit_rie(rows)
    c = np.concatenate([found.e, -found.f])
    driven = np.concatenate([np.zeros(len(rows.left), dtype=bool), rows.driven])
    rest = rows.R[:, ~driven] @ c[~driven]
    best = np.linalg.lstsq(rows.R[:, driven], -rest, rcond=None)[0]
    np.testing.assert_allclose(c[driven], best, atol=1e-9)


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (
            Polynomial(4, degrees=Degrees(left=3, inputs=5), set="2.11"),
            "3010 terms an equation of 4 past outputs and 10",
        ),
        (
            Polynomial(99, degrees=Degrees(left=3), set="2.11"),
            "99 states, more than 60: .*; use fewer lags",
        ),
        (
            Polynomial(
                2,
                degrees=Degrees(left=9, past=2, lagged=1),
                output_range=WIDE[:1],
                input_range=WIDE[1:],
                set="2.11",
            ),
            "monomials",
        ),
        (
            Polynomial(
                5,
                degrees=Degrees(left=3, past=2, lagged=1),
                output_range=WIDE[:1],
                input_range=WIDE[1:],
                set="2.11",
            ),
            "semidefinite block of order",
        ),
    ],
)
def test_a_class_too_large_for_a_search_is_refused(made: Polynomial, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        identify(two_inputs(1000), made)


def test_data_that_do_not_fit_the_class_are_refused() -> None:
    data = Dataset((spring(60, 0, noise=0.01),))
    for model_class, reason in (
        (
            Polynomial(70, degrees=Degrees(left=3), set="2.11"),
            "60 samples, a history of 70 needs more",
        ),
        (
            Polynomial(20, degrees=Degrees(left=3), set="2.11"),
            "steps for 42 regressors; give more data",
        ),
        (
            replace(SPRING, output_range=((-4.0, 4.0),), input_range=((-3.0, 3.0),) * 2),
            "3 intervals for 1 outputs and 1 inputs",
        ),
        (
            replace(SPRING, output_range=((-0.5, 4.0),), input_range=((-3.0, 3.0),)),
            r"y0 reaches \[.*outside the range",
        ),
    ):
        with pytest.raises(DataError, match=reason):
            identify(data, model_class)
    still = replace(data.trajectories[0], u=np.full((60, 1), 0.4))
    with pytest.raises(DataError, match=r"u0 is constant \(0.4\)"):
        identify(Dataset((still,)), SPRING)
    square = replace(data.trajectories[0], u=np.tile([0.0, 1.0], 30)[:, None])
    with pytest.raises(DataError, match="regressors of rank"):
        identify(Dataset((square,)), Polynomial(1, (0, 1), Degrees(left=3), set="2.11"))
