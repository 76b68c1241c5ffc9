"""Implicit models in the convex sets of thesis Chapter 2: exact proofs, and their forgeries."""

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from examples import not_a_contraction
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
from nlsid_core.proofs import check, decide
from nlsid_core.sos import Program, SumOfSquares, forms_of, solve
from tests.edits import Edit, both, changed, put, scaled, without
from tests.funnel_files import Files, bind, forged_by, write
from tests.implicit_models import coupled, cubic_spring, lagged, linear, quintic

DELTA = 0.1


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


MODEL, CLAIM = "model.json", "claim.proof.json"


@cache
def _made(name: str) -> str:
    model, kind, ends = GENUINE[name]
    proof = prove_implicit(model, delta=DELTA, set=kind, ends=ends)
    assert proof is not None
    return json.dumps({MODEL: model.document(), CLAIM: proof.document(model, MODEL)})


def made(name: str) -> Files:
    """Fresh copies of a genuine model and its proof."""
    return dict(json.loads(_made(name)))


NAMES = list(GENUINE)


@pytest.mark.parametrize("name", NAMES)
def test_a_genuine_proof_of_each_set_passes(name: str, tmp_path: Path) -> None:
    verdict = check(write(made(name), tmp_path))
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


def _larger_right_side(files: Files) -> None:
    rows = files[MODEL]["h"]
    for exponents, values in zip(rows["exponents"], rows["coefficients"], strict=True):
        if not any(exponents[: len(values)]) and any(exponents[len(values) :]):
            values[:] = [8.0 * value for value in values]


OTHERS = {"2.11": "2.13", "2.13": "2.19", "2.19": "2.13"}
STABLE_PART = f"{CLAIM} proof inequalities stable"
CHANGES: dict[str, Edit] = {
    "a larger right side": _larger_right_side,
    "not so monotone": scaled(f"{MODEL} monotonicity", 100.0),
    "greedy": put(f"{CLAIM} claim delta", 1e3),
    "a negative delta": put(f"{CLAIM} claim delta", -0.1),
    "squares too large": changed(f"{STABLE_PART} squares unit", lambda unit: unit - 1),
    "another set": changed(f"{CLAIM} claim set", OTHERS.__getitem__),
    "no such set": put(f"{CLAIM} claim set", "2.16"),
    "an inequality less": without(f"{CLAIM} proof inequalities monotone"),
    "a stranger": put(f"{CLAIM} proof note", "trust me"),
}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", CHANGES)
def test_a_forgery_of_any_set_is_rejected(name: str, what: str) -> None:
    rejected(forged_by(CHANGES[what], made(name)))


def rejected(files: Files) -> None:
    """Though all digests fit: only the mathematics can refuse."""
    bind(files)
    with pytest.raises(CertificateRejected) as refused:
        decide(files[CLAIM], files)
    assert not isinstance(refused.value, CertificateMismatch)


@pytest.mark.parametrize("name", NAMES)
def test_a_proof_of_another_model_is_a_mismatch(name: str) -> None:
    other = changed(f"{MODEL} h coefficients 0 0", lambda c: math.nextafter(c, 9.0))
    forged = forged_by(other, made(name))
    with pytest.raises(CertificateMismatch):
        decide(forged[CLAIM], forged)


LOCAL = [name for name in NAMES if GENUINE[name][2]]
STABLE_MULTIPLIERS = f"{STABLE_PART} multipliers"


@pytest.mark.parametrize("name", LOCAL)
@pytest.mark.parametrize(
    "change",
    [
        put(f"{CLAIM} claim box *", [-100.0, 100.0]),
        put(f"{CLAIM} claim box *", [0.5, 0.5]),
        without(f"{CLAIM} claim box"),
        changed(f"{STABLE_MULTIPLIERS} * squares unit", lambda unit: unit - 5),
        changed(STABLE_MULTIPLIERS, lambda given: [*reversed(given), given[-1]]),
        put(f"{STABLE_MULTIPLIERS} -1 of", 99),
    ],
    ids=["wider", "empty", "another claim", "shrunk", "misplaced", "of no part of the box"],
)
def test_a_local_proof_is_about_its_own_box_by_its_own_multipliers(name: str, change: Edit) -> None:
    rejected(forged_by(change, made(name)))


@pytest.mark.parametrize("name", NAMES)
def test_a_storage_that_is_not_positive_is_rejected(name: str) -> None:
    forged = made(name)
    key = next((key for key in ("P", "M") if key in forged[CLAIM]["proof"]), None)
    {
        "P": scaled(f"{CLAIM} proof P", -1.0),
        "M": scaled(f"{CLAIM} proof M * * coefficients", -1.0),
        # 2.19: the storage is the model's own E
        None: both(scaled(f"{MODEL} h coefficients", -1.0), put(f"{MODEL} monotonicity", 1e-9)),
    }[key](forged)
    rejected(forged)


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


@pytest.mark.parametrize(
    "change",
    [
        put(f"{CLAIM} proof M 0 0 exponents -1 -1", 10**6),
        both(
            changed(
                f"{MODEL} h exponents", lambda e: [*e, *([15, 15, 15, 15 - k] for k in range(8))]
            ),
            changed(f"{MODEL} h coefficients", lambda c: [*c, *[[1.0]] * 8]),
        ),
    ],
    ids=["a degree", "a model"],
)
def test_a_document_that_would_take_forever_is_refused(change: Edit) -> None:
    rejected(forged_by(change, made("derivatives, 2.11")))


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
    example = {MODEL: model.document(), CLAIM: proof.document(model, MODEL)}
    assert "for every state and input" in check(write(example, tmp_path)).statement
    rejected(forged_by(put(f"{MODEL} h coefficients -1", [-0.6]), example))


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
