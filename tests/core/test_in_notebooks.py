"""What people see and call in a notebook: short texts, pandas, python-control, standard errors."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nlsid import (
    Dataset,
    Degrees,
    Design,
    Fit,
    Polynomial,
    compare,
    identify,
    replay,
    standard_errors,
    to_control,
)
from nlsid_core.design import OutputTubeDesign
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.polynomial.explicit import (
    equation_error,
    minimise_simulation_error,
)
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.prediction import as_state_affine
from nlsid_core.models import DifferenceEquation, StateAffineModel
from tests.continuous_stage import stage
from tests.state_affine_rows import problem
from tests.tracked import designed

LONGEST = 2000  # characters of what a cell's last line prints
NOISE, FITS = 0.03, 80  # standard deviation, and how many fits: their spread is known to 8 %
STEP = 1e-6  # of a coefficient, for finite differences


def test_what_a_cell_ends_with_is_short_and_has_a_picture(
    train: Dataset, fit: Fit[DifferenceEquation], design: OutputTubeDesign
) -> None:
    trial, held = train.trajectories[0], replay(design, train.trajectories[0])
    designs: list[Any] = [design, designed(), Design(*stage(), decision=design.decision)]
    pictured: tuple[Any, ...] = (train, fit, held, *designs, *(each.verdict for each in designs))
    shown = (*pictured, trial, fit.model, compare(train, {"fitted": fit.model}))
    assert not [each for each in shown if not 20 < len(repr(each)) <= LONGEST]
    assert not [each for each in pictured if "<svg" not in each._repr_html_()]
    assert "PROVED tube" in design._repr_html_()


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
    _, stepped = control.step_response(to_control(model), T=np.arange(50) * model.period)
    simulated = model.simulate(np.append(np.zeros(2), np.ones(50)), np.zeros(2))[2:]
    np.testing.assert_allclose(stepped, simulated, atol=1e-9)


def changed(model: StateAffineModel, by: float) -> Iterator[StateAffineModel]:
    """The model with each coefficient changed in turn; the first of G_0 is held."""
    parts, n_y = (*model.G, model.p), len(model.y)
    numbers = np.concatenate([part.coefficients.ravel() for part in parts])
    ends = np.cumsum([part.coefficients.size for part in parts])[:-1]
    for moved in (numbers + by * np.eye(len(numbers)))[n_y**2 :]:
        *G, p = (
            replace(part, coefficients=each.reshape(part.coefficients.shape))
            for part, each in zip(parts, np.split(moved, ends), strict=True)
        )
        yield replace(model, G=tuple(G), p=p)


@pytest.mark.parametrize(
    ("outputs", "degree", "names"),
    [
        (1, 0, ["a1", "a2", "b0", "b1", "b2", "c"]),
        (1, 1, ["G0 u(t)", "G0 u(t-1)", "G0 u(t-2)", "G1", "G1 u(t)"]),
        (2, 1, ["G0[1,1] u(t)", "G0[1,2] u(t)", "G0[2,1] u(t)", "G0[2,2] u(t)"]),
    ],
)
def test_standard_errors_are_those_of_the_differences(
    outputs: int, degree: int, names: list[str]
) -> None:
    """By how much the simulations change with each coefficient, by finite differences."""
    classes = Polynomial(2, degrees=Degrees(leading=degree, lagged=degree))
    rows = problem(outputs=outputs, samples=60, model_class=classes)
    model, data = equation_error(rows), rows.dataset
    equation = as_state_affine(model) if isinstance(model, DifferenceEquation) else model

    def errors(other: StateAffineModel) -> np.ndarray:
        missed = [(t.y - other.simulate(t.u, t.y[:2]))[2:] for t in data]
        return np.asarray(np.concatenate(missed) / equation.y_scale)

    sides = zip(changed(equation, STEP), changed(equation, -STEP), strict=True)
    J = np.stack([errors(more) - errors(less) for more, less in sides], axis=2) / (2.0 * STEP)
    e, unknowns = errors(equation), J.shape[2]
    noise = e.T @ e / (len(e) - unknowns / outputs)
    inverse = np.linalg.inv(sum(at.T @ at for at in J))
    covariance = inverse @ sum(at.T @ noise @ at for at in J) @ inverse
    found = standard_errors(model, data)
    assert list(found.rows)[: len(names)] == names
    values, stated = np.array(list(found.rows.values())).T
    np.testing.assert_allclose(stated, np.sqrt(np.diag(covariance)), rtol=1e-3)
    numbers = np.concatenate([part.coefficients.ravel() for part in (*equation.G, equation.p)])
    np.testing.assert_array_equal(values, numbers[outputs**2 :] * (1 if degree else -1))
    assert len(repr(found)) <= LONGEST
    still = Dataset(tuple(replace(trial, u=0.0 * trial.u) for trial in data))
    with pytest.raises(DataError, match="do not determine"):
        standard_errors(model, still)


def test_standard_errors_are_the_spread_of_fits_to_new_noise() -> None:
    """A state-affine model is fitted to the same runs, each time with other white noise."""
    rng, model_class = np.random.default_rng(5), Polynomial(1, degrees=Degrees(lagged=1))
    known = problem(samples=150, model_class=model_class)
    truth = equation_error(known)
    start = np.concatenate([part.coefficients.ravel() for part in truth.G])
    quiet = [replace(t, y=truth.simulate(t.u, t.y[:1])) for t in known.dataset]
    deviation = np.append(0.0, np.full(149, NOISE))[:, None]  # of the samples: starts are exact
    fitted, stated = [], []
    for _ in range(FITS):
        trials = [replace(t, y=t.y + deviation * rng.standard_normal(t.y.shape)) for t in quiet]
        rows = build_state_affine_rows(Dataset(tuple(trials)), model_class)
        model = minimise_simulation_error(rows, start)
        found, leading = standard_errors(model, rows.dataset), model.G[0].coefficients.item()
        free = [name for name in found.rows if name[0] == "G"]  # p goes by the outputs' spread
        fitted.append([found.rows[name][0] / leading for name in free])
        stated.append([found[name] / abs(leading) for name in free])
    assert len(free) == 3
    np.testing.assert_allclose(np.mean(stated, axis=0), np.std(fitted, axis=0), rtol=0.2)
