"""Feedback through a static map: its sensitivities, its unrolling, and a Duffing oscillator."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid_core import proofs
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import OutputTube, design
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification import (
    Feedback,
    Fit,
    Network,
    Polynomial,
    Sem,
    identify,
    prove_stability,
)
from nlsid_core.identification.network.feedback import Scaled, identify_loop, network_of
from nlsid_core.identification.network.feedback_fit import (
    Basis,
    Stage,
    Trial,
    loop_sensitivities,
    simulate_loop,
    simulate_stages,
    stage_sensitivities,
)
from nlsid_core.models import CellNetwork
from tests.duffing import NOISE, trials

AMPLITUDES = [0.1, 0.2, 0.25, 0.15]
SMALL = Network(Feedback(stages=2, imitated=20))


def with_structure(**options: int) -> Network[Feedback]:
    """The same with other options."""
    return replace(SMALL, structure=replace(SMALL.structure, **options))


@pytest.fixture(scope="module")
def fit() -> Fit[CellNetwork]:
    return identify(trials(AMPLITUDES), SMALL, comparators=(Sem(),))


@pytest.mark.slow
def test_a_duffing_oscillator_is_found_and_proved(fit: Fit[CellNetwork]) -> None:
    """The loop to its noise, unproved; unrolled and proved, 5 % where linear models have 20 %."""
    fresh, louder = trials([0.12, 0.22], seed=1), trials([0.28], seed=2)
    loop, proved = (
        next(c for c in fit.candidates if c.method.name == name)
        for name in ("sem", "sem_certified")
    )
    assert loop.proof is None
    assert loop.error_percent(fresh) < 150 * NOISE
    assert proved.proof is not None
    assert proved.error_percent(fresh) < 5.0
    assert proved.error_percent(louder) < 12.0
    straight = identify(trials(AMPLITUDES), Polynomial(3), method=Sem(), comparators=())
    assert straight.chosen.error_percent(fresh) > 20.0
    proofs.decide(fit.proof.document(fit.model, "m.json"), {"m.json": fit.model.document()})
    assert CellNetwork.from_document(fit.model.document()).document() == fit.model.document()


@pytest.mark.slow
def test_the_history_says_what_every_map_gained(fit: Fit[CellNetwork]) -> None:
    first, second, _ = fit.history.steps
    assert (first.what, second.what) == ("1 map", "2 maps")
    assert second.value < 0.7 * first.value
    assert fit.history.value.startswith("held-back error")


@pytest.mark.slow
def test_a_slower_proof_than_the_kernel_can_decide_is_refused(fit: Fit[CellNetwork]) -> None:
    document = fit.proof.document(fit.model, "m.json")
    document["claim"]["rate"] = 0.5
    with pytest.raises(Exception, match="not positive"):
        proofs.decide(document, {"m.json": fit.model.document()})


def test_a_well_damped_loop_is_proved_as_it_is() -> None:
    """x'' + 2x' + x + x³ = u contracts over all of its range: nothing is unrolled."""
    found = identify(trials([0.2, 0.4, 0.6], damping=2.0), with_structure(lags=2), comparators=())
    assert len(found.model.maps) == 1
    assert len(found.model.start) == 2
    assert found.chosen.error_percent(trials([0.5], damping=2.0, seed=1)) < 200 * NOISE


def example() -> tuple[Basis, list[Stage], Trial]:
    rng, basis = np.random.default_rng(1), Basis(-2.0, 2.0, 4)
    made = [
        Stage(
            np.array([1.2, -0.5]),
            0.1 * rng.normal(size=(3, 2)),
            0.05,
            np.array([0.0 if k == 0 else 0.1, -0.2, 0.1]),
            rng.normal(size=7),
        )
        for k in range(3)
    ]
    trial = Trial(rng.normal(size=(60, 2)), np.zeros(60), rng.normal(size=2), 0)
    return basis, made, trial


def differences(stage: Stage, simulated: object) -> np.ndarray:
    rows, h = [], 1e-6
    for k in range(len(stage.vector())):
        step = h * np.eye(len(stage.vector()))[k]
        rows.append((simulated(stage.moved(step)) - simulated(stage.moved(-step))) / (2 * h))  # type: ignore[operator]
    return np.array(rows)


def test_the_sensitivities_are_those_of_finite_differences() -> None:
    basis, (loop, *others), trial = example()
    y = simulate_loop(loop, basis, trial.u, trial.start)
    assert 0.2 < y.std() < 2.0
    shared, own = loop_sensitivities(loop, basis, trial, y)
    e0 = len(loop.a) + loop.b.size + 1  # is no parameter of a loop
    truth = differences(loop, lambda one: simulate_loop(one, basis, trial.u, trial.start))
    keep = np.arange(len(truth)) != e0
    assert shared[keep] == pytest.approx(truth[keep], abs=1e-5)
    for i, row in enumerate(own):
        step = 1e-6 * np.eye(2)[i]
        high, low = (simulate_loop(loop, basis, trial.u, trial.start + s) for s in (step, -step))
        assert row == pytest.approx((high - low) / 2e-6, abs=1e-5)
    none = np.zeros(0)
    stages = [replace(loop, e=none, phi=none), *others]
    ys, ws = simulate_stages(stages, basis, trial)
    J, at = stage_sensitivities(stages, basis, trial, ys, ws), 0
    for k, stage in enumerate(stages):

        def last(one: Stage, k: int = k) -> np.ndarray:
            changed = [*stages[:k], one, *stages[k + 1 :]]
            return simulate_stages(changed, basis, trial)[0][-1]

        truth = differences(stage, last)
        assert J[at : at + len(truth)] == pytest.approx(truth, abs=1e-5)
        at += len(truth)


def test_the_network_simulates_what_was_fitted() -> None:
    """Of a loop and of stages, from the state that their past says."""
    data = trials([0.2, 0.3], samples=200)
    scaled = Scaled.of(data, SMALL, 0)
    error, loop, basis, known = identify_loop(scaled, SMALL)
    none, n = np.zeros(0), 3
    slow = replace(loop, a=0.9 ** np.arange(1, 4) * loop.a)
    for stages, closed in ([loop], True), ([replace(slow, e=none, phi=none), slow], False):
        model = network_of(stages, basis, scaled, known, data, SMALL, error, closed=closed)
        if closed:
            y = simulate_loop(loop, basis, known[0].u, known[0].start)
        else:
            y = simulate_stages(stages, basis, known[0])[0][-1]
        recorded = (scaled.y[0] + scaled.y[1] * y)[:, None]
        u = data.trajectories[0].u
        start = model.start_from(recorded[n:150], u[n:150])
        assert model.states(u[n:], start)[0] == pytest.approx(recorded[n:], abs=0.02 * y.std())


@pytest.mark.slow
def test_several_layers_are_proved_by_their_weights(fit: Fit[CellNetwork]) -> None:
    """P couples no stage with another, so that no program has to be solved."""
    n, proof = SMALL.structure.lags, prove_stability(fit.model)
    assert proof is not None
    for i in range(len(fit.model.start) // n):
        rows = proof.P[i * n : (i + 1) * n]
        assert not rows[:, : i * n].any()
        assert not rows[:, (i + 1) * n :].any()


@pytest.mark.slow
def test_a_tube_of_many_maps_is_proved() -> None:
    """Five maps, 32 corners: one matrix stands for them in the search, the kernel decides all."""
    train = trials(AMPLITUDES)
    found = identify(train, with_structure(stages=5), comparators=())
    assert len(found.model.maps) >= 3
    tube = design(OutputTube(found.model, train, trials(AMPLITUDES, seed=3)))
    assert "for ever" in str(tube.verdict)


def test_data_that_cannot_be_used_are_refused() -> None:
    t, u = np.arange(100.0), np.random.default_rng(0).normal(size=100)
    two = Dataset((Trajectory(t=t, y=np.column_stack([u, u]), u=u),))
    with pytest.raises(ShapeError, match="one output"):
        identify(two, SMALL)
    with pytest.raises(DataError, match="three times as many"):
        identify(Dataset((Trajectory(t=t[:50], y=u[:50], u=u[:50]),)), SMALL)
    with pytest.raises(DataError, match="constant"):
        identify(Dataset((Trajectory(t=t, y=u, u=0 * u),)), SMALL)
