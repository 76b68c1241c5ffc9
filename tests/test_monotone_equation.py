"""Monotone equations: the model, its proof, and what the exact checker refuses."""

import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.certificate.monotone_equation import dissipation
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError
from nlsid_core.identification.from_repeats import identify_from_repeats
from nlsid_core.identification.moment_rie import MomentFit
from nlsid_core.identification.monotone_comparators import (
    simulate_banded,
)
from nlsid_core.models import MonotoneEquation
from nlsid_core.models.monotone_equation import is_increasing, solve_increasing
from nlsid_core.polynomial import Gram, Polynomial, variables
from nlsid_core.trajectory import Dataset
from tests.repeated import CLASS, NOISE, pair, percent, run, total, truth


@pytest.fixture(scope="module")
def fit() -> MomentFit:
    return identify_from_repeats(Dataset(pair(4000, 1)), CLASS)


@pytest.fixture(scope="module")
def documents(fit: MomentFit) -> tuple[Json, Json]:
    return fit.model.document(), fit.proof.document(fit.model, "model.json")


@pytest.mark.parametrize("e", [(1.0, 0.0, 0.0), (3.0, 1.0, 1.0), (0.1, 0.0, 5.0), (1.0, -1.7, 1.0)])
def test_an_increasing_cubic_is_inverted_from_any_guess(e: tuple[float, float, float]) -> None:
    for v in (-1e4, -3.0, -1e-9, 0.0, 0.2, 7.0, 1e5):
        target = ((e[2] * v + e[1]) * v + e[0]) * v
        for guess in (0.0, -50.0, 1e3, v):
            found = solve_increasing(e, target, guess)
            slope = (3 * e[2] * v + 2 * e[1]) * v + e[0]
            sizes = abs(e[2] * v**3) + abs(e[1] * v**2) + abs(e[0] * v)
            assert abs(found - v) <= 1e-13 * (abs(v) + sizes / slope) + 1e-300


def test_a_function_that_is_not_increasing_is_refused() -> None:
    assert is_increasing(np.array([1.0, 1.7, 1.0]))
    assert not is_increasing(np.array([1.0, 1.75, 1.0]))
    assert not is_increasing(np.array([3.0, 3.0, 1.0])), "the slope vanishes at -1"
    for e in ([0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.0, 0.0, -1.0]):
        with pytest.raises(DataError, match="increasing"):
            replace(truth(), e=np.array(e))


def test_simulation_solves_the_equation_and_documents_round_trip() -> None:
    model = replace(truth(), y_offset=0.3, u_offset=np.array([0.1]), window=((0, 0), (0, 3)),
                    b=np.array([1.0, -0.4]))  # fmt: skip
    u = np.random.default_rng(0).standard_normal(200)
    y = model.simulate(u, np.array([0.2, -0.1, 0.4])) - 0.3
    left = ((1.0 * y + 0.6) * y + 3.0) * y
    right = 0.1 + 1.2 * y[2:-1] - 0.5 * y[1:-2] + (u[3:] - 0.1) - 0.4 * (u[:-3] - 0.1)
    np.testing.assert_allclose(left[3:], right, atol=1e-13)
    again = MonotoneEquation.from_document(json.loads(json.dumps(model.document())))
    assert again.document() == model.document()
    np.testing.assert_array_equal(again.simulate(u), model.simulate(u))


def test_the_banded_simulation_is_the_models_own() -> None:
    trial = run(np.random.default_rng(3).uniform(-2, 2, 500), NOISE, 3)
    own = truth().simulate(trial.u, trial.y[:2, 0])
    banded = simulate_banded(truth(), trial)
    assert banded is not None
    assert np.abs(banded - own).max() < 1e-11


# -- the certificate -------------------------------------------------------------------------


def test_the_claims_matrix_is_a_sum_of_squares_proof_of_the_inequality() -> None:
    """The checker's G against the polynomial of Lemma 2.10, multiplied out exactly."""
    model, rate = truth(), Fraction(3, 4)
    P = [[Fraction(2), Fraction(1, 3)], [Fraction(1, 3), Fraction(1)]]
    G = dissipation(model, P, rate)
    D0, D1, d, s = (v.exact() for v in variables("D0 D1 d s"))
    e1, e2, e3 = (Fraction(float(k)) for k in model.e)
    a = [Fraction(float(k)) for k in model.a]
    # e(v) - e(v') for d = v - v', s = v + v'.
    difference = d * (e1 + e2 * s + e3 * (3 * s**2 + d**2) * Fraction(1, 4))

    def V(p: Polynomial, q: Polynomial) -> Polynomial:
        return total([P[0][0] * p * p, 2 * P[0][1] * p * q, P[1][1] * q * q])

    left = 2 * d * (difference - a[0] * D0 - a[1] * D1) + rate**2 * V(D0, D1) - V(d, D0)
    basis = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]])
    gram = Gram(basis, np.array(G, dtype=object), ("D0", "D1", "d", "s"))
    rest = left - gram.polynomial() - e3 * Fraction(1, 2) * d**4
    assert len(rest) == 0


def test_the_truth_is_found_and_proved(fit: MomentFit, tmp_path: Path) -> None:
    assert percent(fit.model) < 2.0
    path = write(tmp_path, fit.model.document(), fit.proof.document(fit.model, "model.json"))
    verdict = check(path)
    assert "for every input" in verdict.statement
    assert verdict.margin == pytest.approx(1 - fit.proof.rate)
    assert "proved stable" in str(fit)


def write(folder: Path, model: Json, proof: Json) -> Path:
    """Write both with matching digests: only the mathematics can refuse."""
    (folder / "model.json").write_text(json.dumps(model))
    proof = json.loads(json.dumps(proof))
    proof["claim"]["about"]["model"]["digest"] = _json.digest(model)
    path = folder / "model.proof.json"
    path.write_text(json.dumps(proof_document(proof["claim"], proof["proof"])))
    return path


def _scaled_lags(model: Json) -> None:
    model["a"] = [4.0 * entry for entry in model["a"]]


def _flatter(model: Json) -> None:
    model["e"][0] *= 0.5


def _steeper_square(model: Json) -> None:
    model["e"][1] = 5.0


@pytest.mark.parametrize("change", [_scaled_lags, _flatter, _steeper_square])
def test_another_model_with_right_digests_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json], change: Callable[[Json], None]
) -> None:
    model, proof = documents
    model = json.loads(json.dumps(model))
    change(model)
    with pytest.raises(CertificateRejected):
        check(write(tmp_path, model, proof))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda P: -P, "not symmetric positive definite"),
        (lambda P: 3.0 * P, "does not shrink"),
        (lambda P: 1e-3 * P, "does not shrink"),
        (lambda P: P + np.array([[0.0, 1e-9], [0.0, 0.0]]), "not symmetric"),
        (lambda P: P[:1, :1], "should have shape"),
    ],
)
def test_a_forged_storage_function_is_rejected(
    tmp_path: Path,
    documents: tuple[Json, Json],
    change: Callable[[FloatArray], FloatArray],
    reason: str,
) -> None:
    model, proof = documents
    forged = json.loads(json.dumps(proof))
    forged["proof"]["P"] = change(np.array(proof["proof"]["P"])).tolist()
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, forged))


def test_a_faster_rate_and_another_model_are_rejected(
    tmp_path: Path, documents: tuple[Json, Json]
) -> None:
    model, proof = documents
    for rate in (0.3, 1.0, -0.9):
        faster = json.loads(json.dumps(proof))
        faster["claim"]["rate"] = rate
        with pytest.raises(CertificateRejected):
            check(write(tmp_path, model, faster))
    path = write(tmp_path, model, proof)
    (tmp_path / "model.json").write_text(json.dumps(truth().document()))
    with pytest.raises(CertificateMismatch):
        check(path)


def test_the_proof_holds_on_pairs_of_solutions(fit: MomentFit) -> None:
    rng, P = np.random.default_rng(0), fit.proof.P
    for _ in range(20):
        u = rng.uniform(-20.0, 20.0, 40)
        first, second = (fit.model.simulate(u, rng.normal(scale=5.0, size=2)) for _ in range(2))
        gap = first - second
        V = np.array([[gap[t], gap[t - 1]] @ P @ [gap[t], gap[t - 1]] for t in range(1, 40)])
        assert (V[1:] <= fit.proof.rate**2 * V[:-1] * (1 + 1e-9) + 1e-20).all()
