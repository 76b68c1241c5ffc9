"""One verb for every model class and method: options, bounds, rates, the command line."""

import math
import pickle
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.signal import lfilter

from bags.chain.shipped import config_file
from bags.designs import documents
from bags.pictures.report import page
from nlsid import (
    CellRow,
    Dataset,
    Degrees,
    Feedback,
    FilterMapFilter,
    Fit,
    LeastSquares,
    Network,
    Polynomial,
    Rie,
    Rse,
    Sem,
    Trajectory,
    check,
    f1tenth,
    identify,
)
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, Infeasible, OptionError
from nlsid_core.identification import (
    METHODS,
    Search,
    methods_of,
    prove_stability,
    validate,
)
from nlsid_core.identification.polynomial.explicit import equation_error
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.rates import rate_of_memory, searched_rate
from nlsid_core.models import DifferenceEquation, Signal, StateAffineModel
from tests.conftest import TRUE_A, TRUE_B, synthetic_dataset
from tests.marks import slow_among
from tests.repeated import CLASS, pair
from tests.verbs import nlsid

STATE_AFFINE = {
    "lags": 2,
    "model": "state_affine",
    "method": "rse",
    "certified": True,
    "iterations": 5,
    "leading_degree": 1,
    "inputs_degree": 1,
    "input_range": [0.0, 0.5],
}
BAGS = [str(bag) for bag in f1tenth() if bag.name[-2:] in {"01", "03", "05", "13", "23", "35"}]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """The shipped configuration with a state-affine model, and no plan that it could track."""
    content = yaml.safe_load(config_file("f1tenth.yaml").read_text())
    del content["funnel"]
    content["identification"] = STATE_AFFINE
    content["split"] = {"test": ["trial_05"]}
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_fit_says_what_was_found(train: Dataset) -> None:
    test = synthetic_dataset(0.01, trials=2)
    fit = identify(train, Polynomial(2), test=test)
    text = str(fit)
    assert "train    test" in text
    assert f"* {Rse().title}" in text
    assert fit.errors["test"]["rse"] == fit.chosen.error_percent(test)


def test_a_state_affine_class_contains_the_linear_truth(train: Dataset) -> None:
    fit = identify(train, Polynomial(2, (0, 1, 2)), method=Rse(certified=True))
    assert isinstance(fit.model, StateAffineModel)
    linear = identify(train, Polynomial(2))
    assert fit["rse"].error_percent(train) == pytest.approx(
        linear["rse"].error_percent(train), rel=1e-4
    )
    assert set(fit.errors["train"]) >= {"least_squares", "rse_certified"}
    lagged = np.array([g.coefficients[0, 0, 0] for g in fit.model.G])
    np.testing.assert_allclose(-lagged[1:] / lagged[0], TRUE_A, atol=0.02)


def unstable_recordings() -> Dataset:
    """A pole at 1.02, excited for 150 samples at a time."""
    trials = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u, y = rng.standard_normal(150), np.zeros(150)
        for t in range(1, 150):
            y[t] = 1.02 * y[t - 1] + u[t - 1] + 0.1 * rng.standard_normal()
        trials.append(Trajectory(t=np.linspace(0.0, 14.9, 150), y=y, u=u, name=f"run {seed}"))
    return Dataset(tuple(trials))


@pytest.mark.slow
@pytest.mark.pictures
def test_an_unstable_truth_gets_the_best_stable_model_and_a_residual_that_is_not_white() -> None:
    data = unstable_recordings()
    with pytest.raises(Infeasible, match="no proof of stability"):
        identify(data, Polynomial(1), method=LeastSquares())
    unproved = identify(
        data, Polynomial(1), method=LeastSquares(), search=Search(allow_unproved=True)
    )
    with pytest.raises(Infeasible, match="has no proof"):
        _ = unproved.proof
    stable = identify(data, Polynomial(1), method=Rse(certified=True))
    assert stable.proof.rate < 1.0
    scores = validate(stable.model, data)
    assert not scores.simulation.white
    assert "NOT white" in str(scores)
    report = page(stable, {"training": data, "test": data}, robot="unstable")
    assert "simulation residual is NOT white (99 %)" in report
    assert "one-step residual is NOT white (99 %)" in report


@pytest.mark.slow
def test_the_command_line_identifies_a_state_affine_model_and_proves_it(
    config: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    nlsid("identify", out, *BAGS, "--config", config)
    verdict = check(out / documents.MODEL_PROOF)
    assert "clips its inputs" in verdict.statement
    refused = nlsid("funnel", out, "--config", config, status=None)
    assert "has no section 'funnel'" in refused


# -- Robust simulation error: the bound, its derivatives, its iterates, and what is refused

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


# -- Options of families and methods: each refusal names the option, its value and what is allowed

NEEDED: dict[type, dict[str, Any]] = {Network: {"structure": Feedback()}, Polynomial: {"lags": 2}}
# class, option -> its smallest and largest allowed values, and the nearest that are refused
LIMITS: dict[tuple[type, str], tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    (Polynomial, "lags"): ((1, 100), (0, 101, 2.5, True)),
    (Polynomial, "delays"): (((0,), (2,), None), ((-1,), (3,), ())),
    (Polynomial, "input_range"): ((((0.0, 1.0),), None), (((1.0, 1.0),), ())),
    (Polynomial, "output_range"): ((((0.0, 1.0),), None), (((1.0, 1.0),), ())),
    (Polynomial, "on_out_of_range"): (("clip", "refuse"), ("warn",)),
    (Polynomial, "set"): (("3.8", None), ("2.9",)),
    (Degrees, "left"): ((1, 9), (0, 2, 11)),
    (Degrees, "past"): ((1, 5), (0, 6)),
    (Degrees, "inputs"): ((0, 5), (-1, 6)),
    (Degrees, "leading"): ((0, 5), (-1, 6)),
    (Degrees, "lagged"): ((0, 5), (-1, 6)),
    (FilterMapFilter, "orders"): (((1, 0), (0, 100)), ((0, 0), (-1, 2), (101, 0), (1,))),
    (FilterMapFilter, "phases"): ((1, 4), (0, 5)),
    (FilterMapFilter, "intervals"): ((1, 1000), (0, 1001)),
    (FilterMapFilter, "starts"): ((1, 1000), (0, 1001)),
    (FilterMapFilter, "begin"): (("measured", "rest"), ("motion",)),
    (CellRow, "cells"): ((1, 3), (0, 4, 1.5)),
    (CellRow, "intervals"): ((1, 30), (0, 31)),
    (CellRow, "limit"): (("top", "friction", "none"), ("saturation",)),
    (Feedback, "lags"): ((1, 8), (0, 9)),
    (Feedback, "intervals"): ((1, 30), (0, 31)),
    (Feedback, "stages"): ((1, 8), (0, 9)),
    (Feedback, "imitated"): ((0, 10_000), (-1, 10_001)),
    (Network, "start_samples"): ((3, 10_000), (0, 2, 10_001)),
    (Network, "seed"): ((0,), (-1, 0.5)),
    (Rse, "iterations"): ((1, 1000), (0, 1001, 2.5)),
    (Sem, "iterations"): ((1, 1000), (0, 1001)),
}
FREE = {  # true or false, or options of their own
    (Rie, "accept_untested_repeats"),
    (Polynomial, "degrees"),
    (Network, "structure"),
    (Rse, "certified"),
    (Sem, "certified"),
}
OTHER_COMBINATIONS: tuple[tuple[Degrees, dict[str, Any], str], ...] = (
    (Degrees(left=3, past=2), {}, "needs ranges in set 2.11"),
    (Degrees(left=3, past=3), {"set": "2.13", "lags": 1}, "needs the degree left 5, or"),
    (Degrees(left=1, past=2), {"set": "2.13", "lags": 1}, "needs the degree left 3"),
    (Degrees(left=3, lagged=1), {}, "stable in ranges only"),
    (Degrees(left=5), {"set": "3.8"}, "left is 5; it should be 1 or 3"),
    (Degrees(left=3, inputs=2), {"set": "3.8"}, "affine in past outputs and inputs"),
    (Degrees(left=3), {"set": "2.13", "lags": 2}, "set 2.13 is for 1 lag"),
    (Degrees(left=3), {"set": "2.19"}, "set 2.19 is linear"),
    (Degrees(left=3), {"set": "2.11", "input_range": ((0.0, 1.0),)}, "or neither"),
    (Degrees(left=3, leading=1), {}, "no factor of y"),
)


@pytest.mark.parametrize(("kind", "key"), LIMITS, ids=lambda part: getattr(part, "__name__", part))
def test_an_option_is_taken_up_to_its_limits_and_refused_beyond(kind: type, key: str) -> None:
    least = NEEDED.get(kind, {})
    allowed, refused = LIMITS[kind, key]
    for value in allowed:
        assert getattr(kind(**least | {key: value}), key) == value
    for value in refused:
        with pytest.raises(OptionError) as caught:
            kind(**least | {key: value})
        assert str(caught.value).startswith(f"{key} is {value!r}; it should be ")
        assert isinstance(caught.value, DataError)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_every_option_of_every_class_and_method_has_its_limits_tested() -> None:
    kinds = [Polynomial, Degrees, Network, FilterMapFilter, CellRow, Feedback, *METHODS.values()]
    options = {(kind, option.name) for kind in kinds for option in fields(kind)}
    assert options == set(LIMITS) | FREE


@pytest.mark.parametrize(("degrees", "options", "reason"), OTHER_COMBINATIONS)
def test_what_no_model_can_satisfy_is_refused(
    degrees: Degrees, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        Polynomial(degrees=degrees, **options)


def test_options_cannot_be_changed_after_they_were_checked() -> None:
    with pytest.raises(FrozenInstanceError):
        Rse().iterations = 0  # type: ignore[misc]


def test_the_methods_of_a_class_begin_with_the_one_that_is_taken() -> None:
    assert methods_of(Polynomial(2))[0] == Rse()
    assert methods_of(Polynomial(2, degrees=Degrees(left=3)))[0] == Rie()
    assert methods_of(Network(CellRow())) == (Sem(certified=True),)
    for degrees, certified in (((2, 0), True), ((1, 1), True), ((3, 0), False), ((2, 1), False)):
        made = Polynomial(2, degrees=Degrees(leading=degrees[0], lagged=degrees[1]))
        assert (Rse(certified=True) in methods_of(made)) is certified
    with pytest.raises(DataError, match="is no model class; there are: Polynomial, Network"):
        methods_of(LeastSquares())


def test_one_set_of_options_says_which_equations_are_searched() -> None:
    assert Polynomial(2).form is None
    assert Polynomial(2, degrees=Degrees(left=3)).form == "3.8"
    assert Polynomial(2, degrees=Degrees(left=3, inputs=2)).form == "2.11"


# -- The slowest rate that is searched: no model that forgets more slowly than its data can tell

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
    unheard = identify(data, Polynomial(2), method=method, search=Search(max_rate=1.0 - 1e-7))
    assert radii_of(unheard).max() > 0.9975, "the limit is what kept the pole"


@pytest.mark.parametrize("rate", slow_among([0.7, 0.9], {0.7}))
@pytest.mark.parametrize(
    "method",
    [Rse(), Sem(certified=True), Rse(4, certified=True)],
    ids=["rse", "sem_certified", "certified"],
)
def test_every_search_keeps_a_rate_that_is_asked_for(rate: float, method: Rse | Sem) -> None:
    data = Dataset((drifting([0.95, 0.3]),))
    fit = identify(data, Polynomial(2), method=method, search=Search(comparators=(), max_rate=rate))
    assert fit.proof.rate <= rate
    assert fit.errors["train"][method.name] < 100.0


def test_models_with_products_of_lags_and_inputs_keep_it_too() -> None:
    data = Dataset((drifting([0.9], 200),))
    model_class = Polynomial(1, degrees=Degrees(leading=1, lagged=1))
    fit = identify(
        data,
        model_class,
        method=Rse(3, certified=True),
        search=Search(comparators=(), max_rate=0.8),
    )
    assert fit.proof.rate <= 0.8


def test_bounds_on_the_identification_error_keep_it() -> None:
    data = Dataset((drifting([0.95, 0.3]),))
    states = identify(data, Polynomial(1, (1,), set="2.19"), search=Search(max_rate=0.8))
    known = np.zeros((1, 1))
    assert abs(states.model.jacobian(known, known, known)[0, 0, 0]) <= 0.8
    implicit = Polynomial(2, set="2.11")
    for rate in (0.6, 0.999):
        found = identify(data, implicit, method=Rie(), search=Search(comparators=(), max_rate=rate))
        none = np.zeros((1, 2))
        A = found.model.jacobian(none, none, np.zeros((1, 3)))[0, :, :2]
        assert np.abs(np.linalg.eigvals(A)).max() <= rate
    monotone = identify(Dataset(pair(1500, 1)), CLASS, method=Rie(), search=Search(max_rate=0.5))
    assert monotone.proof.rate <= 0.5


def test_a_proof_that_is_too_slow_is_said_to_be_and_does_not_count() -> None:
    trial = drifting([0.97])
    exact = replace(trial, y=lfilter([0.0, 1.0], [1.0, -0.97], trial.u[:, 0]))
    data = Dataset((exact,))
    fit = identify(
        data,
        Polynomial(1),
        method=LeastSquares(),
        search=Search(comparators=(), max_rate=0.9, allow_unproved=True),
    )
    assert fit.chosen.proof is None
    assert fit.chosen.remark == (
        "proved only at 0.9715 (3.5 s) a sample, slower than the max_rate of 0.9000 (0.95 s)"
    )
    assert fit.chosen.remark in str(fit)
    with pytest.raises(Infeasible, match=r"proved only at 0\.9715"):
        identify(
            data, Polynomial(1), method=LeastSquares(), search=Search(comparators=(), max_rate=0.9)
        )
    assert identify(data, Polynomial(1), method=LeastSquares()).proof.rate < 0.972


@pytest.mark.parametrize("rate", [0.0, 1.0, float("nan")])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(OptionError, match="max_rate"):
        identify(Dataset((drifting([0.5]),)), Polynomial(1), search=Search(max_rate=rate))
