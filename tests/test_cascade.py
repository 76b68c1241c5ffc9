"""Block cascades: splines, exact sensitivities, recovery of a truth, and the exact certificate."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.errors import CertificateRejected, DataError, ShapeError
from nlsid_core.identification.cascade import CascadeClass, identify_cascade, prove_cascade
from nlsid_core.identification.cascade_residual import Blocks
from nlsid_core.models import BlockCascade, Signal, Spline
from nlsid_core.trajectory import Dataset, Trajectory

NOISE = 1e-3


def truth(*, phases: int = 1) -> BlockCascade:
    """Two first-order filters (and a second-order one) around a saturation."""
    knots = np.linspace(-4.0, 4.0, 19)
    step = knots[1] - knots[0]
    return BlockCascade(
        A1=np.array([-0.6]),
        B1=np.array([[0.5, 0.3], [0.4, 0.4]])[:phases],
        f=Spline(knots[1], step, np.tanh(1.2 * knots)),
        A2=np.array([-0.9, 0.4]),
        B2=np.array([[0.3, 0.2, 0.0], [0.1, 0.1, 0.05]])[:phases],
        y_scale=2.0,
        u_scale=0.5,
        period=0.01,
        y=Signal("y"),
        u=Signal("u"),
        u_range=(-2.0, 2.0),
    )


def recorded(model: BlockCascade, seed: int, samples: int = 2000) -> Dataset:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=samples)
    y = model.simulate(u) + NOISE * rng.normal(size=samples)
    t = np.linspace(0.0, model.period * (samples - 1), samples)
    return Dataset((Trajectory(t=t, y=y, u=u, name=f"run {seed}"),))


@pytest.fixture(scope="module")
def files() -> tuple[Json, Json]:
    """Model and proof of the two-phase truth."""
    model = truth(phases=2)
    proof = prove_cascade(model)
    assert proof is not None
    return model.document(), proof.document(model, "model.json")


def copied(document: Json) -> Json:
    return json.loads(json.dumps(document))  # type: ignore[no-any-return]


def write(folder: Path, model: Json, proof: Json) -> Path:
    """Write both with matching digests: only the mathematics can refuse."""
    (folder / "model.json").write_text(json.dumps(model))
    proof["claim"]["about"]["model"]["digest"] = _json.digest(model)
    path = folder / "model.proof.json"
    path.write_text(json.dumps(proof_document(proof["claim"], proof["proof"])))
    return path


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-3, 3), min_size=5, max_size=9), st.floats(-20, 20), st.floats(-20, 20))
def test_mean_slopes_of_a_spline_lie_between_its_control_slopes(
    c: list[float], a: float, b: float
) -> None:
    f = Spline(-1.0, 0.7, np.array(c))
    if abs(a - b) < 1e-3:
        return
    value = f(np.array([a, b]))
    slope = (value[1] - value[0]) / (b - a)
    assert min(f.slopes()) - 1e-9 <= slope <= max(f.slopes()) + 1e-9


def test_a_spline_reproduces_a_straight_line_and_its_derivative_everywhere() -> None:
    step = 0.5
    f = Spline(-2.0, step, 3.0 * (-2.0 + step * np.arange(-1.0, 8.0)) + 1.0)
    x = np.linspace(-9.0, 9.0, 50)
    np.testing.assert_allclose(f(x), 3.0 * x + 1.0, atol=1e-12)
    np.testing.assert_allclose(f.derivative(x), 3.0, atol=1e-12)


@pytest.mark.parametrize("phases", [1, 2])
def test_sensitivities_equal_central_differences(phases: int) -> None:
    model = truth(phases=phases)
    blocks = Blocks(model.A1, model.B1, model.f, model.A2, model.B2)
    u = np.random.default_rng(0).normal(size=60) * 3.0
    _, exact = blocks.sensitivities(u)
    theta, step = blocks.vector(), 1e-6
    for i in range(len(theta)):
        moved = theta.copy()
        moved[i] += step
        ahead = blocks.with_vector(moved).simulate(u)
        moved[i] -= 2 * step
        numeric = (ahead - blocks.with_vector(moved).simulate(u)) / (2 * step)
        np.testing.assert_allclose(exact[i], numeric, atol=1e-6)


def test_the_search_and_the_model_simulate_the_same() -> None:
    model = truth(phases=2)
    blocks = Blocks(model.A1, model.B1, model.f, model.A2, model.B2)
    u = np.random.default_rng(1).normal(size=200)
    expected = model.simulate(u) / model.y_scale
    np.testing.assert_allclose(blocks.simulate(u / model.u_scale), expected, atol=1e-12)


def test_a_known_cascade_is_recovered_to_the_noise_and_proved(tmp_path: Path) -> None:
    fit = identify_cascade(
        recorded(truth(), 0),
        recorded(truth(), 1),
        CascadeClass(1, 2, knots=(16,), phases=(1,), starts=4),
        rng=np.random.default_rng(0),
    )
    test = recorded(truth(), 2).trajectories[0]
    residual = (fit.model.simulate(test.u[:, 0]) - test.y[:, 0])[100:]
    assert np.sqrt(np.mean(residual**2)) < 2 * NOISE
    np.testing.assert_allclose(np.sort(np.roots([1, *fit.model.A1])), [0.6], atol=0.02)
    model = fit.model.document()
    verdict = check(write(tmp_path, model, fit.proof.document(fit.model, "model.json")))
    assert "slopes of the nonlinearity" in verdict.statement


def test_states_of_a_proved_cascade_approach_each_other_at_the_rate(
    files: tuple[Json, Json],
) -> None:
    """Starts differ by an input that ends: what is left of it decays at the rate."""
    model, rate = BlockCascade.from_document(files[0]), files[1]["claim"]["rate"]
    rng = np.random.default_rng(3)
    tail = rng.normal(size=120)
    gaps = []
    for _ in range(2):
        head = 5.0 * rng.normal(size=50)
        gaps.append(model.simulate(np.concatenate([head, tail]))[50:])
    gap = abs(gaps[0] - gaps[1])
    assert max(gap[:5]) > 1e-3
    assert max(gap[100:]) <= 100.0 * rate**95 * max(gap[:5])


def _unstable(model: Json) -> None:
    model["A2"][0] = -1.6


def _steeper(model: Json) -> None:
    model["spline"]["c"][5] += 1e6


@pytest.mark.parametrize("change", [_unstable, _steeper])
def test_another_cascade_with_right_digests_is_rejected(
    tmp_path: Path, files: tuple[Json, Json], change: Callable[[Json], None]
) -> None:
    model, proof = map(copied, files)
    change(model)
    with pytest.raises(CertificateRejected, match="does not shrink"):
        check(write(tmp_path, model, proof))


@pytest.mark.parametrize(
    ("P", "reason"),
    [
        (np.eye(3), "does not shrink"),
        (-np.eye(3), "not symmetric positive definite"),
        (np.triu(np.ones((3, 3))), "not symmetric positive definite"),
        (np.eye(2), "should have shape"),
    ],
)
def test_a_forged_storage_function_is_rejected(
    tmp_path: Path, files: tuple[Json, Json], P: np.ndarray, reason: str
) -> None:
    model, proof = map(copied, files)
    proof["proof"]["P"] = P.tolist()
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, proof))


def test_a_faster_rate_than_the_slowest_pole_is_rejected(
    tmp_path: Path, files: tuple[Json, Json]
) -> None:
    model, proof = map(copied, files)
    proof["claim"]["rate"] = 0.63
    with pytest.raises(CertificateRejected, match="does not shrink"):
        check(write(tmp_path, model, proof))


def test_a_cascade_document_round_trips_exactly(files: tuple[Json, Json]) -> None:
    again = BlockCascade.from_document(copied(files[0]))
    assert again.document() == files[0]


def test_wiener_and_hammerstein_cascades_are_the_ends_of_the_class() -> None:
    rng = np.random.default_rng(0)
    for orders in ((0, 1), (1, 0)):
        fit = identify_cascade(
            recorded(truth(), 0, 800),
            recorded(truth(), 1, 800),
            CascadeClass(*orders, knots=(8,), phases=(1,), starts=2),
            rng=rng,
        )
        assert (len(fit.model.A1), len(fit.model.A2)) == orders
        assert 0.0 < fit.proof.rate < 1.0


def test_short_or_several_signals_are_refused() -> None:
    rng = np.random.default_rng(0)
    short = recorded(truth(), 0, 150)
    with pytest.raises(DataError, match="more than 200 samples"):
        identify_cascade(short, short, CascadeClass(1, 1), rng=rng)
    trial = Trajectory(t=np.arange(300.0), y=rng.normal(size=(300, 2)), u=rng.normal(size=300))
    double = Dataset((trial,))
    with pytest.raises(ShapeError, match="one input and one output"):
        identify_cascade(double, double, CascadeClass(1, 1), rng=rng)
