"""What people see and call in a notebook: short texts, pandas, python-control, standard errors."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid import Dataset, Fit, Polynomial, compare, identify, replay, standard_errors, to_control
from nlsid_core.design import OutputTubeDesign
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models import DifferenceEquation

LONGEST = 2000  # characters of what a cell's last line prints


def test_what_a_cell_ends_with_is_short(
    train: Dataset, fit: Fit[DifferenceEquation], design: OutputTubeDesign
) -> None:
    held = replay(design, train.trajectories[0])
    tables = compare(train, {"fitted": fit.model}), standard_errors(fit.model, train)
    shown = (train, train.trajectories[0], fit, fit.model, design, design.verdict, held, *tables)
    assert not [each for each in shown if not 20 < len(repr(each)) <= LONGEST]
    assert not [each for each in (train, fit, held) if "<svg" not in each._repr_html_()]
    assert "PROVED tube" in design._repr_html_() == design.verdict._repr_html_()


def test_data_frames_are_trials(train: Dataset) -> None:
    pandas = pytest.importorskip("pandas")
    tables = {
        trial.name: pandas.DataFrame(
            {"speed": trial.y[:, 0], "command": trial.u[:, 0]},
            pandas.Timestamp("2026-01-01") + pandas.to_timedelta(trial.t, "s"),
        )
        for trial in train
    }
    made = Dataset.from_pandas(tables, y="speed", u=["command"], paths={"speed": "/odom:speed"})
    assert (made.trajectories[0].y_paths, made.trajectories[0].u_paths) == (("/odom:speed",), ("",))
    assert made.names == train.names
    for one, other in zip(made, train, strict=True):
        np.testing.assert_array_equal(np.hstack([one.y, one.u]), np.hstack([other.y, other.u]))
    with pytest.raises(DataError, match=r"DataFrame.*from_pandas"):
        identify(tables["run_0"], Polynomial(2))
    with pytest.raises(DataError, match=r"run_0: no column effort; there are \['speed'"):
        Dataset.from_pandas(tables, y=["speed"], u=["effort"])
    with pytest.raises(DataError, match=r"data: the index only counts the rows.*set_index"):
        Dataset.from_pandas(tables["run_0"].reset_index(drop=True), y="speed", u="command")


def test_a_trials_own_columns_are_simulated(train: Dataset, fit: Fit[DifferenceEquation]) -> None:
    trial = train.trajectories[0]
    np.testing.assert_array_equal(
        fit.model.simulate(trial.u, trial.y[:2]),
        fit.model.simulate(trial.u[:, 0], trial.y[:2, 0]),
    )
    with pytest.raises(ShapeError, match=r"\(80,\), \(3,\)"):
        fit.model.simulate(trial.u, trial.y[:3])


def test_models_are_compared_on_the_same_trials(
    train: Dataset, fit: Fit[DifferenceEquation]
) -> None:
    found = compare(train, {"fitted": fit.model, "off": replace(fit.model, c=0.5)})
    assert found["fitted"] == fit.errors["train"][fit.method.name] < found["off"]
    assert fit.model.equation in str(fit)


@pytest.mark.pictures  # python-control imports matplotlib
def test_python_control_steps_like_the_model(fit: Fit[DifferenceEquation]) -> None:
    control = pytest.importorskip("control")
    model = replace(fit.model, c=0.0)
    assert to_control(model).output_labels == [model.y.name]
    stepped = control.step_response(to_control(model), T=np.arange(50) * model.period)
    inputs = np.concatenate([np.zeros(2), np.ones(50)])
    simulated = model.simulate(inputs, np.zeros(2))[2:]
    np.testing.assert_allclose(np.squeeze(stepped.outputs), simulated, atol=1e-9)


def test_standard_errors_are_those_of_the_differences(
    train: Dataset, fit: Fit[DifferenceEquation]
) -> None:
    """By how much the simulations change with each coefficient, by finite differences."""
    model, step = fit.model, 1e-6
    given = np.concatenate([model.a, model.b, [model.c]])

    def simulated(moved: np.ndarray) -> np.ndarray:
        other = replace(model, a=moved[:2], b=moved[2:5], c=float(moved[5]))
        return np.concatenate([other.simulate(t.u, t.y[:2])[2:] for t in train])

    rows = [simulated(given + d) - simulated(given - d) for d in step * np.eye(6)]
    J = np.array(rows).T / (2.0 * step)
    errors = np.concatenate([t.y[2:, 0] for t in train]) - simulated(given)
    covariance = np.linalg.inv(J.T @ J) * (errors @ errors) / (len(errors) - 6)
    expected = np.sqrt(np.diag(covariance))
    found = standard_errors(model, train)
    assert list(found.rows) == ["a1", "a2", "b0", "b1", "b2", "c"]
    assert [row[0] for row in found.rows.values()] == given.tolist()
    np.testing.assert_allclose([found[name] for name in found.rows], expected, rtol=1e-3)
    still = Dataset(tuple(replace(trial, u=0.0 * trial.u) for trial in train))
    with pytest.raises(DataError, match="do not determine"):
        standard_errors(model, still)
