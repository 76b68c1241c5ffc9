"""Cells that contract, saturate and flow over: the network, its sensitivities, and two tanks."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nlsid_core import documents, proofs
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.identification import (
    CellRow,
    Degrees,
    Fit,
    Network,
    Polynomial,
    Selection,
    Sem,
    identify,
    prove_stability,
    select,
)
from nlsid_core.identification.network.cells import Cascade, Trial
from nlsid_core.identification.network.options import Limit
from nlsid_core.identification.prediction import predict, simulate_trial
from nlsid_core.models import CellNetwork, PiecewiseLinear
from tests.core.kernel.stability_claims import network
from tests.two_tanks import NOISE, tanks

SMALL = Network(CellRow())


@pytest.fixture(scope="module")
def fit() -> Fit[CellNetwork]:
    return identify(tanks(1), SMALL, validation=tanks(2, h=(6.0, 3.0)))


def rms(fit: Fit[CellNetwork], data: Dataset) -> float:
    trial, skipped = data.trajectories[0], fit.model.start_samples
    return float(np.sqrt(np.mean((simulate_trial(fit.model, trial) - trial.y)[skipped:] ** 2)))


@pytest.mark.slow
def test_two_tanks_that_flow_over_are_found_to_the_noise_and_proved(fit: Fit[CellNetwork]) -> None:
    """A new trial with other first levels, the upper one never measured: 1.5 times the noise."""
    assert fit.proof.rate < fit.max_rate < 1.0
    proofs.decide(fit.proof.document(fit.model, "m.json"), {"m.json": fit.model.document()})
    assert rms(fit, tanks(1)) < 1.15 * NOISE
    assert rms(fit, tanks(2, h=(6.0, 3.0))) < 1.5 * NOISE


@pytest.mark.slow
def test_without_tops_the_overflow_is_left_over(fit: Fit[CellNetwork]) -> None:
    straight = identify(tanks(1), Network(CellRow(limit="none")))
    assert len(straight.model.maps) == 3
    assert rms(straight, tanks(1)) > 3.0 * rms(fit, tanks(1))


@pytest.mark.slow
def test_select_takes_the_cells_where_the_data_are_of_cells() -> None:
    classes: list[Any] = [
        Polynomial(2),
        Polynomial(2, degrees=Degrees(inputs=2, leading=1)),
        SMALL,
    ]
    chosen: Selection = select(tanks(1), tanks(2, h=(6.0, 3.0)), classes, method=None)
    assert chosen.best is SMALL
    assert chosen.errors[2] < 0.3 * min(chosen.errors[:2])


def cascade(limit: str) -> tuple[Cascade, Trial]:
    rng = np.random.default_rng(3)
    K, cells = 3, 3
    top = np.array([0.6, 0.4, 0.9]) if limit == "top" else np.full(cells, np.inf)
    half = np.array([np.nan, np.nan, 1.0 if limit == "friction" else np.nan])
    made = Cascade(
        knots=np.tile(np.linspace(-1.0, 1.0, K + 1), (cells, 1)),
        level=rng.normal(0, 0.1, cells),
        phi=rng.uniform(0.2, 0.9, (cells, K)),
        g=rng.uniform(0.1, 0.6, (cells, K)),
        gamma=rng.uniform(0.2, 0.8, cells),
        top=top,
        half=half,
        rest=np.array([0.0, 0.0, 0.1]),
        b=rng.normal(0, 0.4, (cells, 2)),
        x0=rng.normal(0, 0.5, (2, cells)),
    )
    return made, Trial(rng.normal(size=(60, 2)), np.zeros(60), 0)


@pytest.mark.parametrize("limit", ["top", "friction", "none"])
def test_the_sensitivities_are_those_of_finite_differences(limit: str) -> None:
    made, trial = cascade(limit)
    theta = made.pack()
    x, z = made.simulate(trial.u, made.x0[1])
    assert limit != "top" or (z > made.top).any(axis=0).all(), "every cell flows over"
    assert limit != "friction" or 0.05 < np.mean(abs(z[:, 2]) < made.half[2]) < 0.95, (
        "it sticks and slips"
    )
    J, h = made.sensitivities(trial, x, z, 1), 1e-7
    for k in range(len(theta)):
        moved = [made.unpacked(theta + sign * h * np.eye(len(theta))[k]) for sign in (1.0, -1.0)]
        high, low = (m.simulate(trial.u, m.x0[1])[0][:, -1] for m in moved)
        assert J[:, k] == pytest.approx((high - low) / (2 * h), abs=2e-5)


@pytest.mark.slow
def test_the_network_of_a_fit_simulates_what_was_fitted(fit: Fit[CellNetwork]) -> None:
    """From the state that the first samples show, and in one step of several states at once."""
    trial, model = tanks(1).trajectories[0], fit.model
    y, states = model.states(trial.u, model.start)
    both, after = model.advance(states[:2], trial.u[0])
    assert both[0] == pytest.approx(y[0], abs=1e-12)
    assert after[0] == pytest.approx(states[1], abs=1e-12)
    assert predict(model, trial, 5) == pytest.approx(simulate_trial(model, trial)[24:], abs=1e-12)


def test_a_hidden_start_is_found_from_the_first_samples() -> None:
    model = replace(network(), start_samples=12)
    u = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 1))
    truth = np.array([0.7, -0.4])
    y, _ = model.states(u, truth)
    assert model.start_from(y[:12], u[:12]) == pytest.approx(truth, abs=1e-4)
    assert model.simulate(u, y[:12]) == pytest.approx(y, abs=1e-4)
    far = replace(model, start=np.full(2, 1e12))  # so large that differences do not move it
    assert np.isfinite(far.start_from(y[:12], u[:12])).all()


def test_a_parallel_connection_of_filters_around_nonlinearities_is_a_network_and_proved() -> None:
    """y = G₂(f(G₁u)) + G₄(g(G₃u)) with first-order filters."""
    f = PiecewiseLinear(np.array([-1.0, 0.0, 1.0]), np.array([-3.0, 0.0, 0.2]))
    g = PiecewiseLinear(np.array([-1.0, 1.0, 2.0]), np.array([-1.0, 1.0, 1.0]))
    into = np.zeros((2, 8))
    into[0, 2], into[1, 4] = 1.0, 1.0
    after = np.zeros((4, 8))
    after[0, [2, 6]] = 0.9, 1.0
    after[1, [3, 0]] = 0.8, 1.0
    after[2, [4, 6]] = -0.5, 1.0
    after[3, [5, 1]] = 0.3, 1.0
    made = replace(
        network(),
        maps=(f, g),
        into=into,
        next=after,
        start=np.zeros(4),
        output=np.array([[0, 0, 0, 1.0, 0, 1.0, 0, 0]]),
    )
    proof = prove_stability(made)
    assert proof is not None
    assert 0.9 < proof.rate < 0.95


def test_feedback_through_a_map_is_proved_only_where_the_loop_contracts() -> None:
    for slope, proved in ((0.4, True), (1.2, False)):
        f = PiecewiseLinear(np.array([-1.0, 0.0, 1.0]), np.array([0.0, 0.0, slope]))
        made = replace(
            network(),
            maps=(f,),
            into=np.array([[0, 0, 1.0, 0, 0]]),
            start=np.zeros(2),
            next=np.array([[-1.0, 0.5, 0, 1.0, 0], [0, 1.0, 0, 0, 0]]),
            output=np.array([[0, 1.0, 0, 0, 0]]),
        )
        assert (prove_stability(made) is not None) is proved


def test_a_written_network_is_read_again_and_a_damaged_one_is_refused() -> None:
    model = network()
    document = model.document()
    read = documents.read(document, source="x")
    assert isinstance(read, CellNetwork)
    assert read.document() == document
    for change, error, said in (
        ({"kind": "cells"}, DocumentError, "no 'nlsid/model' of kind 'cells'"),
        ({"maps": [{"knots": [0.0, 0.0], "values": [0.0, 1.0]}] * 3}, DataError, "ascend"),
        ({"maps": [1, 2, 3]}, DocumentError, "objects"),
        ({"into": [[1.0] * 7] * 3}, DataError, "earlier maps"),
        ({"next": [[0.0] * 6] * 2}, ShapeError, "next should have shape"),
        ({"start_samples": 0}, DataError, "start_samples"),
        ({"period": 0.0}, DataError, "period"),
    ):
        with pytest.raises(error, match=said):
            documents.read(document | change, source="x")


def test_data_that_cannot_be_used_are_refused() -> None:
    trial = tanks(1, 300).trajectories[0]
    flat = replace(trial, u=np.ones_like(trial.u))
    two = Trajectory(t=trial.t, y=np.hstack([trial.y, trial.y]), u=trial.u)
    for bad, error, said in (
        (flat, DataError, "constant"),
        (two, ShapeError, "one output"),
        (tanks(1, 60).trajectories[0], DataError, "more than three times"),
    ):
        with pytest.raises(error, match=said):
            identify(Dataset((bad,)), Network(CellRow(1)), method=Sem(certified=True))


def sliding(seed: int, samples: int = 1200) -> Dataset:
    """A mass with viscous and dry friction under stepped forces: it comes to rest, and sticks."""
    rng, v, y = np.random.default_rng(seed), 0.3, []
    u = np.repeat(rng.uniform(-3.0, 3.0, samples // 20), 20)
    for force in u:
        y.append(v)
        free = 0.95 * v + 0.05 * force
        v = free - min(max(free, -0.06), 0.05)
    measured = np.array(y) + 0.002 * rng.standard_normal(samples)
    return Dataset(
        (Trajectory(t=0.01 * np.arange(samples), y=measured, u=u, name=f"slide {seed}"),)
    )


def test_a_slide_that_comes_to_rest_in_dry_friction_is_found_and_proved() -> None:
    """It stands still for a tenth of the time or more."""
    resting = np.mean(np.abs(sliding(1).trajectories[0].y) < 0.006)
    assert resting > 0.1
    errors = {}
    limits: tuple[Limit, ...] = ("friction", "none")
    for limit in limits:
        made = identify(sliding(1), Network(CellRow(1, intervals=2, limit=limit)))
        errors[limit] = rms(made, sliding(2))
        assert made.proof.rate < 0.97
    assert errors["friction"] < 1.3 * 0.002
    assert errors["none"] > 3.0 * errors["friction"]
