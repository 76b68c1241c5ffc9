"""A funnel's proof is about these very files: every forgery of them is refused, with the reason."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.satellite_funnel import goal_matrix, problem
from nlsid_core import _json
from nlsid_core.certificate import check
from nlsid_core.certificate.check import proof_document
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.funnels import design_funnel
from nlsid_core.funnels.lstep import LSteps
from nlsid_core.funnels.pieces import prove_pieces

Files = dict[str, Any]
FORMS = {"vector_field": "vector_field.json", "policy": "policy.json", "funnel": "funnel.json"}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """The satellite's four documents."""
    field, nominal, weights = problem()
    folder = tmp_path_factory.mktemp("satellite")
    *_, proof = design_funnel(field, nominal, goal=goal_matrix(), **weights).save(folder)
    verdict = check(proof, mode="rigorous")
    assert verdict.margin > 0
    return {path.name: json.loads(path.read_text()) for path in folder.iterdir()}


def rho_at_one_knot(files: Files) -> None:
    """+0.1 %."""
    files["funnel.json"]["rho"][20] *= 1.001


def gain_lower(files: Files) -> None:
    """-3 %."""
    policy = files["policy.json"]
    policy["K"] = (0.97 * np.array(policy["K"])).tolist()


def multiplier_sign(files: Files) -> None:
    """One piece's μ."""
    piece = files["funnel.proof.json"]["proof"]["pieces"][10]
    piece["mu"] = (-np.array(piece["mu"])).tolist()


def gram_entry(files: Files) -> None:
    """One entry by one part in a million of the largest."""
    gram = files["funnel.proof.json"]["proof"]["pieces"][30]["gram"][0]
    gram[5] += 1e-6 * max(map(abs, gram))


def goal_shrunk(files: Files) -> None:
    """By 1 % in every direction: past the room the design leaves."""
    goal = files["funnel.proof.json"]["claim"]["goal"]
    goal["P"] = (1.02 * np.array(goal["P"])).tolist()


def piece_missing(files: Files) -> None:
    """The last one."""
    files["funnel.proof.json"]["proof"]["pieces"].pop()


def knots_swapped(files: Files) -> None:
    """Two neighbouring times, in policy and funnel alike."""
    for name in ("policy.json", "funnel.json"):
        t = files[name]["t"]
        t[7], t[8] = t[8], t[7]


def shapes_swapped(files: Files) -> None:
    """Two neighbouring P."""
    P = files["funnel.json"]["P"]
    P[7], P[8] = P[8], P[7]


def nominal_shifted(files: Files) -> None:
    """By 1e-6, in policy and funnel alike."""
    for name in ("policy.json", "funnel.json"):
        files[name]["x"] = (np.array(files[name]["x"]) + 1e-6).tolist()


def other_inertia(files: Files) -> None:
    """The first wheel's authority, 1 % less."""
    equation = files["vector_field.json"]["pieces"][0][3]
    equation["coefficients"] = [
        c * 0.99 if sum(e) == 1 else c
        for e, c in zip(equation["exponents"], equation["coefficients"], strict=True)
    ]


def degree_raised(files: Files) -> None:
    """To one whose expansion nobody would live to see."""
    files["vector_field.json"]["pieces"][0][0]["exponents"][0][1] = 400


def frame_singular(files: Files) -> None:
    """z then reaches no more than a plane of states."""
    T = files["funnel.proof.json"]["proof"]["pieces"][3]["T"]
    T[0] = T[1]


FORGERIES: list[tuple[Callable[[Files], None], str]] = [
    (rho_at_one_knot, "do not represent"),
    (gain_lower, "do not represent"),
    (multiplier_sign, "do not represent"),
    (gram_entry, "do not represent"),
    (goal_shrunk, "goal"),
    (piece_missing, "missing"),
    (knots_swapped, "does not increase"),
    (shapes_swapped, "do not represent"),
    (nominal_shifted, "do not represent"),
    (other_inertia, "do not represent"),
    (degree_raised, "degree 4"),
    (frame_singular, "singular"),
]


def write(files: Files, folder: Path, *, rebind: bool) -> Path:
    """The files as they are, or with every digest made to fit again, as a forger would."""
    files = json.loads(json.dumps(files))
    if rebind:
        field = _json.digest(files["vector_field.json"])
        files["policy.json"]["vector_field"] = files["funnel.json"]["vector_field"] = field
        files["funnel.json"]["policy"] = _json.digest(files["policy.json"])
        proof = files["funnel.proof.json"]
        for role, name in FORMS.items():
            proof["claim"]["about"][role]["digest"] = _json.digest(files[name])
        files["funnel.proof.json"] = proof_document(proof["claim"], proof["proof"])
    for name, document in files.items():
        (folder / name).write_text(json.dumps(document))
    return folder / "funnel.proof.json"


@pytest.mark.parametrize(("forge", "reason"), FORGERIES, ids=lambda f: getattr(f, "__name__", ""))
def test_a_forgery_with_fresh_digests_is_refused_for_what_it_is(
    files: Files, tmp_path: Path, forge: Callable[[Files], None], reason: str
) -> None:
    forged = json.loads(json.dumps(files))
    forge(forged)
    with pytest.raises(CertificateRejected, match=reason):
        check(write(forged, tmp_path, rebind=True), mode="rigorous")


@pytest.mark.parametrize("forge", [multiplier_sign, goal_shrunk])
def test_the_exact_mode_refuses_as_well(
    files: Files, tmp_path: Path, forge: Callable[[Files], None]
) -> None:
    forged = json.loads(json.dumps(files))
    forge(forged)
    with pytest.raises(CertificateRejected, match=dict(FORGERIES)[forge]):
        check(write(forged, tmp_path, rebind=True), mode="exact")


@pytest.mark.slow
@pytest.mark.parametrize(("forge", "reason"), FORGERIES, ids=lambda f: getattr(f, "__name__", ""))
def test_the_exact_mode_refuses_every_forgery(
    files: Files, tmp_path: Path, forge: Callable[[Files], None], reason: str
) -> None:
    forged = json.loads(json.dumps(files))
    forge(forged)
    with pytest.raises(CertificateRejected, match=reason):
        check(write(forged, tmp_path, rebind=True), mode="exact")


@pytest.mark.parametrize("forge", [rho_at_one_knot, gain_lower, nominal_shifted, other_inertia])
def test_a_forged_file_is_refused_by_its_digest(
    files: Files, tmp_path: Path, forge: Callable[[Files], None]
) -> None:
    forged = json.loads(json.dumps(files))
    forge(forged)
    with pytest.raises(CertificateMismatch, match="is not the"):
        check(write(forged, tmp_path, rebind=False), mode="rigorous")


def test_writing_the_files_again_as_they_are_changes_nothing(files: Files, tmp_path: Path) -> None:
    assert check(write(files, tmp_path, rebind=True), mode="rigorous").margin > 0


def test_no_proof_is_found_for_a_funnel_that_is_one_percent_too_wide() -> None:
    field, nominal, weights = problem(25)
    design = design_funnel(field, nominal, goal=goal_matrix(), **weights)
    knots = len(design.funnel.t)
    wide = replace(design.funnel, rho=design.funnel.rho * np.linspace(1.01, 1, knots))
    assert prove_pieces(LSteps(field), design.policy, wide).unproved
