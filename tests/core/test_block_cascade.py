"""Block cascades: simulation, identification, and the proof on pairs of solutions."""

import json

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification import (
    FilterMapFilter,
    Network,
    StabilityProof,
    Step,
    prove_stability,
)
from nlsid_core.identification.network.cascade import identify_block_cascade
from nlsid_core.identification.network.cascade_fit import (
    Parameters,
    Trial,
    second_inputs,
)
from nlsid_core.identification.network.cascade_starts import (
    mean_square,
    with_intervals,
    with_phases,
)
from nlsid_core.models import BlockCascade, Spline
from tests.cascades import recording, truth, two_phases

Found = tuple[BlockCascade, StabilityProof, tuple[Step, ...]]


@pytest.fixture(scope="module")
def fit() -> Found:
    return identify_block_cascade(
        Dataset((recording(2500, 0), recording(1500, 1))),
        Dataset((recording(1500, 2),)),
        Network(FilterMapFilter((2, 1), phases=(1,), intervals=(8, 16), starts=4), seed=3),
        transient=60,
    )


def test_the_spline_is_scipys_between_its_knots_and_linear_beyond() -> None:
    rng = np.random.default_rng(0)
    f = Spline(-1.0, 0.25, rng.standard_normal(11))
    assert (f.intervals, f.high) == (8, 1.0)
    knots = -1.0 + 0.25 * np.arange(-3, 12)
    reference = BSpline(knots, f.coefficients, 3)
    x = np.linspace(-1.0, 1.0, 301)
    np.testing.assert_allclose(f(x), reference(x), atol=1e-13)
    np.testing.assert_allclose(f.slope(x), reference.derivative()(x), atol=1e-12)
    for edge, side in ((-1.0, -1.0), (1.0, 1.0)):
        beyond = np.array([edge + side * 7.0])
        tangent = reference(edge) + side * 7.0 * reference.derivative()(edge)
        np.testing.assert_allclose(f(beyond), tangent, atol=1e-11)


def test_simulation_agrees_with_scipys_filters() -> None:
    model, u = two_phases(), np.random.default_rng(1).standard_normal(300)
    total: FloatArray = np.zeros(300)
    for b1, b2 in zip(model.b1, model.b2, strict=True):
        x = lfilter(b1, np.r_[1.0, -model.a1], u)
        total = total + lfilter(b2, np.r_[1.0, -model.a2], model.f(x))
    np.testing.assert_allclose(model.simulate(u), total, atol=1e-12)


def test_a_cascade_is_identified_to_the_noise_and_proved(fit: Found) -> None:
    model, stated, steps = fit
    unseen = recording(1500, 9, noise=0.0)
    error = (model.simulate(unseen.u[:, 0]) - unseen.y[:, 0])[60:]
    assert np.sqrt(np.mean(error**2)) < 0.002
    assert min(step.value for step in steps) == pytest.approx(0.002, rel=0.15)
    proof = prove_stability(model)
    assert proof is not None
    assert proof.rate == stated.rate


@pytest.mark.parametrize("from_rest", [True, False])
def test_more_phases_or_knots_start_no_worse_than_they_found_it(from_rest: bool) -> None:
    model, rng = truth(), np.random.default_rng(4)
    p = Parameters(model.a1, model.b1, model.f, model.a2, model.b2)
    u = rng.standard_normal(1500)
    u = np.convolve(u, np.ones(4) / 4)[:1500]  # little power near half the sampling frequency
    y = model.simulate(u, None if from_rest else [0.5]) + 0.05 * rng.standard_normal(1500)
    trials = (Trial(u, y, 60, from_rest),)
    before = mean_square(p, trials)
    for phases in (2, 3):
        split = with_phases(p, trials, phases)
        assert split.b1.shape == (phases, 3)
        assert split.b2.shape == (phases, 2)
        assert mean_square(split, trials) <= before * (1 + 1e-9)
    x = second_inputs(with_phases(p, trials, 2), trials[0])[:, 60:-60]
    halfway = (x[0, 1:] + x[0, :-1]) / 2
    assert np.abs(x[1, 1:] - halfway).max() < 0.1 * np.abs(x[0]).max()
    finer = with_intervals(p, trials, 40)
    assert finer.f.intervals == 40
    assert mean_square(finer, trials) == pytest.approx(before, rel=0.01)


def test_a_document_round_trips() -> None:
    document = two_phases().document()
    again = BlockCascade.from_document(json.loads(json.dumps(document)))
    assert again.document() == document


def test_the_proof_holds_on_pairs_of_solutions() -> None:
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


def test_an_unstable_cascade_has_no_proof() -> None:
    model = two_phases()
    for a2 in (1.0, 1.01, -1.2):
        unstable = BlockCascade(
            model.a1, model.b1, model.f, np.array([a2]), model.b2, 0.01, model.y, model.u
        )
        assert prove_stability(unstable) is None


def test_bad_data_and_bad_models_say_what_is_wrong() -> None:
    rng, data = np.random.default_rng(0), Dataset((recording(900, 0),))
    with pytest.raises(DataError, match="transient"):
        identify_block_cascade(data, data, Network(FilterMapFilter()), transient=400)
    t = np.arange(900.0)
    flat = Dataset((Trajectory(t=t, y=np.ones(900), u=rng.standard_normal(900)),))
    with pytest.raises(DataError, match="constant"):
        identify_block_cascade(flat, flat, Network(FilterMapFilter()))
    two = Dataset((Trajectory(t=t, y=t, u=rng.standard_normal((900, 2))),))
    with pytest.raises(ShapeError, match="one input"):
        identify_block_cascade(two, two, Network(FilterMapFilter()))
    model = truth()
    with pytest.raises(ShapeError, match="equal phases"):
        BlockCascade(model.a1, model.b1, model.f, model.a2, np.ones((2, 2)), 0.01, model.y, model.u)
    with pytest.raises(ShapeError, match=r"y_start has shape \(2,\)"):
        model.simulate(np.ones(5), np.zeros(2))
    integrating = BlockCascade(
        np.ones(1), model.b1, model.f, model.a2, model.b2, 0.01, model.y, model.u
    )
    with pytest.raises(DataError, match="pole at 1"):
        integrating.simulate(np.ones(5), np.zeros(1))
    with pytest.raises(DataError, match="spacing"):
        Spline(0.0, 0.0, np.ones(5))
