"""Networks of filters and maps: derivatives, what is found in them, and their proofs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.signal import lfilter

from nlsid import (
    CellRow,
    Dataset,
    Feedback,
    FilterMapFilter,
    Fit,
    Follower,
    LeastSquares,
    Network,
    OutputTube,
    Polynomial,
    Sem,
    Trajectory,
    design,
    identify,
)
from nlsid_core import documents, proofs
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import CertificateRejected, DataError, DocumentError, ShapeError
from nlsid_core.identification import Search, prove_stability, simulate_trial
from nlsid_core.identification.network.cells import Row
from nlsid_core.identification.network.feedback import Layout
from nlsid_core.identification.network.filters import Cascade
from nlsid_core.identification.network.fit import Minimum, Scaled
from nlsid_core.identification.network.follower import UNIT, Loop
from nlsid_core.identification.network.lowering import network_of
from nlsid_core.identification.network.maps import Smooth
from nlsid_core.identification.network.options import Limit
from nlsid_core.identification.network.signals import Signals, Trial
from nlsid_core.models import BlockCascade, CellNetwork, PiecewiseLinear, Spline
from tests import duffing
from tests.cascades import in_motion, recording, truth, two_phases, wiener
from tests.core.kernel.stability_claims import network
from tests.two_tanks import NOISE, tanks

AMPLITUDES = [0.1, 0.2, 0.25, 0.15]
OSCILLATOR = Network(Feedback(stages=2, imitated=20))
CASCADE = Network(FilterMapFilter((2, 1), intervals=16, starts=4), seed=3)
STRUCTURES = ("follower", "top", "friction", "none", "loop", "stages", "measured", "rest")

Example = tuple[Signals, FloatArray, Trial]


def trial(signals: Signals, *, held: bool = False) -> Trial:
    """60 samples of random inputs, with random first samples of every signal."""
    rng = np.random.default_rng(5)
    u = rng.normal(size=(60, signals.inputs))
    return Trial(u, np.zeros(60), rng.normal(0.0, 0.5, signals.given), 0, held)


def example(name: str) -> Example:
    """Signals of a structure that use all that it has, with their parameters."""
    rng = np.random.default_rng(1)
    if name in ("loop", "stages"):
        layout = Layout.of(
            Feedback(2), [Trial(np.zeros((9, 2)), np.linspace(-1, 1, 9), np.zeros(0), 0)]
        )
        a, b, e, phi = (
            np.array([1.2, -0.5]),
            0.1 * rng.normal(size=7),
            np.array([-0.2, 0.1]),
            rng.normal(size=7),
        )
        if name == "loop":
            signals, theta = layout.loop(), np.concatenate([a, b, e, phi])
        else:
            stage = [a, b, [0.2], e, phi]
            signals, theta = layout.stages(2), np.concatenate([a, b, *stage, *stage])
        return signals, theta, trial(signals)
    if name in ("measured", "rest"):
        held, model = name == "measured", two_phases()
        f = Smooth(model.f.low, model.f.spacing, model.f.intervals)
        parts = (model.a1, model.b1, model.a2, model.b2, model.f.coefficients)
        theta = np.concatenate([part.ravel() for part in parts])
        signals = Cascade((2, 1), 2, held, f, theta).signals
        return signals, theta, trial(signals, held=held)
    if name == "follower":
        signals = Loop(0.5, 3, UNIT).signals
        theta = np.concatenate([[0.8, 0.1, -0.1], rng.uniform(0.05, 0.2, signals.parameters - 3)])
        return signals, theta, trial(signals, held=True)
    row = Row(np.tile(np.linspace(-1.0, 1.0, 4), (3, 1)), 2, name)
    theta = np.zeros(1 + max(int(at.max(initial=0)) for at in row.places[-1].values()))
    for cell, top in zip(row.places, (0.6, 0.4, 0.9), strict=True):
        theta[cell["level"]] = rng.normal(-0.7 if name == "top" else 0.0, 0.1)
        theta[cell["b"]] = rng.normal(0.0, 0.4, 2)
        theta[cell["phi"]] = rng.uniform(0.2, 0.9, 3)
        theta[cell["limit"]] = top if name == "top" else (1.0, 0.1)[: len(cell["limit"])]
        for key in ("g", "gamma"):
            if key in cell:
                theta[cell[key]] = rng.uniform(0.1, 0.6, len(cell[key]))
    return row.built[0], theta, trial(row.built[0])


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_sensitivities_are_those_of_finite_differences(name: str) -> None:
    signals, theta, one = example(name)
    G, h = signals.given if signals.free else 0, 1e-7
    values = np.concatenate([one.start[:G], theta])

    def simulated(values: FloatArray) -> FloatArray:
        begun = replace(one, start=values[:G]) if G else one
        return signals.run(values[G:], begun)[signals.output]

    J = signals.sensitivities(theta, one)[1][signals.output]
    assert simulated(values).std() > 0.1
    for k, row in enumerate(J):
        step = h * np.eye(len(values))[k]
        slope = (simulated(values + step) - simulated(values - step)) / (2 * h)
        assert row == pytest.approx(slope, abs=2e-5 * (1.0 + np.abs(slope).max()))


@pytest.mark.parametrize("name", STRUCTURES[:6])
def test_the_network_simulates_what_was_fitted(name: str) -> None:
    """From the state that it begins with, recorded signals having other units."""
    signals, theta, one = example(name)
    y = signals.run(theta, one)[signals.output]
    ones = np.ones(signals.inputs)
    scaled = Scaled((3.0, 2.0), (ones, 0.5 * ones), (one,))
    u, recorded = 1.0 + 0.5 * one.u, (3.0 + 2.0 * y)[:, None]
    train = Dataset((Trajectory(t=np.arange(60.0), y=recorded, u=u),))
    model = network_of(signals, Minimum(1e-3, theta, (one,)), scaled, train, 20)
    first = 2 if name in ("follower", "loop", "stages") else 0
    x = model.start_from(recorded[first:50], u[first:50])
    later = model.states(u[first:], x)[0][20:]  # where what sticks has moved
    assert later == pytest.approx(recorded[first + 20 :], abs=0.02)


@pytest.mark.parametrize("begin", ["measured", "rest"])
@pytest.mark.parametrize("model", [truth(), two_phases(), replace(wiener(), b2=wiener().b2[:, :1])])
def test_a_cascade_simulates_what_was_fitted(model: BlockCascade, begin: str) -> None:
    u, y = np.random.default_rng(1).standard_normal((2, 300))
    held, start = begin == "measured", y[: len(model.a2)] if begin == "measured" else y[:0]
    f = Smooth(model.f.low, model.f.spacing, model.f.intervals)
    parts = (model.a1, model.b1, model.a2, model.b2, model.f.coefficients)
    theta = np.concatenate([part.ravel() for part in parts])
    signals = Cascade((2, len(model.a2)), len(model.b1), held, f, theta).signals
    fast = signals.run(theta, Trial(u[:, None], y, start, 0, held))[signals.output]
    np.testing.assert_allclose(model.simulate(u, start if held else None), fast, atol=1e-12)
    total: FloatArray = np.zeros(300)
    for b1, b2 in zip(model.b1, model.b2, strict=True):
        x = lfilter(b1, np.r_[1.0, -model.a1], u)
        total = total + lfilter(b2, np.r_[1.0, -model.a2], model.f(x))
    np.testing.assert_allclose(model.simulate(u), total, atol=1e-12)


@pytest.mark.parametrize("model", [truth(), two_phases(), wiener()])
def test_a_simulation_in_motion_goes_on_where_a_held_input_has_led(model: BlockCascade) -> None:
    u, before = 2.0 * np.random.default_rng(2).standard_normal(100), 3000
    outputs = model.simulate(np.concatenate([np.full(before, u[0]), u]))[before:]
    n = len(model.a2)
    np.testing.assert_allclose(model.simulate(u, outputs[:n]), outputs, atol=1e-12)


def test_the_spline_is_scipys_between_its_knots_and_linear_beyond() -> None:
    f = Spline(-1.0, 0.25, np.random.default_rng(0).standard_normal(11))
    reference = BSpline(-1.0 + 0.25 * np.arange(-3, 12), f.coefficients, 3)
    x = np.linspace(-1.0, 1.0, 301)
    np.testing.assert_allclose(f(x), reference(x), atol=1e-13)
    np.testing.assert_allclose(f.slope(x), reference.derivative()(x), atol=1e-12)
    for edge, side in ((-1.0, -1.0), (1.0, 1.0)):
        tangent = reference(edge) + side * 7.0 * reference.derivative()(edge)
        assert f(np.array([edge + side * 7.0])) == pytest.approx(tangent, abs=1e-11)


def rms(model: Any, data: Dataset, skipped: int = 60) -> float:
    errors = [(simulate_trial(model, one) - one.y)[skipped:] for one in data]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


@pytest.mark.slow
def test_a_cascade_is_found_to_the_noise_and_proved() -> None:
    found = identify(
        Dataset((recording(2500, 0), recording(1500, 1))), CASCADE, search=Search(transient=60)
    )
    assert rms(found.model, Dataset((recording(1500, 9, noise=0.0),))) < 0.002
    assert found.history.steps[-1].value == pytest.approx(0.002, rel=0.15)


@pytest.mark.slow
def test_trials_that_begin_in_motion_are_found_to_the_noise() -> None:
    train = Dataset(tuple(in_motion(150, seed) for seed in range(8)))
    errors = {}
    for begin in ("measured", "rest"):
        made = replace(CASCADE.structure, intervals=8, begin=begin)
        found = identify(train, replace(CASCADE, structure=made))
        errors[begin] = min(step.value for step in found.history.steps)
    assert errors["measured"] < 0.004
    assert errors["rest"] > 5 * errors["measured"]


@pytest.mark.slow
def test_two_tanks_that_flow_over_are_found_to_the_noise_and_proved() -> None:
    """A new trial with other first levels, the upper one never measured: 1.5 times the noise."""
    other = tanks(2, h=(6.0, 3.0))
    found = identify(tanks(1), Network(CellRow()))
    assert found.proof.rate < found.max_rate < 1.0
    assert rms(found.model, tanks(1), 20) < 1.15 * NOISE
    assert rms(found.model, other, 20) < 1.5 * NOISE


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
    assert np.mean(np.abs(sliding(1).trajectories[0].y) < 0.006) > 0.1
    errors = {}
    limits: tuple[Limit, ...] = ("friction", "none")
    for limit in limits:
        made = identify(sliding(1), Network(CellRow(1, intervals=2, limit=limit)))
        errors[limit] = rms(made.model, sliding(2), 20)
        assert made.proof.rate < 0.97
    assert errors["friction"] < 1.3 * 0.002
    assert errors["none"] > 3.0 * errors["friction"]


def servo(seed: int, samples: int = 1500) -> Dataset:
    """What goes after a command that is 4 samples old, by at most 0.02 a sample."""
    rng, v, x, y = np.random.default_rng(seed), 0.0, 0.0, []
    u = np.repeat(rng.uniform(-1.0, 1.0, samples // 30), 30)
    for k in range(samples):
        y.append(x)
        v = 0.6 * v + 0.4 * np.clip(0.15 * (u[max(k - 3, 0)] - x), -0.02, 0.02)
        x += v
    measured = np.array(y) + 0.003 * rng.standard_normal(samples)
    return Dataset(
        (Trajectory(t=0.02 * np.arange(samples), y=measured, u=u, name=f"servo {seed}"),)
    )


@pytest.mark.slow
def test_a_servo_with_a_limit_of_speed_is_found_and_proved() -> None:
    """Where a linear model has 30 % of the spread; stiffer than proved it would not be stable."""
    made = identify(servo(1), Network(Follower(), start_samples=10))
    spread = float(servo(2).trajectories[0].y.std())
    assert rms(made.model, servo(2), 20) < 0.04 * spread
    assert made.proof.rate < made.max_rate < 1.0
    linear = identify(servo(1), Polynomial(4), method=LeastSquares(), search=Search(comparators=()))
    assert rms(linear.model, servo(2), 20) > 0.25 * spread


@pytest.fixture(scope="module")
def oscillator() -> Fit[CellNetwork]:
    return identify(duffing.trials(AMPLITUDES), OSCILLATOR)


@pytest.mark.slow
def test_a_duffing_oscillator_is_found_and_proved(oscillator: Fit[CellNetwork]) -> None:
    """Unrolled and proved, 5 % where linear models have 20 %."""
    fresh, louder = duffing.trials([0.12, 0.22], seed=1), duffing.trials([0.28], seed=2)
    assert oscillator.chosen.error_percent(fresh) < 5.0
    assert oscillator.chosen.error_percent(louder) < 12.0
    straight = identify(
        duffing.trials(AMPLITUDES), Polynomial(3), method=Sem(), search=Search(comparators=())
    )
    assert straight.chosen.error_percent(fresh) > 20.0
    first, second = (step.value for step in oscillator.history.steps)
    assert second < 0.7 * first
    document = oscillator.proof.document(oscillator.model, "m.json")
    document["claim"]["rate"] = 0.5
    with pytest.raises(CertificateRejected):
        proofs.decide(document, {"m.json": oscillator.model.document()})


@pytest.mark.slow
def test_a_well_damped_loop_is_proved_as_it_is() -> None:
    """x'' + 2x' + x + x³ = u contracts over all of its range: nothing is unrolled."""
    made = replace(OSCILLATOR, structure=replace(OSCILLATOR.structure, lags=2))
    found = identify(
        duffing.trials([0.2, 0.4, 0.6], damping=2.0), made, search=Search(comparators=())
    )
    assert len(found.model.maps) == 1
    fresh = duffing.trials([0.5], damping=2.0, seed=1)
    assert found.chosen.error_percent(fresh) < 200 * duffing.NOISE


@pytest.mark.slow
def test_a_tube_of_many_maps_is_proved() -> None:
    """Three maps, eight corners: one matrix stands for them in the search; the kernel decides."""
    train = duffing.trials(AMPLITUDES)
    made = replace(OSCILLATOR, structure=replace(OSCILLATOR.structure, stages=3))
    found = identify(train, made, search=Search(comparators=()))
    assert len(found.model.maps) == 3
    tube = design(OutputTube(found.model, train, duffing.trials(AMPLITUDES, seed=3)))
    assert "for ever" in str(tube.verdict)


def test_a_hidden_start_is_found_from_the_first_samples() -> None:
    model = replace(network(), start_samples=12)
    u = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 1))
    truth = np.array([0.7, -0.4])
    y, states = model.states(u, truth)
    assert model.start_from(y[:12], u[:12]) == pytest.approx(truth, abs=1e-4)
    assert model.simulate(u, y[:12]) == pytest.approx(y, abs=1e-4)
    both, after = model.advance(states[:2], u[0])  # several states at once
    assert both[0] == pytest.approx(y[0], abs=1e-12)
    assert after[0] == pytest.approx(states[1], abs=1e-12)
    far = replace(model, start=np.full(2, 1e12))  # so large that differences do not move it
    assert np.isfinite(far.start_from(y[:12], u[:12])).all()
    m = len(model.maps)
    by_maps = replace(model, output=np.where(np.arange(model.output.shape[1]) < m, model.output, 0))
    still = np.full((12, 1), 0.3)
    assert np.isfinite(by_maps.start_from(still, u[:12])).all(), "nothing varies, no state is seen"


def test_the_proof_of_a_cascade_holds_on_pairs_of_solutions() -> None:
    """V of the filters' states, [v(t-1) v(t-2); observer form of the second], of two solutions."""
    model, rng = two_phases(), np.random.default_rng(6)
    proof = prove_stability(model)
    assert proof is not None
    radius = max(float(np.abs(poles).max()) for poles in model.poles)
    assert radius < proof.rate < radius + 0.1 * (1.0 - radius)
    for _ in range(300):
        past, other = rng.normal(scale=3.0, size=(2, 2))
        second, u = rng.normal(), rng.normal(scale=3.0)
        v, w = (u + model.a1 @ x for x in (past, other))
        after = model.a2[0] * second
        for b1, b2 in zip(model.b1, model.b2, strict=True):
            inner = np.array([b1[0] * z + b1[1:] @ x for z, x in ((v, past), (w, other))])
            f = model.f(inner)
            after += (b2[0] * model.a2[0] + b2[1]) * (f[0] - f[1])
        before = np.concatenate([past - other, [second]])
        later = np.array([v - w, past[0] - other[0], after])
        assert later @ proof.P @ later <= proof.rate**2 * (before @ proof.P @ before) * (1 + 1e-9)


@pytest.mark.parametrize("a2", [1.0, 1.01, -1.2])
def test_an_unstable_cascade_has_no_proof(a2: float) -> None:
    assert prove_stability(replace(two_phases(), a2=np.array([a2]))) is None


@pytest.mark.parametrize(("slope", "proved"), [(0.4, True), (1.2, False)])
def test_feedback_through_a_map_is_proved_only_where_the_loop_contracts(
    slope: float, proved: bool
) -> None:
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


@pytest.mark.parametrize("gain", [1.0, 400.0, -1e5])
def test_a_row_is_proved_near_the_rate_of_its_slowest_cell_whatever_it_passes_on(
    gain: float,
) -> None:
    f = PiecewiseLinear(np.array([-1.0, 0.0, 1.0]), np.array([-0.9, 0.0, 0.5]))
    made = replace(
        network(),
        maps=(f, f),
        into=np.array([[0, 0, 1.0, 0, 0, 0], [0, 0, 0, 1.0, 0, 0]]),
        start=np.zeros(2),
        next=np.array([[1.0, 0, 0, 0, 1.0, 0], [gain, 1.0, 0, 0, 0, 0]]),
        output=np.array([[0, 0, 0, 1.0, 0, 0]]),
    )
    proof = prove_stability(made)
    assert proof is not None
    assert 0.9 < proof.rate < 0.92


def test_a_damaged_network_or_cascade_is_refused() -> None:
    document = network().document()
    for change, error in (
        ({"kind": "cells"}, DocumentError),
        ({"maps": [{"knots": [0.0, 0.0], "values": [0.0, 1.0]}] * 3}, DataError),
        ({"maps": [1, 2, 3]}, DocumentError),
        ({"into": [[1.0] * 7] * 3}, DataError),
        ({"next": [[0.0] * 6] * 2}, ShapeError),
        ({"start_samples": 0}, DataError),
        ({"period": 0.0}, DataError),
    ):
        with pytest.raises(error):
            documents.read(document | change, source="x")
    model = truth()
    for numbers in ({"b2": np.ones((2, 2))}, {"period": 0.0}):
        with pytest.raises((DataError, ShapeError)):
            replace(model, **numbers)
    with pytest.raises(ShapeError):
        model.simulate(np.ones(5), np.zeros(2))
    with pytest.raises(DataError, match="pole at 1"):
        replace(model, a1=np.ones(1)).simulate(np.ones(5), np.zeros(1))


@pytest.mark.parametrize("structure", [CellRow(1), Feedback(2), FilterMapFilter(), Follower()])
def test_networks_have_one_output(structure: Any) -> None:
    t, u = np.arange(300.0), np.random.default_rng(0).normal(size=300)
    two = Dataset((Trajectory(t=t, y=np.column_stack([u, u**2]), u=u),))
    with pytest.raises(ShapeError, match="one"):
        identify(two, Network(structure), search=Search(comparators=()))
