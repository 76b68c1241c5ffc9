"""Block cascades: simulation, identification, and what the exact checker refuses."""

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline
from scipy.signal import lfilter

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.certificate.block_cascade import is_schur, slope_range, state_matrix, states
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, ShapeError
from nlsid_core.identification.block_cascade import (
    BlockCascadeClass,
    CascadeFit,
    identify_block_cascade,
)
from nlsid_core.identification.cascade_fit import (
    Parameters,
    Trial,
    second_inputs,
)
from nlsid_core.identification.cascade_proof import prove_block_cascade
from nlsid_core.identification.cascade_search import mean_square, with_intervals, with_phases
from nlsid_core.models import BlockCascade, Spline
from nlsid_core.trajectory import Dataset, Trajectory
from tests.cascades import recording, truth, two_phases


@pytest.fixture(scope="module")
def fit() -> CascadeFit:
    return identify_block_cascade(
        Dataset((recording(2500, 0), recording(1500, 1))),
        Dataset((recording(1500, 2),)),
        BlockCascadeClass(orders=(2, 1), phases=(1,), intervals=(8, 16), starts=4),
        transient=60,
        rng=np.random.default_rng(3),
    )


@pytest.fixture(scope="module")
def documents() -> tuple[Json, Json]:
    """Model and proof of the cascade with two phases."""
    model = two_phases()
    proof = prove_block_cascade(model)
    assert proof is not None
    return model.document(), proof.document(model, "model.json")


def write(folder: Path, model: Json, proof: Json) -> Path:
    """Write both with matching digests: only the mathematics can refuse."""
    (folder / "model.json").write_text(json.dumps(model))
    proof["claim"]["about"]["model"]["digest"] = _json.digest(model)
    path = folder / "model.proof.json"
    path.write_text(json.dumps(proof_document(proof["claim"], proof["proof"])))
    return path


def copied(document: Json) -> Json:
    return json.loads(json.dumps(document))  # type: ignore[no-any-return]


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


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=4, max_size=12), st.floats(-20, 20))
def test_no_slope_of_the_spline_is_outside_the_exact_range(
    coefficients: list[float], x: float
) -> None:
    f = Spline(-1.0, 0.3, np.array(coefficients))
    low, high = map(float, slope_range(f))
    slope = float(f.slope(np.array([x]))[0])
    room = 1e-12 * (1.0 + abs(low) + abs(high))
    assert low - room <= slope <= high + room


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=1, max_size=5))
def test_the_schur_cohn_recursion_agrees_with_the_roots(roots: list[float]) -> None:
    a = -np.poly(roots)[1:]
    radius = float(np.abs(roots).max())
    if abs(radius - 1.0) > 1e-3:
        assert is_schur(a) == (radius < 1.0)


def test_a_root_on_the_unit_circle_is_not_inside() -> None:
    assert not is_schur(np.array([1.0]))
    assert not is_schur(np.array([0.0, -1.0]))
    assert is_schur(np.array([float(np.nextafter(1.0, 0.0))]))


def test_simulation_agrees_with_scipys_filters() -> None:
    model, u = two_phases(), np.random.default_rng(1).standard_normal(300)
    total: FloatArray = np.zeros(300)
    for b1, b2 in zip(model.b1, model.b2, strict=True):
        x = lfilter(b1, np.r_[1.0, -model.a1], u)
        total = total + lfilter(b2, np.r_[1.0, -model.a2], model.f(x))
    np.testing.assert_allclose(model.simulate(u), total, atol=1e-12)


def test_the_state_matrix_moves_the_difference_of_two_solutions() -> None:
    model = two_phases()
    linear = Spline(-1.0, 1.0, 0.7 * np.arange(4.0))
    model = BlockCascade(
        model.a1, model.b1, linear, model.a2, model.b2, model.period, model.y, model.u
    )
    A = np.array(state_matrix(model, (Fraction(0.7),) * 2), dtype=float)
    n1, n2 = states(model)
    impulse = model.simulate(np.eye(1, 30)[0]) - model.simulate(np.zeros(30))
    start = np.zeros(n1 + n2)
    start[0] = 1.0  # v(0) = 1
    start[n1:] = [0.7 * (b1[0] * (b2[0] * model.a2[0] + b2[1])) for b1, b2 in
                  zip(model.b1, model.b2, strict=True)] @ np.ones((2, n2))  # fmt: skip
    C = [b1[0] * model.a1 + b1[1:] for b1 in model.b1]
    for t in range(1, 20):
        output = start[n1] + sum(
            0.7 * b2[0] * float(c @ start[:n1]) for c, b2 in zip(C, model.b2, strict=True)
        )
        assert output == pytest.approx(impulse[t], abs=1e-12)
        start = A @ start


def test_a_cascade_is_identified_to_the_noise_and_proved(fit: CascadeFit, tmp_path: Path) -> None:
    unseen = recording(1500, 9, noise=0.0)
    error = (fit.model.simulate(unseen.u[:, 0]) - unseen.y[:, 0])[60:]
    assert np.sqrt(np.mean(error**2)) < 0.002
    assert fit.chosen.validation_rms == pytest.approx(0.002, rel=0.15)
    path = write(tmp_path, fit.model.document(), fit.proof.document(fit.model, "model.json"))
    verdict = check(path)
    assert "for every input" in verdict.statement
    assert verdict.margin == pytest.approx(1.0 - fit.proof.rate)
    assert "proved" in str(fit)


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


def test_the_proof_holds_on_pairs_of_solutions(documents: tuple[Json, Json]) -> None:
    model, proof = BlockCascade.from_document(documents[0]), documents[1]
    n1, n2 = states(model)
    P = np.zeros((n1 + n2, n1 + n2))
    P[:n1, :n1] = proof["proof"]["P1"]
    P[n1:, n1:] = proof["proof"]["weight"] * np.array(proof["proof"]["P2"])
    rng, rate = np.random.default_rng(6), proof["claim"]["rate"]
    for _ in range(300):
        x, other = rng.normal(scale=3.0, size=(2, 2))
        slopes = tuple(Fraction(float(s)) for s in (model.f(x) - model.f(other)) / (x - other))
        A = np.array(state_matrix(model, slopes), dtype=float)
        delta = rng.standard_normal(n1 + n2)
        assert delta @ A.T @ P @ A @ delta <= rate**2 * delta @ P @ delta * (1 + 1e-9)


def test_the_true_proof_passes_and_a_document_round_trips(
    tmp_path: Path, documents: tuple[Json, Json]
) -> None:
    check(write(tmp_path, *map(copied, documents)))
    again = BlockCascade.from_document(copied(documents[0]))
    assert again.document() == documents[0]


def _pole_outside(model: Json) -> None:
    model["a1"] = [1.9, -1.05]


def _pole_on_the_circle(model: Json) -> None:
    model["a2"] = [1.0]


def _steeper(model: Json) -> None:
    model["f"]["coefficients"][7] += 0.05


def _closer_knots(model: Json) -> None:
    model["f"]["spacing"] *= 0.999


def _stronger_first_filter(model: Json) -> None:
    model["b1"][1][0] += 50.0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_pole_outside, "pole of the first filter"),
        (_pole_on_the_circle, "pole of the second filter"),
        (_steeper, "slopes of the nonlinearity"),
        (_closer_knots, "slopes of the nonlinearity"),
        (_stronger_first_filter, "does not shrink"),
    ],
)
def test_another_model_with_right_digests_is_rejected(
    tmp_path: Path,
    documents: tuple[Json, Json],
    change: Callable[[Json], None],
    reason: str,
) -> None:
    model, proof = map(copied, documents)
    change(model)
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, proof))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: p | {"slopes": [p["slopes"][0], p["slopes"][1] * 0.999]}, "slopes"),
        (lambda p: p | {"slopes": [p["slopes"][0] + 1e-3, p["slopes"][1]]}, "slopes"),
        (lambda p: p | {"slopes": p["slopes"][::-1]}, "slopes"),
        (lambda p: p | {"slopes": [-1e6, 1e6]}, "does not shrink"),
        (lambda p: p | {"P1": (-np.array(p["P1"])).tolist()}, "positive definite"),
        (lambda p: p | {"P1": np.eye(2).tolist()}, "does not shrink"),
        (lambda p: p | {"P1": [[1.0, 0.5], [0.0, 1.0]]}, "positive definite"),
        (lambda p: p | {"P2": [[1.0, 0.0], [0.0, 1.0]]}, "should have shape"),
        (lambda p: p | {"weight": p["weight"] * 1e6}, "does not shrink"),
        (lambda p: p | {"weight": -p["weight"]}, "weight"),
        (lambda p: p | {"note": 1}, "proof is P1"),
    ],
)
def test_a_forged_proof_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json], change: Callable[[Json], Json], reason: str
) -> None:
    model, proof = map(copied, documents)
    proof["proof"] = change(proof["proof"])
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, proof))


def test_a_faster_rate_than_proved_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json]
) -> None:
    model, proof = map(copied, documents)
    for rate in (0.5, 1.0, 1.5, -0.9):
        proof["claim"]["rate"] = rate
        with pytest.raises(CertificateRejected):
            check(write(tmp_path, model, proof))


def test_the_proof_of_another_model_is_refused(
    tmp_path: Path, documents: tuple[Json, Json]
) -> None:
    path = write(tmp_path, *map(copied, documents))
    (tmp_path / "model.json").write_text(json.dumps(truth().document()))
    with pytest.raises(CertificateMismatch):
        check(path)


def test_an_unstable_cascade_has_no_proof() -> None:
    model = two_phases()
    for a2 in (1.0, 1.01, -1.2):
        unstable = BlockCascade(
            model.a1, model.b1, model.f, np.array([a2]), model.b2, 0.01, model.y, model.u
        )
        assert prove_block_cascade(unstable) is None


def test_bad_data_and_bad_models_say_what_is_wrong() -> None:
    rng, data = np.random.default_rng(0), Dataset((recording(900, 0),))
    with pytest.raises(DataError, match="transient"):
        identify_block_cascade(data, data, BlockCascadeClass(), transient=400, rng=rng)
    with pytest.raises(DataError, match="phases"):
        BlockCascadeClass(phases=(0,))
    t = np.arange(900.0)
    with pytest.raises(DataError, match="begin is 'motion'; known: measured, rest"):
        BlockCascadeClass(begin="motion")  # type: ignore[arg-type]
    flat = Dataset((Trajectory(t=t, y=np.ones(900), u=rng.standard_normal(900)),))
    with pytest.raises(DataError, match="constant"):
        identify_block_cascade(flat, flat, BlockCascadeClass(), rng=rng)
    two = Dataset((Trajectory(t=t, y=t, u=rng.standard_normal((900, 2))),))
    with pytest.raises(ShapeError, match="one input"):
        identify_block_cascade(two, two, BlockCascadeClass(), rng=rng)
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
