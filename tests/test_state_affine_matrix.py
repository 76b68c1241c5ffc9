"""Proofs of state-affine models of several outputs, or with lagged coefficients that move."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.errors import CertificateRejected, ShapeError
from nlsid_core.identification import prove_state_affine
from nlsid_core.identification.certified import certified_simulation_error, descend_certified
from nlsid_core.identification.matrix_proof import MatrixProof, prove_by_matrix, sampled_radius
from nlsid_core.identification.rse import robust_simulation_error
from nlsid_core.identification.state_affine import StateAffineClass
from nlsid_core.models import StateAffineModel
from nlsid_core.models.polynomials import Polynomials
from tests.test_robust_simulation_error import problem

SCHEMA = Path(__file__).resolve().parent.parent / "docs" / "schema" / "proof.schema.json"


def identified(outputs: int, leading: int, lagged: int) -> StateAffineModel:
    stacked = problem(
        trials=1, samples=300, outputs=outputs, noise=0.02,
        model_class=StateAffineClass(
            2, leading_degree=leading, lagged_degree=lagged, delays=(0, 1)
        ),
    )  # fmt: skip
    *_, last = robust_simulation_error(stacked.rows, iterations=4)
    return stacked.model(last.theta, last.p)


@pytest.fixture(scope="module")
def made() -> dict[str, tuple[StateAffineModel, MatrixProof]]:
    found = {}
    for name, sizes in {"two outputs": (2, 1, 0), "lags that move": (1, 2, 2)}.items():
        model = identified(*sizes)
        proof = prove_state_affine(model)
        assert isinstance(proof, MatrixProof)
        found[name] = (model, proof)
    return found


def write(folder: Path, model: Json, proof: Json) -> Path:
    (folder / "model.json").write_text(json.dumps(model))
    proof["claim"]["about"]["model"]["digest"] = _json.digest(model)
    path = folder / "model.proof.json"
    path.write_text(json.dumps(proof_document(proof["claim"], proof["proof"])))
    return path


KINDS = ["two outputs", "lags that move"]


@pytest.mark.parametrize("name", KINDS)
def test_the_proof_passes_and_two_solutions_approach_at_its_rate(
    name: str, tmp_path: Path, made: dict[str, tuple[StateAffineModel, MatrixProof]]
) -> None:
    model, proof = made[name]
    document = proof.document(model, "model.json")
    jsonschema.validate(document, _json.load_document(SCHEMA))
    verdict = check(write(tmp_path, model.document(), document))
    assert "every input" in verdict.statement
    assert sampled_radius(model) < proof.rate < 1.0
    rng = np.random.default_rng(0)
    low, high = model.u_range.T
    u = rng.uniform(2.0 * low, 2.0 * high, size=(40, len(low)))  # clipped to the range
    starts = rng.standard_normal((2, len(model), len(model.y))) * model.y_scale
    both = model.simulate(np.repeat(u[None], 2, axis=0), starts)
    gaps = (both[0] - both[1]) / model.y_scale
    states = np.concatenate([gaps[1:], gaps[:-1]], axis=1)
    V = np.einsum("ti,ij,tj->t", states, proof.P, states)
    keep = V[1:] > 1e-18 * V[0]
    assert keep.sum() > 20
    assert (V[1:] <= proof.rate**2 * V[:-1] * (1 + 1e-6))[keep].all()


def _steeper(model: Json, _: Json) -> None:
    model["G"][1]["coefficients"][0] = (
        4.0 * np.array(model["G"][1]["coefficients"][0]) - 1.0
    ).tolist()


def _wider_input(model: Json, _: Json) -> None:
    model["u_range"] = [[50.0 * low - 10.0, 50.0 * high + 10.0] for low, high in model["u_range"]]


def _faster(_: Json, proof: Json) -> None:
    proof["claim"]["rate"] = 0.01


def _no_decrease(_: Json, proof: Json) -> None:
    proof["claim"]["rate"] = 1.0


def _negative_storage(_: Json, proof: Json) -> None:
    proof["proof"]["P"] = (-np.array(proof["proof"]["P"])).tolist()


def _other_multiplier(_: Json, proof: Json) -> None:
    proof["proof"]["T"] = (-np.array(proof["proof"]["T"])).tolist()


def _wrong_signs(_: Json, proof: Json) -> None:
    for gram in [*proof["proof"]["multipliers"], proof["proof"]["gram"]]:
        gram["Q"] = (-np.array(gram["Q"])).tolist()


def _stranger(_: Json, proof: Json) -> None:
    proof["proof"]["lower"] = 1.0


CHANGES: list[Callable[[Json, Json], None]] = [
    _steeper, _wider_input, _faster, _no_decrease, _negative_storage, _other_multiplier,
    _wrong_signs, _stranger,
]  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("change", CHANGES)
def test_a_forgery_is_rejected(
    name: str,
    change: Callable[[Json, Json], None],
    tmp_path: Path,
    made: dict[str, tuple[StateAffineModel, MatrixProof]],
) -> None:
    model, proof = made[name]
    documents = model.document(), json.loads(json.dumps(proof.document(model, "model.json")))
    change(*documents)
    with pytest.raises(CertificateRejected):
        check(write(tmp_path, *documents))


def test_a_model_that_is_unstable_for_some_input_gets_no_proof() -> None:
    model = identified(1, 1, 1)
    G = [Polynomials(g.exponents, 3.0**k * g.coefficients) for k, g in enumerate(model.G)]
    model = replace(model, G=tuple(G))
    assert sampled_radius(model) > 1.0
    assert prove_by_matrix(model) is None


def test_the_last_step_needs_the_proof_by_bounds() -> None:
    stacked = problem(
        trials=1, samples=300, noise=0.2, model_class=StateAffineClass(2, leading_degree=2)
    )
    first = next(certified_simulation_error(stacked))
    model = stacked.model(first.point.theta, first.point.p)
    proof = prove_by_matrix(model)
    assert proof is not None
    with pytest.raises(ShapeError, match="by bounds"):
        descend_certified(stacked, model, proof)
