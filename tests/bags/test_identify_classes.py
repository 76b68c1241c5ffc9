"""One verb for all classes in Python: what each offers, its history, and what it refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nlsid import (
    Dataset,
    Degrees,
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
    identify,
)
from nlsid_core import files
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification import Search, simulate_trial, simulation_percent, validate
from nlsid_core.models import BlockCascade, MonotoneEquation, StateAffineModel
from tests import repeated
from tests.conftest import synthetic_dataset
from tests.identified_bags import saturating

CASCADE = Network(FilterMapFilter((2, 1), intervals=8, starts=4))


def saturated(samples: int, seed: int, noise: float = 0.01) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2.0, 2.0, samples)
    y = saturating().simulate(u) + noise * rng.standard_normal(samples)
    return Trajectory(t=0.01 * np.arange(samples), y=y, u=u, name=f"run {seed}")


@pytest.fixture(scope="module")
def cascade() -> Fit[BlockCascade]:
    return identify(
        Dataset((saturated(500, 0), saturated(700, 1))),
        CASCADE,
        test=Dataset((saturated(600, 3),)),
        search=Search(transient=60),
    )


@pytest.fixture(scope="module")
def monotone() -> Fit[MonotoneEquation]:
    pairs = [*repeated.pair(2000, 1), *repeated.pair(1500, 2)]
    return identify(Dataset(tuple(pairs)), repeated.CLASS)


@pytest.fixture(scope="module")
def affine(train: Dataset) -> Fit[StateAffineModel]:
    declared = Polynomial(2, input_range=((-0.5, 1.5),), on_out_of_range="refuse")
    return identify(train, declared, method=Rse(iterations=3, certified=True))


def test_a_cascade_fit_is_a_fit_with_the_choices_as_its_history(cascade: Fit[BlockCascade]) -> None:
    history = cascade.history
    assert (history.steps[0].what, history.value) == ("8 intervals", "training error, rms []")
    assert (tuple(cascade.errors["train"]), cascade.chosen.transient) == (("sem_certified",), 60)
    assert cascade.errors["test"]["sem_certified"] < 2.0
    assert cascade.proof.rate < 1.0
    text = str(cascade)
    assert "block cascade: filters of orders 2 and 1" in text
    assert "train    test" in text


def test_moments_stand_beside_the_biased_rie_and_least_squares(
    monotone: Fit[MonotoneEquation],
) -> None:
    pairs = [*repeated.pair(2000, 1), *repeated.pair(1500, 2)]
    alone = Dataset(tuple(replace(trial, group="") for trial in pairs))
    biased = identify(alone, repeated.CLASS, search=Search(comparators=()))
    assert tuple(monotone.errors["train"]) == ("least_squares", "rie")
    assert repeated.percent(monotone.model) < 0.4 * repeated.percent(biased.model)
    assert monotone["least_squares"].proof is not None, "every candidate is offered to the prover"
    assert len(monotone.history.steps) == 1


def test_a_comparator_that_fails_is_left_out_and_logged(
    train: Dataset, caplog: pytest.LogCaptureFixture
) -> None:
    renamed = [replace(t, group="same") for t in train]
    fit = identify(
        Dataset(tuple(renamed)),
        Polynomial(2, set="3.8"),
        method=LeastSquares(),
        search=Search(allow_unproved=True),
    )
    assert tuple(fit.errors["train"]) == ("least_squares",)
    assert "are not repeats" in caplog.text


def test_other_signals_or_another_period_are_refused(train: Dataset) -> None:
    renamed = Dataset(tuple(replace(t, u_names=("torque",)) for t in train))
    with pytest.raises(DataError, match="torque"):
        identify(train, Polynomial(2), test=renamed)
    slow = Dataset(tuple(replace(t, t=2.0 * t.t) for t in train))
    with pytest.raises(DataError, match=r"sample time 0\.2 s"):
        identify(train, Polynomial(2), test=slow)


# -- bad input ---------------------------------------------------------------------------------


def test_too_little_data_says_how_much_there_is_and_what_for() -> None:
    short = Dataset((saturated(70, 0),))
    for model_class, reason in (
        (Polynomial(30), "40 equations for 62 parameters"),
        (
            Polynomial(6, degrees=Degrees(inputs=3)),
            "64 equations for 126 parameters; give at least 126",
        ),
        (Polynomial(80), "70 samples, 80 lags need more"),
        (Network(FilterMapFilter((20, 20))), "fewer than 99 scored samples"),
        (
            Polynomial(80, degrees=Degrees(left=3), set="3.8"),
            "70 samples, a history of 80 needs more",
        ),
    ):
        with pytest.raises(DataError, match=reason):
            identify(short, model_class)


def test_a_basis_that_repeats_itself_says_its_rank() -> None:
    rng = np.random.default_rng(0)
    u = np.sign(rng.standard_normal(500))  # u² is constant
    data = Dataset((Trajectory(t=np.arange(500.0), y=rng.standard_normal(500), u=u),))
    with pytest.raises(DataError, match="polynomial basis of 10 has rank 7"):
        identify(data, Polynomial(2, degrees=Degrees(inputs=2)))


def test_what_is_no_repeat_is_refused_and_said_to_be_untested_if_asked() -> None:
    first, second = repeated.pair(1500, 1)
    late = replace(second, y=np.roll(second.y, 1))
    data = Dataset((first, late))
    with pytest.raises(DataError, match=r"are not repeats: .*correlates with the excitation"):
        identify(data, repeated.CLASS)
    accepted = identify(data, repeated.CLASS, method=Rie(accept_untested_repeats=True))
    assert accepted.proof.rate < 1.0
    alone = Dataset((replace(first, group=""), replace(second, group="")))
    with pytest.raises(DataError, match="share a `group`"):
        identify(alone, repeated.CLASS, method=Rie(accept_untested_repeats=True))


# -- inputs beyond the range that was proved ---------------------------------------------------


def test_an_input_beyond_its_range_is_clipped_or_refused_as_declared(
    affine: Fit[StateAffineModel],
) -> None:
    refusing = affine.model
    clipping = replace(refusing, on_out_of_range="clip")
    trial = synthetic_dataset(0.0, trials=1).trajectories[0]
    u = np.array(trial.u)
    u[20:23] = 1.7
    wild, at_the_edge = replace(trial, u=u), replace(trial, u=np.minimum(u, 1.5))
    reason = r"input command is 1.7 at sample 20, outside \[-0.5, 1.5\] .* \(3 here\)"
    for use in (
        lambda: simulate_trial(refusing, wild),
        lambda: validate(refusing, Dataset((wild,))),
    ):
        with pytest.raises(DataError, match=reason):
            use()
    np.testing.assert_array_equal(
        simulate_trial(clipping, wild), simulate_trial(clipping, at_the_edge)
    )
    np.testing.assert_array_equal(
        simulate_trial(refusing, at_the_edge), simulate_trial(clipping, at_the_edge)
    )


@pytest.mark.parametrize(
    ("declared", "stated"),
    [("clip", "the model clips its inputs"), ("refuse", "it refuses others")],
)
def test_the_certificate_states_what_is_declared(
    affine: Fit[StateAffineModel], tmp_path: Path, declared: str, stated: str
) -> None:
    document = affine.model.document() | {"on_out_of_range": declared}
    model = StateAffineModel.from_document(document)
    files.write_document(tmp_path / "model.json", model.document())
    files.write_document(tmp_path / "p.json", affine.proof.document(model, "model.json"))
    assert stated in check(tmp_path / "p.json").statement


def test_a_range_that_refuses_its_own_training_data_is_refused(train: Dataset) -> None:
    narrow = Polynomial(2, input_range=((0.2, 0.5),), on_out_of_range="refuse")
    with pytest.raises(DataError, match=r"which the model refuses; declare a wider range"):
        identify(train, narrow)
    clipped = identify(
        train, replace(narrow, on_out_of_range="clip"), search=Search(comparators=())
    )
    assert clipped.model.u_range.tolist() == [[0.2, 0.5]]
    with pytest.raises(DataError, match="on_out_of_range is 'warn'"):
        StateAffineModel.from_document(clipped.model.document() | {"on_out_of_range": "warn"})


# -- predictions of every model ----------------------------------------------------------------


def test_output_noise_leaves_the_simulation_residual_white(monotone: Fit[MonotoneEquation]) -> None:
    test = Dataset((repeated.run(np.random.default_rng(7).uniform(-2, 2, 3000), 0.05, 7),))
    scores = validate(monotone.model, test)
    assert scores.simulation.white
    assert not scores.one_step.white


# -- documents ---------------------------------------------------------------------------------


# -- the last step -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model_class",
    [
        Polynomial(2),
        pytest.param(Polynomial(2, degrees=Degrees(leading=1)), marks=pytest.mark.slow),
    ],
)
def test_the_last_step_keeps_the_proof_and_never_raises_the_error(
    train: Dataset, model_class: Polynomial
) -> None:
    before = Rse(4, certified=not model_class.is_linear)
    fit = identify(
        train, model_class, method=Sem(4, certified=True), search=Search(comparators=[before])
    )
    errors = {c.method.name: simulation_percent(c.model, train) for c in fit.candidates}
    assert fit.proof.rate < 1.0
    assert errors["sem_certified"] <= errors[before.name] * (1 + 1e-9)


@pytest.mark.slow
def test_several_outputs_are_certified_to_degree_1_and_beyond_are_told_what_to_use() -> None:
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((300, 1)), rng.standard_normal((300, 2))
    data = Dataset((Trajectory(t=0.01 * np.arange(300), y=y, u=u),))
    assert identify(data, Polynomial(1), method=Rse(certified=True)).proof.rate < 1.0
    quadratic = Polynomial(1, (0,), Degrees(leading=2))
    with pytest.raises(ShapeError, match=r"degree 1 at most.*minimise the robust simulation error"):
        identify(data, quadratic, method=Rse(certified=True), search=Search(comparators=()))
    beside = identify(
        data,
        quadratic,
        method=Rse(2),
        search=Search(comparators=[Rse(2, certified=True)], allow_unproved=True),
    )
    assert tuple(beside.errors["train"]) == ("rse",)


@pytest.mark.slow
def test_products_of_lags_and_five_inputs_are_certified() -> None:
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((400, 5)), np.zeros(400)
    for t in range(1, 400):
        y[t] = (0.6 + 0.05 * u[t - 1, 0]) * y[t - 1] + u[t - 1] @ [1.0, -0.5, 0.3, 0.2, 0.1]
    measured = y + 0.05 * np.std(y) * rng.standard_normal(400)
    data = Dataset((Trajectory(t=0.1 * np.arange(400), y=measured, u=u),))
    model_class = Polynomial(1, degrees=Degrees(lagged=1))
    fit = identify(data, model_class, method=Rse(3, certified=True), search=Search(comparators=()))
    assert fit.proof.rate < 1.0
    assert fit.errors["train"]["rse_certified"] < 7.0
