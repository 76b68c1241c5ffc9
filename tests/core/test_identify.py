"""One verb for every model class and method, in Python and on the command line."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from bags.chain.shipped import config_file
from bags.commands.cli import app
from bags.designs import documents
from bags.pictures.report import page
from nlsid import Dataset, LeastSquares, Polynomial, Rse, Sem, Trajectory, check, f1tenth, identify
from nlsid_core.errors import Infeasible
from nlsid_core.identification import Method, validate
from nlsid_core.models import DifferenceEquation, StateAffineModel
from tests.conftest import TRUE_A, synthetic_dataset

STATE_AFFINE = {
    "lags": 2,
    "model": "state_affine",
    "method": "rse",
    "certified": True,
    "iterations": 5,
    "leading_degree": 1,
    "right_degree": 1,
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


@pytest.mark.parametrize("method", [Rse(), Sem(), LeastSquares()])
def test_each_method_of_a_linear_class_can_be_chosen(train: Dataset, method: Method) -> None:
    fit = identify(train, Polynomial(2), method=method)
    assert isinstance(fit.model, DifferenceEquation)
    assert fit.chosen.method is method
    assert fit[method.name] is fit.chosen
    assert fit.proof.rate < 1.0


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
    unproved = identify(data, Polynomial(1), method=LeastSquares(), allow_unproved=True)
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
    made = CliRunner().invoke(app, ["identify", str(out), *BAGS, "--config", str(config)])
    assert made.exit_code == 0, made.output
    verdict = check(out / documents.MODEL_PROOF)
    assert "clips its inputs" in verdict.statement
    refused = CliRunner().invoke(app, ["funnel", str(out), "--config", str(config)])
    assert refused.exit_code != 0
    assert "has no section 'funnel'" in str(refused.exception)
