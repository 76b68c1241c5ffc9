"""Robust simulation error: the bound, its derivatives, its iterates, and what is refused."""

import numpy as np
import pytest

from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification import Fit, Polynomial, identify, prove_stability, simulation_percent
from nlsid_core.identification.polynomial.explicit import equation_error
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.models import DifferenceEquation, Signal
from tests.conftest import PERIOD, TRUE_A, TRUE_B, synthetic_dataset

EXACT = 1e-10  # agreement of two floating-point routes to the same number


def test_noise_free_data_give_the_true_coefficients_back() -> None:
    model = identify(synthetic_dataset(0.0), Polynomial(2)).model
    np.testing.assert_allclose(model.a, TRUE_A, atol=1e-6)
    np.testing.assert_allclose(model.b, TRUE_B, atol=1e-6)


def test_final_iterate_simulates_as_well_as_direct_minimisation(
    fit: Fit[DifferenceEquation], train: Dataset
) -> None:
    assert fit["rse"].error_percent(train) <= 1.001 * fit["sem"].error_percent(train)


def test_every_recorded_sample_scale_is_undone_once(train: Dataset) -> None:
    regression = build_state_affine_rows(train, Polynomial(2))
    model = equation_error(regression)
    rows = []
    targets = []
    for trial in train:
        y, u = trial.y[:, 0], trial.u[:, 0]
        for t in range(2, len(trial)):
            rows.append([y[t - 1], y[t - 2], u[t], u[t - 1], u[t - 2], 1.0])
            targets.append(y[t])
    expected = np.linalg.lstsq(np.array(rows), np.array(targets), rcond=None)[0]
    np.testing.assert_allclose([*model.a, *model.b, model.c], expected, atol=1e-9)


def test_observer_form_simulates_the_difference_equation(
    fit: Fit[DifferenceEquation], train: Dataset
) -> None:
    model = fit.model
    trial = train.trajectories[0]
    y, u, n = trial.y[:, 0], trial.u[:, 0], len(model)
    simulated = model.simulate(u, y[:n])
    x = model.state_after(y[:n], u[:n])
    for t in range(n, len(trial)):
        assert x[0] + model.D * u[t] + model.c == pytest.approx(simulated[t], abs=EXACT)
        x = model.A @ x + model.B[:, 0] * u[t] + model.offset


def test_an_unstable_model_gets_no_proof() -> None:
    model = DifferenceEquation(
        a=np.array([1.01]),
        b=np.array([0.0, 1.0]),
        c=0.0,
        period=0.1,
        y=Signal("y"),
        u=Signal("u"),
        u_range=(0.0, 1.0),
    )
    assert prove_stability(model) is None


def test_a_model_just_inside_the_unit_circle_is_proved() -> None:
    model = DifferenceEquation(
        a=np.array([1.9985, -0.99850045]),
        b=np.zeros(3),
        c=0.0,
        period=0.1,
        y=Signal("y"),
        u=Signal("u"),
        u_range=(0.0, 1.0),
    )
    proof = prove_stability(model)
    assert proof is not None
    assert float(np.abs(model.poles).max()) < proof.rate < 1.0


def test_error_percent_is_zero_for_the_truth(fit: Fit[DifferenceEquation]) -> None:
    clean = synthetic_dataset(0.0, trials=2)
    truth = DifferenceEquation(
        a=TRUE_A, b=TRUE_B, c=0.0, period=PERIOD, y=fit.model.y, u=fit.model.u, u_range=(0.0, 1.0)
    )
    assert simulation_percent(truth, clean) < 1e-9
