"""A funnel's proof is about these very files: every forgery of them is refused, with the reason."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.satellite_funnel import goal_matrix, problem
from nlsid_core.design import ContinuousTracking, design_funnel
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.design.continuous.pieces import prove_pieces
from nlsid_core.errors import CertificateMismatch
from nlsid_core.proofs import check
from tests.core.kernel import refusals
from tests.decided import decided
from tests.funnel_files import Files, forged_by, write
from tests.marks import slow_among


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """The satellite's four documents, with half the knots of the example."""
    field, nominal, weights = problem(25)
    folder = tmp_path_factory.mktemp("satellite")
    *_, proof = design_funnel(
        ContinuousTracking(field, nominal, goal=goal_matrix(), **weights)
    ).save(folder)
    verdict = check(proof)
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
    mu = files["funnel.proof.json"]["proof"]["pieces"][10]["mu"]
    for end in ("start", "end"):
        mu[end] = [-entry for entry in mu[end]]


def factor_entry(files: Files) -> None:
    """One entry by a tenth of the largest."""
    row = files["funnel.proof.json"]["proof"]["pieces"][16]["squares"]["factors"][0][0]
    row[5] += max(map(abs, row)) // 10


def margin_doubled(files: Files) -> None:
    """What is left of the constant does not hold as much again."""
    files["funnel.proof.json"]["proof"]["margin"] *= 2.2


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


def shape_asymmetric(files: Files) -> None:
    """One entry of P by one unit in its last place."""
    P = files["funnel.json"]["P"][7]
    P[0][1] = float(np.nextafter(P[0][1], 1))


def column_shifted(files: Files) -> None:
    """A monomial counted twice as large as it is."""
    files["funnel.proof.json"]["proof"]["pieces"][3]["columns"][2] += 1


FORGERIES: list[tuple[Callable[[Files], None], str]] = [
    (rho_at_one_knot, "not_positive"),
    (gain_lower, "not_positive"),
    (multiplier_sign, "not_positive"),
    (factor_entry, "not_positive"),
    (margin_doubled, "not_positive"),
    (goal_shrunk, "not_definite"),
    (piece_missing, "not_covered"),
    (knots_swapped, "malformed"),
    (shapes_swapped, "not_positive"),
    (nominal_shifted, "not_positive"),
    (other_inertia, "not_positive"),
    (degree_raised, "malformed"),
    (shape_asymmetric, "not_definite"),
    (column_shifted, "not_positive"),
]


# A refusal after the polynomials of all pieces: as long as a proof. One of them is always tried.
LONG = {
    "gain_lower",
    "multiplier_sign",
    "factor_entry",
    "margin_doubled",
    "goal_shrunk",
    "shapes_swapped",
    "nominal_shifted",
    "other_inertia",
    "column_shifted",
}


@pytest.mark.parametrize(
    ("forge", "reason"), slow_among(FORGERIES, LONG), ids=lambda f: getattr(f, "__name__", "")
)
def test_a_forgery_with_fresh_digests_is_refused_for_what_it_is(
    files: Files, tmp_path: Path, forge: Callable[[Files], None], reason: str
) -> None:
    with refusals.refused(reason):
        decided(write(forged_by(forge, files), tmp_path, rebind=True))


@pytest.mark.parametrize(
    "forge",
    slow_among([rho_at_one_knot, gain_lower, nominal_shifted, other_inertia], {"nominal_shifted"}),
)
def test_a_forged_file_is_refused_by_its_digest(
    files: Files, tmp_path: Path, forge: Callable[[Files], None]
) -> None:
    with pytest.raises(CertificateMismatch, match="is not the"):
        decided(write(forged_by(forge, files), tmp_path, rebind=False))


def test_writing_the_files_again_as_they_are_changes_nothing(files: Files, tmp_path: Path) -> None:
    assert decided(write(files, tmp_path, rebind=True)).margin > 0


def test_a_file_with_other_white_space_is_another_file(files: Files, tmp_path: Path) -> None:
    path = write(files, tmp_path, rebind=True)
    (tmp_path / "policy.json").write_text(json.dumps(files["policy.json"]))
    with pytest.raises(CertificateMismatch, match=r"policy\.json is not the policy"):
        decided(path)


@pytest.mark.slow
def test_no_proof_is_found_for_a_funnel_that_is_one_percent_too_wide() -> None:
    field, nominal, weights = problem(25)
    design = design_funnel(ContinuousTracking(field, nominal, goal=goal_matrix(), **weights))
    knots = len(design.funnel.t)
    wide = replace(design.funnel, rho=design.funnel.rho * np.linspace(1.01, 1, knots))
    assert prove_pieces(LSteps(field, design.policy), wide).unproved
