"""Implicit models: solving for the next state, Jacobians, and the exact proof of stability."""

import json
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.errors import CertificateRejected, DataError, ShapeError, SolverError
from nlsid_core.identification.implicit import prove_implicit
from nlsid_core.models import ImplicitModel
from nlsid_core.models.polynomials import Polynomials

SCHEMAS = Path(__file__).resolve().parent.parent / "docs" / "schema"


def quintic() -> ImplicitModel:
    """Example 2.3.1 with an input: x⁺ + x⁺⁵/5 = x³/3 + w."""
    return ImplicitModel(
        e=Polynomials(np.array([[1], [5]]), np.array([[1.0], [0.2]])),
        f=Polynomials(np.array([[3, 0], [0, 1]]), np.array([[1.0 / 3.0], [1.0]])),
        monotonicity=0.5,
        period=0.1,
        states=("v",),
        inputs=("force",),
    )


def coupled() -> ImplicitModel:
    """Two states: e = x + x³/10 each, f a rotation by half, cubic in the first state."""
    return ImplicitModel(
        e=Polynomials(
            np.array([[1, 0], [0, 1], [3, 0], [0, 3]]),
            np.array([[1.0, 0.0], [0.0, 1.0], [0.1, 0.0], [0.0, 0.1]]),
        ),
        f=Polynomials(
            np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 0]]),
            np.array([[0.4, -0.3], [0.3, 0.4], [1.0, 0.0], [0.0, 0.05]]),
        ),
        monotonicity=0.9,
        period=0.1,
        states=("a", "b"),
        inputs=("u",),
    )


BOX = ((-1.0, 1.0), (-1.0, 1.0), (-5.0, 5.0))


@pytest.fixture(scope="module")
def files() -> tuple[Json, Json]:
    """Model and proof of the quintic model."""
    model = quintic()
    proof = prove_implicit(model, delta=0.25)
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


@pytest.mark.parametrize("model", [quintic(), coupled()], ids=["quintic", "coupled"])
def test_newton_and_the_ellipsoid_method_find_the_same_next_state(model: ImplicitModel) -> None:
    rng = np.random.default_rng(0)
    n = len(model)
    x, w = 3.0 * rng.normal(size=(40, n)), 3.0 * rng.normal(size=(40, 1))
    after = model.step(x, w)
    z = model.f(np.concatenate([x, w], axis=1))
    np.testing.assert_allclose(model.e(after), z, rtol=1e-10, atol=1e-10)
    for row in range(5):
        found = model.ellipsoid(z[row], start=x[row])
        np.testing.assert_allclose(found, after[row], atol=1e-6)


def test_the_ellipsoid_method_says_when_the_stated_monotonicity_is_false() -> None:
    model = quintic()
    lying = ImplicitModel(model.e, model.f, 1e6, 0.1, model.states, model.inputs)
    with pytest.raises(SolverError, match="is not 1e\\+06-monotone"):
        lying.ellipsoid(np.array([5.0]), start=np.array([0.0]))


def test_the_jacobian_of_a_step_equals_central_differences() -> None:
    model, rng = coupled(), np.random.default_rng(1)
    x, w = rng.normal(size=(6, 2)), rng.normal(size=(6, 1))
    exact = model.jacobian(model.step(x, w), x, w)
    step = 1e-6
    for j in range(3):
        ahead, behind = (np.concatenate([x, w], axis=1) for _ in range(2))
        ahead[:, j] += step
        behind[:, j] -= step
        difference = model.step(ahead[:, :2], ahead[:, 2:]) - model.step(
            behind[:, :2], behind[:, 2:]
        )
        np.testing.assert_allclose(exact[:, :, j], difference / (2 * step), atol=1e-7)


def test_trajectories_together_equal_each_alone() -> None:
    model, rng = coupled(), np.random.default_rng(2)
    x, w = rng.normal(size=(4, 2)), rng.normal(size=(4, 30, 1))
    together = model.simulate(x, w)
    for row in range(4):
        alone = model.simulate(x[[row]], w[[row]])
        np.testing.assert_allclose(together[row], alone[0], atol=1e-10)


def test_a_stable_model_is_proved_and_its_solutions_meet(
    tmp_path: Path, files: tuple[Json, Json]
) -> None:
    verdict = check(write(tmp_path, *map(copied, files)))
    assert "for every input" in verdict.statement
    rng = np.random.default_rng(3)
    w = np.repeat(rng.normal(size=(1, 60, 1)), 2, axis=0)
    states = quintic().simulate(np.array([[4.0], [-4.0]]), w)
    assert abs(states[0, -1] - states[1, -1])[0] < 1e-9


def test_a_local_claim_states_its_box(tmp_path: Path) -> None:
    model = coupled()
    assert prove_implicit(model, delta=0.1) is None, "deg E < 2 deg F: no global proof"
    proof = prove_implicit(model, delta=0.1, ends=BOX)
    assert proof is not None
    path = write(tmp_path, model.document(), proof.document(model, "model.json"))
    assert "stated box" in check(path).statement
    wider = proof.document(model, "model.json")
    wider["claim"]["box"] = [[-100.0, 100.0]] * 3
    with pytest.raises(CertificateRejected):
        check(write(tmp_path, model.document(), wider))


def _steeper(model: Json, _: Json) -> None:
    model["f"]["coefficients"][0][0] *= 3.0


def _not_monotone(model: Json, _: Json) -> None:
    model["monotonicity"] = 1.01


def _greedy(_: Json, proof: Json) -> None:
    proof["claim"]["delta"] = 1.2


def _negative_delta(_: Json, proof: Json) -> None:
    proof["claim"]["delta"] = -0.1


def _negative_storage(_: Json, proof: Json) -> None:
    proof["proof"]["P"] = [[-1.0]]


def _other_gram(_: Json, proof: Json) -> None:
    proof["proof"]["stable"]["gram"]["Q"][0][0] = -1.0


def _empty_box(_: Json, proof: Json) -> None:
    proof["claim"]["box"] = [[1.0, -1.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    "change",
    [_steeper, _not_monotone, _greedy, _negative_delta, _negative_storage, _other_gram, _empty_box],
)
def test_a_forgery_with_right_digests_is_rejected(
    tmp_path: Path, files: tuple[Json, Json], change: Callable[[Json, Json], None]
) -> None:
    model, proof = map(copied, files)
    change(model, proof)
    with pytest.raises(CertificateRejected):
        check(write(tmp_path, model, proof))


def test_documents_validate_against_the_published_schemas(files: tuple[Json, Json]) -> None:
    for document, name in zip(files, ("implicit", "proof"), strict=True):
        schema = _json.load_document(SCHEMAS / f"{name}.schema.json")
        jsonschema.Draft202012Validator.check_schema(schema)
        jsonschema.validate(document, schema)
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(document | {"extra": 1}, schema)


def test_an_unstable_model_gets_no_proof() -> None:
    model = quintic()
    f = Polynomials(np.array([[1, 0], [0, 1]]), np.array([[1.2], [1.0]]))
    unstable = ImplicitModel(model.e, f, 0.5, 0.1, model.states, model.inputs)
    assert prove_implicit(unstable, delta=0.01) is None


def test_a_document_round_trips_and_wrong_sizes_are_refused() -> None:
    model = coupled()
    assert ImplicitModel.from_document(copied(model.document())).document() == model.document()
    with pytest.raises(ShapeError, match="e should have 1 polynomials"):
        ImplicitModel(model.e, model.f, 0.5, 0.1, ("a",), ("u",))
    with pytest.raises(DataError, match="should be positive"):
        ImplicitModel(model.e, model.f, 0.0, 0.1, model.states, model.inputs)
    with pytest.raises(ShapeError, match=r"x should be \(B, 2\)"):
        model.step(np.zeros(2), np.zeros((1, 1)))
