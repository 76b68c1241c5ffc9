"""Proofs that must be refused, made by hand and by mutation."""

import copy
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import Verdict, check
from nlsid_core.certificate.dyadic import is_positive_semidefinite
from nlsid_core.certificate.identity import Mode
from nlsid_core.errors import CertificateMismatch, CertificateRejected, Undecided
from tests.forgeries.genuine import genuine
from tests.forgeries.mutate import mutant
from tests.forgeries.oracle import agrees

KINDS = ("bound", "factor", "domain", "sphere", "matrix", "attraction")
MUTATIONS = 12_000


def verdict_of(document: Json | bytes, folder: Path, mode: Mode = "exact") -> Verdict:
    path = folder / "forged.proof.json"
    content = document if isinstance(document, bytes) else json.dumps(document).encode()
    path.write_bytes(content)
    return check(path, mode=mode)


def resealed(document: Json, change: Callable[[Json], None]) -> Json:
    forged = copy.deepcopy({k: v for k, v in document.items() if k != "digest"})
    change(forged)
    return forged | {"digest": _json.digest(forged)}


@pytest.mark.parametrize("kind", KINDS)
def test_the_genuine_proof_is_accepted_and_the_oracle_agrees(kind: str, tmp_path: Path) -> None:
    assert str(verdict_of(genuine()[kind], tmp_path)).startswith("PROVED")
    assert agrees(genuine()[kind])


@pytest.mark.parametrize("kind", set(KINDS) - {"factor"})
def test_rigorous_mode_accepts_what_is_strictly_positive(kind: str, tmp_path: Path) -> None:
    document = genuine()[kind]
    if kind == "bound":  # its coefficients 1/3 and 21/10 are no floats
        with pytest.raises(Undecided):
            verdict_of(document, tmp_path, "rigorous")
    else:
        assert verdict_of(document, tmp_path, "rigorous").mode == "rigorous"


@pytest.mark.parametrize("kind", KINDS)
def test_an_entry_changed_without_the_digest_is_damage(kind: str, tmp_path: Path) -> None:
    forged = copy.deepcopy(genuine()[kind])
    forged["claim"]["variables"][0] += "_"
    with pytest.raises(CertificateRejected, match="digest"):
        verdict_of(forged, tmp_path)


def main_gram(forged: Json) -> Json:
    found: Json = forged["proof"].get("gram") or forged["proof"]["decrease"]
    return found


def flip_an_entry(forged: Json) -> None:
    Q = main_gram(forged)["Q"]
    i, j = max(
        ((i, j) for i in range(len(Q)) for j in range(i)),
        key=lambda at: abs(float(Q[at[0]][at[1]])),
    )
    Q[i][j] = Q[j][i] = -Q[i][j]


def negate_the_diagonal(forged: Json) -> None:
    Q = main_gram(forged)["Q"]
    for i in range(len(Q)):
        Q[i][i] = -Q[i][i]


def reorder_the_basis(forged: Json) -> None:
    main_gram(forged)["basis"].reverse()


def repeat_a_monomial(forged: Json) -> None:
    basis = main_gram(forged)["basis"]
    basis[0] = basis[-1]


def raise_the_degree(forged: Json) -> None:
    main_gram(forged)["basis"][-1][0] += 1


def make_it_asymmetric(forged: Json) -> None:
    main_gram(forged)["Q"][0][-1] += 1.0


def forget_the_gram(forged: Json) -> None:
    forged["proof"].pop("gram", None)
    forged["proof"].pop("decrease", None)


def empty_the_gram(forged: Json) -> None:
    main_gram(forged).update(basis=[], Q=[])


def swap_the_claim(forged: Json) -> None:
    others = {"polynomial_bound": "matrix_inequality", "matrix_inequality": "region_of_attraction"}
    forged["claim"]["kind"] = others.get(forged["claim"]["kind"], "polynomial_bound")


def invent_a_kind(forged: Json) -> None:
    forged["claim"]["kind"] = "everything_is_fine"


def make_it_huge(forged: Json) -> None:
    main_gram(forged)["Q"][0][0] = 1e308


def make_it_tiny(forged: Json) -> None:
    Q = main_gram(forged)["Q"]
    for i in range(len(Q)):
        for j in range(len(Q)):
            Q[i][j] = 5e-324 if i == j else 0.0


def add_a_string(forged: Json) -> None:
    main_gram(forged)["Q"][0][0] = "1e3"


def add_a_stranger(forged: Json) -> None:
    forged["proof"]["note"] = "trust me"


def name_a_file(forged: Json) -> None:
    forged["claim"]["about"] = {"model": {"file": "../model.json", "digest": "sha256:0"}}


def negative_exponent(forged: Json) -> None:
    main_gram(forged)["basis"][0][0] = -1


def enormous_exponent(forged: Json) -> None:
    main_gram(forged)["basis"][0][0] = 2**62


BY_HAND = [
    flip_an_entry,
    negate_the_diagonal,
    reorder_the_basis,
    repeat_a_monomial,
    raise_the_degree,
    make_it_asymmetric,
    forget_the_gram,
    empty_the_gram,
    swap_the_claim,
    invent_a_kind,
    make_it_huge,
    make_it_tiny,
    add_a_string,
    add_a_stranger,
    name_a_file,
    negative_exponent,
    enormous_exponent,
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("forge", BY_HAND, ids=lambda forge: forge.__name__)
@pytest.mark.parametrize("mode", ["exact", "rigorous"])
def test_a_forgery_by_hand_is_refused(
    kind: str, forge: Callable[[Json], None], mode: Mode, tmp_path: Path
) -> None:
    with pytest.raises(CertificateRejected):
        verdict_of(resealed(genuine()[kind], forge), tmp_path, mode)


@pytest.mark.parametrize("mode", ["exact", "rigorous"])
@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("domain", "multipliers"),
        ("matrix", "multipliers"),
        ("sphere", "equality_multipliers"),
        ("attraction", "multiplier"),
        ("factor", "factor"),
    ],
)
def test_a_dropped_multiplier_is_refused(kind: str, key: str, mode: Mode, tmp_path: Path) -> None:
    def drop(forged: Json) -> None:
        del forged["proof"][key]

    with pytest.raises(CertificateRejected):
        verdict_of(resealed(genuine()[kind], drop), tmp_path, mode)


@pytest.mark.parametrize("kind", ["domain", "matrix", "attraction"])
def test_a_multiplier_with_its_sign_flipped_is_refused(kind: str, tmp_path: Path) -> None:
    def flip(forged: Json) -> None:
        proof = forged["proof"]
        gram = proof["multiplier"] if kind == "attraction" else proof["multipliers"][0]
        gram["Q"] = [[-entry for entry in row] for row in gram["Q"]]

    with pytest.raises(CertificateRejected):
        verdict_of(resealed(genuine()[kind], flip), tmp_path)


def test_a_factor_that_vanishes_somewhere_is_refused(tmp_path: Path) -> None:
    def weaken(forged: Json) -> None:
        forged["proof"]["factor"]["Q"][0][0] = 0.0

    with pytest.raises(CertificateRejected):
        verdict_of(resealed(genuine()["factor"], weaken), tmp_path)


def test_the_bound_cannot_be_raised_by_a_thousandth(tmp_path: Path) -> None:
    for kind in ("bound", "domain", "sphere"):

        def lift(forged: Json) -> None:
            forged["claim"]["bound"] += 1e-3

        with pytest.raises(CertificateRejected):
            verdict_of(resealed(genuine()[kind], lift), tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        b'{"format": "nlsid/proof", "version": 1, "version": 1}',
        b'{"format": "nlsid/proof", "version": 1, "claim": NaN}',
        b'{"format": "nlsid/proof", "version": 1, "claim": Infinity}',
        b'{"format": "nlsid/proof", "version": 1, "claim": 1e999}',
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b"\xff\xfe\x00",
        b"",
        b"[]",
        b"null",
        b'{"format": "nlsid/proof", "version": true}',
    ],
    ids=[
        "twice",
        "nan",
        "infinity",
        "1e999",
        "arrays",
        "objects",
        "bytes",
        "empty",
        "list",
        "null",
        "bool",
    ],
)
def test_what_is_no_document_is_refused(text: bytes, tmp_path: Path) -> None:
    with pytest.raises(CertificateRejected):
        verdict_of(text, tmp_path)


def test_a_hundred_megabytes_of_zeros_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "zeros.proof.json"
    with path.open("wb") as stream:
        stream.truncate(100 * 2**20)
    with pytest.raises(CertificateRejected, match="bytes"):
        check(path)


def test_megabytes_of_zeros_inside_the_gram_matrix_are_refused(tmp_path: Path) -> None:
    def swell(forged: Json) -> None:
        size = 700
        main_gram(forged).update(
            basis=[[k, 0] for k in range(size)], Q=[[0.0] * size for _ in range(size)]
        )

    with pytest.raises(CertificateRejected):
        verdict_of(resealed(genuine()["bound"], swell), tmp_path)


def test_a_digest_of_another_file_is_a_mismatch(tmp_path: Path) -> None:
    _json.write_document(tmp_path / "model.json", {"format": "nlsid/model"})

    def bind(forged: Json) -> None:
        other = _json.digest({"format": "another"})
        forged["claim"]["about"] = {"model": {"file": "model.json", "digest": other}}

    with pytest.raises(CertificateMismatch):
        verdict_of(resealed(genuine()["bound"], bind), tmp_path)


def test_a_monomial_stated_twice_is_refused(tmp_path: Path) -> None:
    def split(forged: Json) -> None:
        polynomial = forged["claim"]["polynomial"]
        polynomial["exponents"].append(polynomial["exponents"][0])
        polynomial["coefficients"].append(1e-30)

    with pytest.raises(CertificateRejected, match="twice"):
        verdict_of(resealed(genuine()["factor"], split), tmp_path)


def test_a_proof_built_to_take_hours_is_left_undecided_in_seconds(tmp_path: Path) -> None:
    """Singular, so only elimination could decide, with entries of thousands of bits."""
    size = 120

    def burden(forged: Json) -> None:
        main_gram(forged).update(
            basis=[[k + 1, 0] for k in range(size)],
            Q=[[f"{i * j + 1}/{3**900}" for j in range(size)] for i in range(size)],
        )
        polynomial = forged["claim"]["polynomial"]
        polynomial.update(exponents=[], coefficients=[])
        forged["claim"]["bound"] = 0.0
        forged["proof"]["multipliers"] = []

    started = time.perf_counter()
    with pytest.raises(CertificateRejected):
        verdict_of(resealed(genuine()["bound"], burden), tmp_path)
    with pytest.raises(Undecided, match="eliminate"):
        is_positive_semidefinite([[(i * j + 1) * 3**900 for j in range(size)] for i in range(size)])
    assert time.perf_counter() - started < 20


def test_the_verdict_quotes_the_claim_and_not_the_file(tmp_path: Path) -> None:
    def boast(forged: Json) -> None:
        forged["claim"]["statement"] = "the robot is safe"

    with pytest.raises(CertificateRejected, match="unknown member"):
        verdict_of(resealed(genuine()["bound"], boast), tmp_path)


def refute_or_confirm(document: Json, folder: Path) -> str:
    """What the checker says in both modes; fails if it proves what is not so."""
    answers = {}
    for mode in ("exact", "rigorous"):
        try:
            verdict_of(document, folder, mode)
            answers[mode] = "proved"
        except Undecided:
            answers[mode] = "undecided"
        except CertificateRejected:
            answers[mode] = "rejected"
    if "proved" in answers.values():
        assert answers["exact"] == "proved", f"rigorous alone proves {document}"
        assert agrees(document), f"proved, but the oracle disagrees: {document}"
    if answers["rigorous"] == "rejected":
        assert answers["exact"] != "proved", f"rigorous rejects what exact proves: {document}"
    return answers["exact"]


def run_mutations(count: int, seed: int, folder: Path) -> dict[str, int]:
    rng, outcomes = np.random.default_rng(seed), {"proved": 0, "rejected": 0, "undecided": 0}
    originals: list[Any] = [genuine()[kind] for kind in KINDS]
    for k in range(count):
        outcomes[refute_or_confirm(mutant(originals[k % len(originals)], rng), folder)] += 1
    return outcomes


def test_random_mutations_never_prove_what_is_false(tmp_path: Path) -> None:
    outcomes = run_mutations(300, 1, tmp_path)
    assert outcomes["rejected"] > 150
    assert outcomes["proved"] > 0  # some mutants are still proofs, and the oracle confirmed them


@pytest.mark.slow
def test_twelve_thousand_mutations_never_prove_what_is_false(tmp_path: Path) -> None:
    outcomes = run_mutations(MUTATIONS, 2, tmp_path)
    print(outcomes)
    assert sum(outcomes.values()) == MUTATIONS
    assert outcomes["rejected"] > MUTATIONS / 2
