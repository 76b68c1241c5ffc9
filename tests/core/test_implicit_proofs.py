"""Implicit models in the convex sets of thesis Chapter 2: exact proofs, and their forgeries."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from examples import not_a_contraction
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.errors import (
    CertificateMismatch,
    CertificateRejected,
    DataError,
    Infeasible,
    ShapeError,
    SolverError,
)
from nlsid_core.identification.proofs import conditions
from nlsid_core.identification.proofs.conditions import Inequality, constraint
from nlsid_core.identification.proofs.stable_sets import prove_implicit
from nlsid_core.models import ImplicitModel
from nlsid_core.polynomial import variables
from nlsid_core.proofs import check, proof_document
from nlsid_core.sos import Program, SumOfSquares, forms_of, solve
from tests.decided import decided
from tests.implicit_models import coupled, cubic_spring, lagged, linear, quintic

DELTA = 0.1
Change = Callable[[Json, Json], None]


STABLE = np.array([[0.5, 0.4], [-0.4, 0.6]])
SMALL = ((-1.0, 1.0), (-1.0, 1.0), (-5.0, 5.0))
# model, set, box
GENUINE: dict[str, tuple[ImplicitModel, str, tuple[tuple[float, float], ...]]] = {
    "linear, 2.19": (linear(STABLE), "2.19", ()),
    "derivatives, 2.11": (lagged(), "2.11", ()),
    "derivatives, 2.11, box": (lagged(), "2.11", SMALL),
    "not separable, 2.11": (cubic_spring(), "2.11", ((-1.0, 1.0), (-1.0, 1.0))),
    "separable derivatives, 2.13": (quintic(), "2.13", ()),
    "separable derivatives, 2.13, box": (coupled(), "2.13", SMALL),
}


@pytest.fixture(scope="module")
def made() -> dict[str, tuple[Json, Json]]:
    """Every genuine model and proof, made once."""
    found = {}
    for name, (model, kind, ends) in GENUINE.items():
        proof = prove_implicit(model, delta=DELTA, set=kind, ends=ends)
        assert proof is not None
        found[name] = model.document(), proof.document(model, "model.json")
    return found


def copied(document: Json) -> Json:
    return json.loads(json.dumps(document))  # type: ignore[no-any-return]


def write(folder: Path, model: Json, proof: Json, *, rebound: bool = True) -> Path:
    """Write both; rebound: with matching digests, so that only the mathematics can refuse."""
    files.write_document(folder / "model.json", model)
    if rebound:
        proof["claim"]["about"]["model"]["digest"] = files.digest(model)
    path = folder / "model.proof.json"
    files.write_document(path, proof_document(proof["claim"], proof["proof"]))
    return path


NAMES = list(GENUINE)


@pytest.mark.parametrize("name", NAMES)
def test_a_genuine_proof_of_each_set_passes(
    name: str, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    model, proof = map(copied, made[name])
    verdict = check(write(tmp_path, model, proof))
    assert f"(set {GENUINE[name][1]}: " in verdict.statement
    assert float(verdict.margin) == DELTA
    assert ("both solutions stay in this box" in str(verdict)) == bool(GENUINE[name][2])


@pytest.mark.parametrize("name", NAMES)
def test_two_solutions_of_a_proved_model_meet(name: str) -> None:
    model, _, ends = GENUINE[name]
    rng = np.random.default_rng(3)
    n = len(model)
    size = 0.3 if ends else 3.0
    w = np.repeat(0.3 * rng.uniform(-1.0, 1.0, size=(1, 200, 1)), 2, axis=0)
    states = model.simulate(size * rng.uniform(-1.0, 1.0, size=(2, n)), w)
    gap = states[0] - states[1]
    assert np.linalg.norm(gap[0]) > 0.1 * size
    assert np.linalg.norm(gap[-1]) < 1e-6


def _larger_right_side(model: Json, _: Json) -> None:
    rows = model["h"]
    for exponents, values in zip(rows["exponents"], rows["coefficients"], strict=True):
        if not any(exponents[: len(values)]) and any(exponents[len(values) :]):
            values[:] = [8.0 * value for value in values]


def _not_so_monotone(model: Json, _: Json) -> None:
    model["monotonicity"] *= 100.0


def _greedy(_: Json, proof: Json) -> None:
    proof["claim"]["delta"] = 1e3


def _negative_delta(_: Json, proof: Json) -> None:
    proof["claim"]["delta"] = -0.1


def _too_large_squares(_: Json, proof: Json) -> None:
    proof["proof"]["inequalities"]["stable"]["squares"]["unit"] -= 1


def _other_set(_: Json, proof: Json) -> None:
    others = {"2.11": "2.13", "2.13": "2.19", "2.19": "2.13"}
    proof["claim"]["set"] = others[proof["claim"]["set"]]


def _unknown_set(_: Json, proof: Json) -> None:
    proof["claim"]["set"] = "2.16"


def _missing_inequality(_: Json, proof: Json) -> None:
    identities = proof["proof"]["inequalities"]
    del identities["monotone"]


def _stranger(_: Json, proof: Json) -> None:
    proof["proof"]["note"] = "trust me"


CHANGES: list[Change] = [
    _larger_right_side,
    _not_so_monotone,
    _greedy,
    _negative_delta,
    _too_large_squares,
    _other_set,
    _unknown_set,
    _missing_inequality,
    _stranger,
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", CHANGES)
def test_a_forgery_of_any_set_is_rejected(
    name: str, change: Change, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    model, proof = map(copied, made[name])
    change(model, proof)
    with pytest.raises(CertificateRejected):
        decided(write(tmp_path, model, proof))


@pytest.mark.parametrize("name", NAMES)
def test_a_proof_of_another_model_is_a_mismatch(
    name: str, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    model, proof = map(copied, made[name])
    model["h"]["coefficients"][0][0] = float(np.nextafter(model["h"]["coefficients"][0][0], 9.0))
    with pytest.raises(CertificateMismatch):
        decided(write(tmp_path, model, proof, rebound=False))


@pytest.mark.parametrize("name", [name for name in NAMES if GENUINE[name][2]])
@pytest.mark.parametrize("size", [100.0, "shrunk"])
def test_a_local_proof_is_about_its_own_box(
    name: str, size: float | str, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    """Wider is false; empty or shrunk to nothing is no box; none at all is another claim."""
    model, proof = map(copied, made[name])
    if size == "shrunk":
        proof["claim"]["box"] = [[0.5, 0.5] for _ in proof["claim"]["box"]]
    else:
        proof["claim"]["box"] = [[-100.0, 100.0] for _ in proof["claim"]["box"]]
    with pytest.raises(CertificateRejected):
        decided(write(tmp_path, model, proof))
    del proof["claim"]["box"]
    with pytest.raises(CertificateRejected):
        decided(write(tmp_path, model, proof))


@pytest.mark.parametrize("name", [name for name in NAMES if GENUINE[name][2]])
def test_a_multiplier_of_the_wrong_size_or_place_is_rejected(
    name: str, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    for change in (_shrunk, _misplaced, _stranger_to_the_domain):
        model, proof = map(copied, made[name])
        change(proof["proof"]["inequalities"]["stable"]["multipliers"])
        with pytest.raises(CertificateRejected):
            decided(write(tmp_path, model, proof))


def _shrunk(multipliers: list[Json]) -> None:
    for multiplier in multipliers:
        multiplier["squares"]["unit"] -= 5


def _misplaced(multipliers: list[Json]) -> None:
    multipliers.reverse()
    multipliers.append(multipliers[0])


def _stranger_to_the_domain(multipliers: list[Json]) -> None:
    multipliers[-1]["of"] = 99


@pytest.mark.parametrize("name", NAMES)
def test_a_storage_that_is_not_positive_is_rejected(
    name: str, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    model, proof = map(copied, made[name])
    key = next((key for key in ("P", "M") if key in proof["proof"]), None)
    if key is None:  # 2.19: the storage is the model's own E
        model["h"]["coefficients"] = [[-v for v in row] for row in model["h"]["coefficients"]]
        model["monotonicity"] = 1e-9
    elif key == "P":
        proof["proof"]["P"] = [[-entry for entry in row] for row in proof["proof"]["P"]]
    else:
        for entry in [entry for row in proof["proof"]["M"] for entry in row]:
            entry["coefficients"] = [-c for c in entry["coefficients"]]
    with pytest.raises(CertificateRejected):
        decided(write(tmp_path, model, proof))


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 10_000), st.floats(0.05, 0.97))
def test_every_stable_matrix_has_a_proof_in_2_19_and_no_unstable_one(
    seed: int, radius: float
) -> None:
    A = np.random.default_rng(seed).standard_normal((2, 2))
    A = A / max(abs(np.linalg.eigvals(A)))
    assert prove_implicit(linear(radius * A), delta=1e-3, set="2.19") is not None
    assert prove_implicit(linear((2.0 - radius) * A), delta=1e-3, set="2.19") is None


def test_an_unstable_model_gets_no_proof() -> None:
    assert prove_implicit(lagged(1.0, 0.3), delta=0.01, set="2.11") is None


@pytest.mark.parametrize("kind", ["2.13", "2.19"])
def test_sets_of_separable_models_take_no_others(kind: str) -> None:
    assert prove_implicit(cubic_spring(), delta=0.01, set=kind) is None


def test_cubic_models_have_no_global_proof_with_a_constant_p() -> None:
    """deg E < 2 deg F."""
    assert prove_implicit(coupled(), delta=DELTA) is None


def test_sets_that_do_not_exist_are_refused() -> None:
    with pytest.raises(DataError, match=r"known: 2\.11"):
        prove_implicit(quintic(), delta=DELTA, set="2.9")
    with pytest.raises(DataError, match="delta"):
        prove_implicit(quintic(), delta=-1.0)


def _huge_degree(_: Json, proof: Json) -> None:
    proof["proof"]["M"][0][0]["exponents"][-1][-1] = 10**6


def _huge_model(model: Json, _: Json) -> None:
    model["h"]["exponents"] += [[15, 15, 15, 15 - k] for k in range(8)]
    model["h"]["coefficients"] += [[1.0]] * 8


@pytest.mark.parametrize("change", [_huge_degree, _huge_model])
def test_a_document_that_would_take_forever_is_refused(
    change: Change, tmp_path: Path, made: dict[str, tuple[Json, Json]]
) -> None:
    model, proof = map(copied, made["derivatives, 2.11"])
    change(model, proof)
    with pytest.raises(CertificateRejected):
        decided(write(tmp_path, model, proof))


# -- The convex sets of stable models: what they contain, what they exclude, exact proofs

FORMS = 4


def feasible(*parts: SumOfSquares | Inequality, names: tuple[str, ...]) -> bool:
    """Whether a solver finds the decisions; the sizes here leave no doubt either way."""
    constraints = tuple(
        constraint(part, name="a set") if isinstance(part, Inequality) else part for part in parts
    )
    try:
        solve(Program((*names, *forms_of(FORMS)), constraints))
    except (Infeasible, SolverError):
        return False
    return True


def test_example_2_3_1_gives_the_published_slope_and_an_exact_proof(tmp_path: Path) -> None:
    computed, published = not_a_contraction.example()
    assert computed == pytest.approx(published, abs=5e-4)
    model, proof = not_a_contraction.model, not_a_contraction.proof()
    path = tmp_path / "example.proof.json"
    files.write_document(tmp_path / "model.json", model.document())
    files.write_document(path, proof.document(model, "model.json"))
    assert "for every state and input" in check(path).statement
    steeper = model.document()
    steeper["h"]["coefficients"][-1] = [-0.6]
    files.write_document(tmp_path / "model.json", steeper)
    document = proof.document(model, "model.json")
    document["claim"]["about"]["model"]["digest"] = files.digest(steeper)
    files.write_document(path, proof_document(document["claim"], document["proof"]))
    with pytest.raises(CertificateRejected):
        check(path)


def test_a_cubic_map_needs_a_domain_and_gets_one() -> None:
    """f = 0.5 x + x³/4 with linear e is not contracting globally, but for |x| ≤ 0.7 it is."""
    (x,) = variables("x")
    e, f = np.array([1.0 * x]), np.array([0.5 * x + 0.25 * x**3])
    P, parts = np.eye(1), (conditions.slopes(e, ["x"]), conditions.slopes(f, ["x"]))
    domain = conditions.box(["x"], [(-0.7, 0.7)])
    assert not feasible(conditions.derivatives(*parts, P, delta=0.01), names=("x",))
    inside = conditions.derivatives(*parts, P, delta=0.01, domain=domain)
    assert feasible(inside, names=("x",))
    wide = conditions.box(["x"], [(-2.0, 2.0)])
    outside = conditions.derivatives(*parts, P, delta=0.01, domain=wide)
    assert not feasible(outside, names=("x",))


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ShapeError, match="2 names and the ends of 1"):
        conditions.box(["x", "u"], [(0.0, 1.0)])
