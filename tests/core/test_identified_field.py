"""From recorded signals to a differential equation, and to a proved funnel of it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.dynamics import VectorField, identified_field
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification import Degrees, Fit, Polynomial, Sem, identify
from nlsid_core.models import ImplicitModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.proofs import check

PERIOD = 0.02
PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto-funnels.md"
Rates = Callable[[FloatArray, FloatArray], FloatArray]


def drag(x: FloatArray, u: FloatArray) -> FloatArray:
    return -0.5 * x - 0.8 * x**3 + u


def network(x: FloatArray, u: FloatArray) -> FloatArray:
    return np.array([-0.5 * x[0] + 0.3 * x[1] + u[0], 0.6 * x[0] - 1.2 * x[1]])


def recorded(rates: Rates, n: int, seed: int, *, period: float = PERIOD) -> Trajectory:
    """20 s under an input that changes every 0.4 s, the outputs with noise of 1e-3."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.5, 1.5, (50, 1)), round(0.4 / period), axis=0)
    x = np.zeros((len(u), n))
    for k in range(len(u) - 1):
        x[k + 1] = held(rates, x[k], u[k], period)
    noise = 1e-3 * rng.standard_normal(x.shape)
    return Trajectory(t=period * np.arange(len(u)), y=x + noise, u=u, name=f"run {seed}")


def held(rates: Rates, x: FloatArray, u: FloatArray, seconds: float) -> FloatArray:
    solved = solve_ivp(lambda _, x: rates(x, u), (0, seconds), x, rtol=1e-9, atol=1e-11)
    return np.asarray(solved.y[:, -1])


def field_rates(field: VectorField) -> Rates:
    return lambda x, u: field(0.0, x[None], u[None])[0]


@pytest.fixture(scope="module")
def slowed() -> Fit[ImplicitModel]:
    cubic = Polynomial(
        1,
        (1,),
        Degrees(left=3, past=3),
        output_range=((-2, 2),),
        input_range=((-2, 2),),
        set="2.13",
        continuous=True,
    )
    return identify(
        Dataset((recorded(drag, 1, 0),)), cubic, method=Sem(10, certified=True), comparators=()
    )


def test_an_identified_equation_is_the_one_that_made_the_recording(
    slowed: Fit[ImplicitModel],
) -> None:
    assert slowed.proof.document(slowed.model, "model.json")["claim"]["kind"] == "stable_set"
    (found,) = identified_field(slowed.model).pieces[0]
    terms = {key[1:]: float(c) for key, c in found.terms()}
    assert terms[1, 0] == pytest.approx(-0.5, abs=0.03)
    assert terms[3, 0] == pytest.approx(-0.8, abs=0.03)
    assert terms[0, 1] == pytest.approx(1.0, abs=0.01)
    assert abs(terms[2, 0]) < 0.03
    assert abs(terms[0, 0]) < 0.03


@pytest.mark.parametrize("period", [0.01, 0.04])
def test_a_model_of_50_hz_predicts_recordings_of_other_rates(
    slowed: Fit[ImplicitModel], period: float
) -> None:
    rates, trial = field_rates(identified_field(slowed.model)), recorded(drag, 1, 7, period=period)
    x = trial.y[0]
    missed = []
    for k in range(len(trial) // 4):
        missed.append(trial.y[k] - x)
        x = held(rates, x, trial.u[k], period)
    assert float(np.sqrt(np.mean(np.square(missed)))) < 0.01 * float(trial.y.std())


def test_a_step_of_the_model_is_the_trapezoidal_rule_of_the_field(
    slowed: Fit[ImplicitModel],
) -> None:
    field, x, u = (
        identified_field(slowed.model),
        np.array([[0.7], [-0.4]]),
        np.array([[1.0], [0.2]]),
    )
    after = slowed.model.step(x, u)
    rate = (field(0.0, x, u) + field(0.0, after, u)) / 2.0
    np.testing.assert_allclose(after, x + PERIOD * rate, atol=1e-12)


@pytest.mark.slow
def test_every_linear_model_of_measured_states_has_a_field() -> None:
    data = Dataset((recorded(network, 2, 1),))
    fit = identify(
        data, Polynomial(1, (1,), set="2.19"), method=Sem(5, certified=True), comparators=()
    )
    A, B = identified_field(fit.model).jacobians(0.0, np.zeros(2), np.zeros(1))
    np.testing.assert_allclose(A, [[-0.5, 0.3], [0.6, -1.2]], atol=0.06)
    np.testing.assert_allclose(B, [[1.0], [0.0]], atol=0.06)


@pytest.mark.slow
def test_the_page_goes_from_a_recording_to_a_proved_funnel(tmp_path: Path) -> None:
    (block,) = [
        part
        for part in re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
        if "identified_field" in part
    ]
    made: dict[str, Any] = {}
    exec(block, made)
    assert made["field"].uncertain.tolist() == [[-0.01, 0.01]]
    assert made["funnel"].funnel.widths(0.0)[0] > 0.1
    made["funnel"].save(tmp_path)
    assert check(tmp_path / "funnel.proof.json")


def test_models_that_step_no_such_equation_are_refused(slowed: Fit[ImplicitModel]) -> None:
    h = slowed.model.h
    other = h.coefficients.copy()
    cubic = int(np.flatnonzero((h.exponents == [3, 0, 0]).all(axis=1))[0])
    other[cubic] *= 1.001
    changed = replace(slowed.model, h=Polynomials(h.exponents, other))
    with pytest.raises(DataError, match="continuous: true"):
        identified_field(changed)
    with pytest.raises(DataError, match="inputs one sample before"):
        identified_field(replace(slowed.model, window=((0, 0),)))
    with pytest.raises(ShapeError, match="2 pairs"):
        identified_field(slowed.model, box=[(-1, 1)])
    with pytest.raises(ShapeError, match="half-widths"):
        identified_field(slowed.model, disturbance=[-1.0])
