"""Every family of models with every method of it, and the laws that hold for all of them."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid import (
    CellRow,
    Dataset,
    Degrees,
    Feedback,
    FilterMapFilter,
    Fit,
    Network,
    Polynomial,
    Rie,
    Rse,
    Sem,
    Trajectory,
    identify,
)
from nlsid_core import documents, files
from nlsid_core.errors import CertificateRejected, DataError
from nlsid_core.identification import Method, ModelClass, Search, describe, methods_of
from nlsid_core.identification.prediction import (
    history,
    learns,
    one_step_residual,
    simulate_started,
    simulate_trial,
)
from tests.decided import decided

PERIOD, START = 0.1, 20
STEPS = 4  # of an iterated method
FAMILIES: dict[str, ModelClass] = {
    "linear": Polynomial(2),
    "two outputs": Polynomial(1, (1,)),
    "state affine": Polynomial(2, (1,), Degrees(inputs=2, leading=1)),
    "products": Polynomial(1, (1,), Degrees(leading=1, lagged=1)),
    "monotone": Polynomial(1, (1,), Degrees(left=3)),
    "implicit": Polynomial(1, (1,), Degrees(left=3, inputs=2)),
    "measured states": Polynomial(1, (1,), set="2.19"),
    "filter, map, filter": Network(FilterMapFilter((1, 1), intervals=4, starts=2)),
    "cells": Network(CellRow(1, intervals=3, limit="none")),
    "feedback": Network(Feedback(2, stages=1, imitated=8)),
}
GRID = [
    pytest.param(name, method, id=f"{name}-{method.name}")
    for name, model_class in FAMILIES.items()
    for method in methods_of(model_class)
]


@cache
def recordings(name: str) -> Dataset:
    """Three noisy trials of a damped response that softens; of two such for two outputs."""
    trials = []
    for k in range(3):
        rng = np.random.default_rng(k)
        u = np.repeat(rng.uniform(-1.0, 1.0, 60), 4)
        y = np.zeros((len(u), 2))
        for t in range(1, len(u)):
            y[t] = 0.7 * y[t - 1] + 0.3 * np.tanh(u[t - 1]) * np.array([1.0, -2.0])
        y += 0.01 * rng.standard_normal(y.shape)
        several = name in ("two outputs", "measured states")
        trials.append(
            Trajectory(
                t=PERIOD * np.arange(len(u)), y=y if several else y[:, 0], u=u, name=f"run {k}"
            )
        )
    return Dataset(tuple(trials))


@cache
def fitted(name: str, method: Method) -> Fit[Any]:
    if isinstance(method, Rse | Sem):
        method = replace(method, iterations=STEPS)
    return identify(
        recordings(name),
        FAMILIES[name],
        method=method,
        search=Search(comparators=(), transient=START, allow_unproved=True),
    )


@pytest.mark.parametrize(("name", "method"), GRID)
def test_a_written_model_is_read_again_and_simulates_the_stated_error(
    name: str, method: Method
) -> None:
    fit, data = fitted(name, method), recordings(name)
    read: Any = documents.read(fit.model.document(), source=name)
    missed = spread = 0.0
    everything = np.concatenate([trial.y[START:] for trial in data])
    unit, mean = everything.std(axis=0), everything.mean(axis=0)
    for trial in data:
        (simulated,) = simulate_started(read, [trial], START)
        np.testing.assert_array_equal(simulate_trial(read, trial), simulate_trial(fit.model, trial))
        missed += float(np.sum(((trial.y - simulated)[START:] / unit) ** 2))
        spread += float(np.sum(((trial.y[START:] - mean) / unit) ** 2))
    stated = fit.errors["train"][method.name]
    assert stated == pytest.approx(100.0 * np.sqrt(missed / spread), rel=1e-9)
    assert stated < 30.0


@pytest.mark.parametrize(("name", "method"), GRID)
def test_a_proof_holds_for_its_model_only_and_is_as_fast_as_asked_for(
    name: str, method: Method, tmp_path: Path
) -> None:
    fit = fitted(name, method)
    proof = fit.chosen.proof
    if proof is None:
        assert not getattr(method, "certified", False)
        return
    assert proof.rate <= fit.max_rate or proof.rate == 1.0
    model, path = tmp_path / "model.json", tmp_path / "model.proof.json"
    files.write_document(model, fit.model.document())
    files.write_document(path, proof.document(fit.model, "model.json"))
    assert decided(path).margin > 0.0
    files.write_document(model, fit.model.document() | {"period": 2.0 * PERIOD})
    with pytest.raises(CertificateRejected):
        decided(path)


@pytest.mark.parametrize(("name", "method"), GRID)
def test_a_proved_model_forgets_its_start(name: str, method: Method) -> None:
    fit = fitted(name, method)
    if fit.chosen.proof is None:
        return
    trial = recordings(name).trajectories[0]
    moved = trial.y.copy()
    moved[: history(fit.model)] += 0.1
    apart = simulate_trial(fit.model, replace(trial, y=moved)) - simulate_trial(fit.model, trial)
    assert np.abs(apart[-1]).max() < 1e-3


@pytest.mark.parametrize(("name", "method"), GRID)
def test_a_prediction_is_a_simulation_that_begins_later(name: str, method: Method) -> None:
    model, trial = fitted(name, method).model, recordings(name).trajectories[0]
    n = history(model)
    predicted = trial.y[n:] - one_step_residual(model, trial)
    for k in (0, 7, 50) if learns(model) else (0,):
        later = trial.rows(slice(k, k + n + 1))
        assert predicted[k] == pytest.approx(simulate_trial(model, later)[-1], abs=1e-9)


@pytest.mark.parametrize("name", FAMILIES)
def test_the_same_data_give_the_same_model(name: str) -> None:
    method = methods_of(FAMILIES[name])[0]
    again = fitted.__wrapped__(name, method)
    assert again.model.document() == fitted(name, method).model.document()


@pytest.mark.parametrize("name", FAMILIES)
def test_data_that_say_nothing_are_refused(name: str) -> None:
    first = recordings(name).trajectories[0]
    for wrong in (
        replace(first, u=np.full(first.u.shape, 0.4)),
        replace(first, y=np.ones(first.y.shape)),
        first.rows(slice(3)),
    ):
        with pytest.raises(DataError):
            identify(Dataset((wrong,)), FAMILIES[name], search=Search(comparators=()))


@pytest.mark.parametrize("name", FAMILIES)
def test_a_method_of_another_class_is_refused_and_only_what_is_asked_for_runs(name: str) -> None:
    model_class = FAMILIES[name]
    known = [method.name for method in methods_of(model_class)]
    assert len(set(known)) == len(known)
    assert [*fitted(name, methods_of(model_class)[0]).errors["train"]] == known[:1]
    for wrong in ("magic", *(method for method in (Rie(),) if method.name not in known)):
        with pytest.raises(DataError, match="is no method for this model class; it has"):
            identify(recordings(name), model_class, method=wrong)  # type: ignore[arg-type]


def test_a_class_is_described_by_what_is_not_the_default() -> None:
    assert describe(Polynomial(2, degrees=Degrees(inputs=3))) == "polynomial, lags 2, inputs 3"
    assert describe(FAMILIES["cells"]).startswith("network, cell row, cells 1, intervals 3")
