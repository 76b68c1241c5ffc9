"""State-affine models of several outputs: their proof, and what the exact checker refuses."""

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.certificate.state_affine import block_matrix
from nlsid_core.errors import CertificateRejected
from nlsid_core.identification import StateAffineClass, identify, prove_state_affine
from nlsid_core.models import Signal, StateAffineModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.trajectory import Dataset, Trajectory

SCHEMAS = Path(__file__).resolve().parent.parent / "docs" / "schema"
LEAD = np.array([[1.0, 0.3], [-0.2, 0.9]])
LAGGED = (np.array([[-1.0, 0.1], [0.2, -0.7]]), np.array([[0.3, 0.0], [0.0, 0.2]]))


def constants(values: FloatArray) -> Polynomials:
    return Polynomials(np.zeros((1, 1), dtype=np.int64), values[None])


def coupled(lead: FloatArray = LEAD, *lagged: FloatArray) -> StateAffineModel:
    return StateAffineModel(
        G=(constants(lead), *map(constants, lagged or LAGGED)),
        p=Polynomials(np.array([[1], [2]]), np.array([[-0.5, 0.2], [0.1, -0.3]])),
        window=((0, 1),),
        y_offset=np.array([0.5, -1.0]),
        y_scale=np.array([2.0, 0.1]),
        u_offset=np.zeros(1),
        u_scale=np.ones(1),
        u_range=np.array([[-2.0, 2.0]]),
        period=0.01,
        y=(Signal("angle", "rad"), Signal("rate", "rad/s")),
        u=(Signal("torque", "N m"),),
    )


@pytest.fixture(scope="module")
def documents() -> tuple[Json, Json]:
    proof = prove_state_affine(coupled())
    assert proof is not None
    return coupled().document(), proof.document(coupled(), "model.json")


def write(folder: Path, model: Json, proof: Json) -> Path:
    """Both with matching digests: only the mathematics can refuse."""
    (folder / "model.json").write_text(json.dumps(model))
    proof["claim"]["about"]["model"]["digest"] = _json.digest(model)
    path = folder / "model.proof.json"
    path.write_text(json.dumps(proof_document(proof["claim"], proof["proof"])))
    return path


def copied(document: Json) -> Json:
    return json.loads(json.dumps(document))  # type: ignore[no-any-return]


def test_the_block_matrix_is_exact_and_moves_the_difference_of_two_simulations() -> None:
    model = coupled()
    A = block_matrix(model)
    assert A is not None
    product = [[sum(Fraction(float(LEAD[i, k])) * A[k][j] for k in range(2)) for j in range(4)]
               for i in range(2)]  # fmt: skip
    for k, lagged in enumerate(LAGGED):
        for i, j in np.ndindex(2, 2):
            assert product[i][2 * k + j] == -Fraction(float(lagged[i, j]))
    u = np.random.default_rng(0).uniform(-3.0, 3.0, (30, 1))
    starts = np.random.default_rng(1).standard_normal((2, 2, 2))
    first, second = (model.simulate(u, start) for start in starts)
    gap = (first - second) / model.y_scale
    matrix = np.array(A, dtype=float)
    for t in range(2, 30):
        x = np.concatenate([gap[t - 1], gap[t - 2]])
        np.testing.assert_allclose((matrix @ x)[:2], gap[t], atol=1e-12)


def test_a_true_proof_is_proved_and_fits_the_published_schemas(
    tmp_path: Path, documents: tuple[Json, Json]
) -> None:
    verdict = check(write(tmp_path, *map(copied, documents)))
    assert "for every input" in verdict.statement
    for name, document in zip(("state_affine", "proof"), documents, strict=True):
        jsonschema.validate(document, _json.load_document(SCHEMAS / f"{name}.schema.json"))


def test_the_stated_rate_is_near_the_slowest_pole(documents: tuple[Json, Json]) -> None:
    A = np.array(block_matrix(coupled()), dtype=float)
    radius = float(np.max(np.abs(np.linalg.eigvals(A))))
    assert radius < documents[1]["claim"]["rate"] < radius + 0.1 * (1.0 - radius)


def _unstable(model: Json) -> None:
    model["G"][1]["coefficients"][0][0][0] = -1.9


def _singular(model: Json) -> None:
    model["G"][0]["coefficients"][0] = [[1.0, 0.5], [2.0, 1.0]]


def _input_dependent(model: Json) -> None:
    model["G"][2]["exponents"] = [[1]]


def _slower(model: Json) -> None:
    model["G"][1]["coefficients"][0][1][1] = -1.05


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_unstable, "does not shrink"),
        (_slower, "does not shrink"),
        (_singular, "G_0 is singular"),
        (_input_dependent, "depend on the input"),
    ],
)
def test_another_model_with_right_digests_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json], change: Callable[[Json], None], reason: str
) -> None:
    model, proof = map(copied, documents)
    change(model)
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, proof))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: {"P": (-np.array(p["P"])).tolist()}, "positive definite"),
        (lambda _: {"P": np.eye(4).tolist()}, "does not shrink"),
        (lambda _: {"P": np.eye(2).tolist()}, "should have shape"),
        (lambda p: {"P": np.triu(p["P"]).tolist()}, "positive definite"),
        (lambda p: p | {"note": 1}, "should have shape"),
        (lambda p: p | {"lower": 1.0, "upper": 1.0, "lower_box": [1.0], "upper_box": [1.0]},
         "should have shape"),
    ],
)  # fmt: skip
def test_a_forged_proof_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json], change: Callable[[Json], Json], reason: str
) -> None:
    model, proof = map(copied, documents)
    proof["proof"] = change(proof["proof"])
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, proof))


@pytest.mark.parametrize("rate", [0.1, 1.0, 1.5, -0.9])
def test_a_rate_that_is_not_proved_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json], rate: float
) -> None:
    model, proof = map(copied, documents)
    proof["claim"]["rate"] = rate
    with pytest.raises(CertificateRejected):
        check(write(tmp_path, model, proof))


def test_what_is_not_stable_or_not_constant_has_no_proof() -> None:
    assert prove_state_affine(coupled(LEAD, 1.9 * LAGGED[0], LAGGED[1])) is None
    assert prove_state_affine(coupled(np.ones((2, 2)), *LAGGED)) is None
    depending = coupled().document()
    depending["G"][2]["exponents"] = [[1]]
    assert prove_state_affine(StateAffineModel.from_document(depending)) is None


def test_two_coupled_outputs_are_identified_to_the_truth_and_proved() -> None:
    model, trials = coupled(), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = rng.uniform(-2.0, 2.0, (200 + 30 * seed, 1))
        y = model.simulate(u) + 1e-3 * model.y_scale * rng.standard_normal((len(u), 2))
        trials.append(Trajectory(t=0.01 * np.arange(len(u)), y=y, u=u, name=f"run {seed}"))
    found = identify(Dataset(tuple(trials)), StateAffineClass(2, delays=(1,), right_degree=2))
    assert found.errors["train"][found.method] < 1.0
    own, truth = found.model.document(), np.array(block_matrix(model), dtype=float)
    assert own["on_out_of_range"] == "clip"
    poles = [np.sort_complex(np.linalg.eigvals(matrix)) for matrix in
             (np.array(block_matrix(found.model), dtype=float), truth)]  # fmt: skip
    np.testing.assert_allclose(poles[0], poles[1], atol=0.02)
    assert found.proof.rate < 1.0
