"""Polynomial bounds, regions of attraction, stable sets: the kernel against an oracle, and lies."""

import copy
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.kernel import positivity
from nlsid_core.polynomial import Gram, variables
from nlsid_core.proofs import decide, proof_document
from nlsid_core.sos.proofs import attraction_document, bound_document, matrix_document
from tests.core.kernel import oracle_polynomial as oracle
from tests.core.kernel.genuine_polynomial import genuine

SCHEMAS = Path(__file__).resolve().parents[3] / "docs" / "schema"
NAMES = [(kind, name) for kind, found in genuine().items() for name in found]
BOUNDS = [(kind, name) for kind, name in NAMES if kind == "polynomial_bound"]
x, y = variables("x y")


@pytest.mark.parametrize(("kind", "name"), NAMES)
def test_a_genuine_proof_is_accepted_and_the_oracle_agrees(kind: str, name: str) -> None:
    document, about = genuine()[kind][name]
    assert str(decide(document, about)).startswith("PROVED")
    assert oracle.agrees(document, about)
    schema = "stable_set" if kind == "stable_set" else "polynomials"
    published = files.load_document(SCHEMAS / f"proof_{schema}.schema.json")
    jsonschema.Draft202012Validator.check_schema(published)
    jsonschema.validate(document, published)
    for part in ("claim", "proof"):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(document | {part: document[part] | {"note": "trust"}}, published)


@pytest.mark.parametrize(("kind", "name"), NAMES)
def test_the_kernels_polynomials_are_the_oracles_exactly(
    kind: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coefficient by coefficient, and at hundreds of rational points."""
    document, about = genuine()[kind][name]
    seen: dict[str, oracle.P] = {}
    decided = positivity.remainder

    def watched(c: Any, squares: Any, ring: Any, what: str) -> Any:
        assert c.order == 0
        terms = {ring.exponents(k): Fraction(v, c.denominator) for k, v in c.terms.items()}
        seen[what] = oracle.P(ring.count, terms)
        return decided(c, squares, ring, what)

    monkeypatch.setattr(positivity, "remainder", watched)
    decide(document, about)
    expected = _expected(document, about)
    assert set(seen) == set(expected)
    rng = np.random.default_rng(0)
    for what, p in expected.items():
        assert seen[what].terms == p.terms
        for _ in range(200 // len(expected)):
            point = [Fraction(int(a), int(b)) for a, b in rng.integers(1, 50, size=(p.n, 2))]
            assert seen[what](point) == p(point)


def _expected(document: Json, about: Mapping[str, Json]) -> dict[str, oracle.P]:
    claim, proof = document["claim"], document["proof"]
    if claim["kind"] == "region_of_attraction":
        found = oracle.attraction_inequalities(claim, proof)
        return {"V": found["V"], "the decrease of V": found["decrease"]}
    if claim["kind"] == "polynomial_bound":
        return {"the inequality": _reduced(*oracle.bound_inequality(claim, proof), proof)}
    found_sets = oracle.stable_inequalities(claim, proof, about["model.json"])
    return {
        f"inequality {name}": _reduced(c, domain, proof["inequalities"][name])
        for name, (c, domain) in found_sets.items()
    }


def _reduced(c: oracle.P, domain: list[oracle.P], witness: Json) -> oracle.P:
    for multiplier in witness.get("multipliers", []):
        c = c - oracle.squares(multiplier, c.n)[0] * domain[multiplier["of"]]
    return c


def witness_of(document: Json) -> Json:
    """The main squares of a proof."""
    proof = document["proof"]
    found: Json = proof.get("decrease") or proof.get("inequalities", {}).get("stable")
    return found or (proof if "squares" in proof else next(iter(proof["inequalities"].values())))


def double_the_squares(document: Json) -> None:
    witness = witness_of(document)
    if witness["squares"]["unit"]:
        witness["squares"]["unit"] -= 1
    else:
        witness["columns"] = [column + 1 for column in witness["columns"]]


def reverse_the_basis(document: Json) -> None:
    witness_of(document)["basis"].reverse()


def repeat_a_monomial(document: Json) -> None:
    witness_of(document)["basis"][0] = witness_of(document)["basis"][-1]


def raise_the_degree(document: Json) -> None:
    witness_of(document)["basis"][-1][0] += 1


def shift_the_columns(document: Json) -> None:
    witness = witness_of(document)
    witness["columns"] = [*witness["columns"][1:], 7]


def forget_the_squares(document: Json) -> None:
    del witness_of(document)["squares"]


def empty_the_basis(document: Json) -> None:
    witness_of(document).update(basis=[], columns=[])


def add_a_stranger(document: Json) -> None:
    document["proof"]["note"] = "trust me"


def boast(document: Json) -> None:
    document["claim"]["statement"] = "the robot is safe"


def name_a_file(document: Json) -> None:
    document["claim"]["about"] = {"plan": {"file": "../plan.json", "digest": "sha256:0"}}


def negative_exponent(document: Json) -> None:
    witness_of(document)["basis"][0][0] = -1


def enormous_exponent(document: Json) -> None:
    witness_of(document)["basis"][0][0] = 2**52


def enormous_unit(document: Json) -> None:
    witness_of(document)["squares"]["unit"] = 10**9


def enormous_column(document: Json) -> None:
    witness_of(document)["columns"][0] = 10**9


def negative_scale(document: Json) -> None:
    witness_of(document)["squares"]["scale"] = -1


def a_true_for_a_one(document: Json) -> None:
    witness_of(document)["squares"]["factors"][0][0][0] = True


def negative_weights(document: Json) -> None:
    squares = witness_of(document)["squares"]
    squares["weights"] = [-1] * len(squares["factors"][0])


def swap_the_kind(document: Json) -> None:
    others = {"polynomial_bound": "stable_set", "stable_set": "region_of_attraction"}
    document["claim"]["kind"] = others.get(document["claim"]["kind"], "polynomial_bound")


BY_HAND: list[Callable[[Json], None]] = [
    double_the_squares, reverse_the_basis, repeat_a_monomial, raise_the_degree, shift_the_columns,
    forget_the_squares, empty_the_basis, add_a_stranger, boast, name_a_file, negative_exponent,
    enormous_exponent, enormous_unit, enormous_column, negative_scale, a_true_for_a_one,
    negative_weights, swap_the_kind,
]  # fmt: skip


@pytest.mark.parametrize("forge", BY_HAND, ids=lambda forge: forge.__name__)
def test_a_forgery_by_hand_is_refused(forge: Callable[[Json], None]) -> None:
    survivors = []
    for kind, name in NAMES:
        document, about = genuine()[kind][name]
        forged = copy.deepcopy(document)
        forge(forged)
        try:
            decide(forged, about)
        except CertificateRejected:
            continue
        survivors.append(name)
        assert oracle.agrees(forged, about), name
    assert len(survivors) <= (2 if forge is reverse_the_basis else 0), survivors


@pytest.mark.parametrize(("kind", "name"), BOUNDS)
def test_a_bound_cannot_be_raised_and_a_monomial_cannot_be_stated_twice(
    kind: str, name: str
) -> None:
    document, _ = genuine()[kind][name]
    if name != "matrix":
        for lift in (1e-3, 1e-6):
            forged = copy.deepcopy(document)
            forged["claim"]["bound"] = float(forged["claim"]["bound"]) + lift
            with pytest.raises(CertificateRejected, match="not positive"):
                decide(forged, {})
    forged = copy.deepcopy(document)
    polynomial = forged["claim"].get("polynomial") or forged["claim"]["matrix"][0][0]
    polynomial["exponents"].append(polynomial["exponents"][-1])
    polynomial["coefficients"].append(1e-30)
    with pytest.raises(CertificateRejected, match=r"distinct|symmetric"):
        decide(forged, {})


@pytest.mark.parametrize(
    ("kind", "name", "key"),
    [
        ("polynomial_bound", "domain", "multipliers"),
        ("polynomial_bound", "matrix", "multipliers"),
        ("polynomial_bound", "sphere", "equality_multipliers"),
        ("polynomial_bound", "factor", "factor"),
        ("region_of_attraction", "level", "multiplier"),
    ],
)
def test_a_dropped_multiplier_is_refused(kind: str, name: str, key: str) -> None:
    forged = copy.deepcopy(genuine()[kind][name][0])
    del forged["proof"][key]
    with pytest.raises(CertificateRejected):
        decide(forged, {})


def test_a_factor_that_is_nowhere_negative_is_not_enough() -> None:
    """φ = x² + y² proves -1 + … only where φ > 0: a constant of 0 is refused."""
    forged = copy.deepcopy(genuine()["polynomial_bound"]["factor"][0])
    for constant in (0.0, -1.0, "-1/7"):
        forged["proof"]["factor"]["constant"] = constant
        with pytest.raises(CertificateRejected, match="constant should be positive"):
            decide(forged, {})


def gram(Q: Any, basis: Any = ((0, 0), (1, 0), (0, 1))) -> Gram:
    return Gram(np.asarray(basis), np.asarray(Q), ("x", "y"))


def test_a_monomial_that_nothing_balances_is_refused_however_small() -> None:
    document = bound_document(x**2 + y**2 + 1, 0.0, gram(np.eye(3)))
    decide(document, {})
    document["claim"]["polynomial"]["exponents"].append([3, 0])
    document["claim"]["polynomial"]["coefficients"].append(1e-300)
    with pytest.raises(CertificateRejected, match="no product of the basis"):
        decide(document, {})


def test_the_margin_is_what_is_left_of_the_inequality() -> None:
    document = bound_document(x**2 + y**2 + 4, 0.0, gram(np.diag([4.0, 1.0, 1.0])))
    assert Fraction(1) < decide(document, {}).margin <= 4
    M = np.array([[2.0 + 0 * x, 0 * x], [0 * x, 3.0 + x**2]], dtype=object)
    basis = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 1]])
    found = matrix_document(
        M, Gram(basis, np.diag([2.0, 3.0, 1.0]), ("x", "y", "y[0]", "y[1]")), names=("x", "y")
    )
    assert Fraction(1, 4) < decide(found, {}).margin <= 2


def test_attraction_needs_an_equilibrium_a_level_and_a_basis_without_1() -> None:
    V, one = x**2 + y**2, gram(np.eye(2), [[1, 0], [0, 1]])
    good = attraction_document((-x, -y), V, None, positive=one, decrease=gram(2 * one.Q, one.basis))
    assert decide(good, {}).statement == (
        "every solution of dx/dt = -x, dy/dt = -y tends to the origin"
    )
    changes: list[tuple[Callable[[Json], Any], str]] = [
        (lambda d: d["claim"].update(level=0.0), "should be positive"),
        (lambda d: d["claim"].update(level=1.0), "'multiplier' is missing"),
        (lambda d: d["proof"].update(multiplier=d["proof"]["V"]), "unknown member"),
        (lambda d: d["claim"]["field"].pop(), "list of 2 to 2"),
    ]
    for change, reason in changes:
        forged = copy.deepcopy(good)
        change(forged)
        with pytest.raises(CertificateRejected, match=reason):
            decide(forged, {})
    moved = copy.deepcopy(good)
    moved["claim"]["field"][0] = {"exponents": [[0, 0], [1, 0]], "coefficients": [1.0, -1.0]}
    with pytest.raises(CertificateRejected, match="not an equilibrium"):
        decide(moved, {})
    with_1 = copy.deepcopy(good)
    for witness in with_1["proof"].values():
        witness["basis"].insert(0, [0, 0])
        witness["columns"].insert(0, 0)
    with pytest.raises(CertificateRejected, match="should not hold the monomial 1"):
        decide(with_1, {})


def test_a_valley_of_v_is_no_region_of_attraction() -> None:
    """V = (x - y)² + x⁴ vanishes at 0 only; V = (x - y)² on a line: no pure power is left."""
    flat = attraction_document(
        (-x, -y), (x - y) ** 2 + 1e-3 * (x**2 + y**2), None,
        positive=gram([[1.001, -1.0], [-1.0, 1.001]], [[1, 0], [0, 1]]),
        decrease=gram([[2.002, -2.0], [-2.0, 2.002]], [[1, 0], [0, 1]]),
    )  # fmt: skip
    decide(flat, {})
    flat["claim"]["V"]["coefficients"] = [1.0, -2.0, 1.0]
    with pytest.raises(CertificateRejected):
        decide(flat, {})


def test_a_proof_of_another_model_is_a_mismatch() -> None:
    document, about = genuine()["stable_set"]["slopes"]
    other = copy.deepcopy(dict(about))
    other["model.json"]["period"] = 0.2
    with pytest.raises(CertificateMismatch, match="not the model this proof is about"):
        decide(document, other)
    with pytest.raises(CertificateMismatch, match="cannot be read"):
        decide(document, {})


@pytest.mark.parametrize(
    ("kind", "name", "sentence"),
    [
        (
            "polynomial_bound", "domain",
            "PROVED x y + x >= {bound} for all real x, y with -x^2 - y^2 + 1 >= 0, margin {margin}",
        ),
        (
            "region_of_attraction", "everywhere",
            "PROVED every solution of dx/dt = -0.5 x^3 - 1.5 x^2 - y, dy/dt = 3 x - y tends to the "
            "origin, margin {margin}",
        ),
        (
            "stable_set", "slopes_on_a_box",
            "PROVED the implicit model with 1 state has exactly one next state for every state in "
            "[-1, 1] and every input in [-1, 1]; two of its solutions with the same input have "
            "differences whose squares have a finite sum (set 2.11: a storage falls by 0.1 times "
            "the squared difference or more a sample), margin 0.1\n"
            "  assuming both solutions stay in this box of states and inputs",
        ),
        (
            "stable_set", "well_posed",
            "PROVED the implicit model with 2 states has exactly one next state for every state "
            "and input, margin 0.9",
        ),
    ],
)  # fmt: skip
def test_the_sentence_says_what_was_decided_and_no_more(
    kind: str, name: str, sentence: str
) -> None:
    document, about = genuine()[kind][name]
    verdict = decide(document, about)
    words = str(verdict).split()
    shown = {"margin": words[-1], "bound": words[words.index(">=") + 1] if ">=" in words else ""}
    assert str(verdict) == sentence.format(**shown)
    if shown["bound"]:
        assert Fraction(shown["bound"]) <= Fraction(document["claim"]["bound"])
    if "margin {margin}" in sentence:
        assert Fraction(shown["margin"]) <= verdict.margin


def test_a_polynomial_too_long_to_print_is_named_by_its_size() -> None:
    terms = [[k] for k in range(0, 60, 2)]
    document = {
        "exponents": terms,
        "coefficients": [f"{3**200 + k}/{7**200}" for k in range(len(terms))],
    }
    n = len(terms)
    claim = {
        "kind": "polynomial_bound", "about": {}, "variables": ["x"], "polynomial": document,
        "bound": 0,
    }  # fmt: skip
    proof = {
        "basis": [[k] for k in range(n)], "columns": [0] * n,
        "squares": {"unit": 0, "factors": [[]]},
    }  # fmt: skip
    statement = decide(proof_document(claim, proof), {}).statement
    assert statement == ("the claim's polynomial of degree 58 with 30 terms >= 0 for all real x")
