"""A funnel's proof is about these very files: every forgery of them is refused, with the reason."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nlsid_core import proofs
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.design.continuous.pieces import prove_pieces
from nlsid_core.errors import CertificateMismatch
from tests.core.kernel import refusals
from tests.edits import Edit, both, changed, exchanged, put, scaled, without
from tests.funnel_files import FIELD, FUNNEL, POLICY, PROOF, Files, files_of, forged_by, write
from tests.funnel_problem import satellite
from tests.marks import slow_among

NOMINAL = (POLICY, FUNNEL)  # have its times and states


@pytest.fixture
def files() -> Files:
    """The satellite's four documents."""
    return files_of(satellite())


def _other_inertia(files: Files) -> None:
    """The first wheel's authority, 1 % less."""
    equation = files[FIELD]["pieces"][0][3]
    terms = zip(equation["exponents"], equation["coefficients"], strict=True)
    equation["coefficients"] = [0.99 * c if sum(e) == 1 else c for e, c in terms]


PIECES = f"{PROOF} proof pieces"
SHIFTED = both(*(changed(f"{name} x", lambda x: (np.array(x) + 1e-6).tolist()) for name in NOMINAL))
FORGERIES: dict[str, tuple[Edit, str]] = {
    "rho at one knot": (scaled(f"{FUNNEL} rho 20", 1.001), "not_positive"),
    "gain lower": (scaled(f"{POLICY} K", 0.97), "not_positive"),
    "a multiplier's sign": (
        both(scaled(f"{PIECES} 10 mu start", -1), scaled(f"{PIECES} 10 mu end", -1)),
        "not_positive",
    ),
    "an entry by a tenth": (
        changed(
            f"{PIECES} 16 squares factors 0 0",
            lambda row: [*row[:5], row[5] + max(map(abs, row)) // 10, *row[6:]],
        ),
        "not_positive",
    ),
    # What is left of the constant does not hold as much again.
    "margin doubled": (scaled(f"{PROOF} proof margin", 2.2), "not_positive"),
    # By 1 % in every direction: past the room the design leaves.
    "goal smaller": (scaled(f"{PROOF} claim goal P", 1.02), "not_definite"),
    "a piece missing": (without(f"{PIECES} -1"), "not_covered"),
    "knots exchanged": (
        both(*(exchanged(f"{name} t 7", f"{name} t 8") for name in NOMINAL)),
        "malformed",
    ),
    "shapes exchanged": (exchanged(f"{FUNNEL} P 7", f"{FUNNEL} P 8"), "not_positive"),
    "nominal shifted": (SHIFTED, "not_positive"),
    "another inertia": (_other_inertia, "not_positive"),
    # To one whose expansion nobody would live to see.
    "a degree of 400": (put(f"{FIELD} pieces 0 0 exponents 0 1", 400), "malformed"),
    "a shape not symmetric by an ulp": (
        changed(f"{FUNNEL} P 7 0 1", lambda entry: math.nextafter(entry, 1.0)),
        "not_definite",
    ),
    "a monomial counted twice": (
        changed(f"{PIECES} 3 columns 2", lambda column: column + 1),
        "not_positive",
    ),
}


# A refusal after the polynomials of all pieces: as long as a proof. One of them is always tried.
LONG = {
    "gain lower",
    "a multiplier's sign",
    "an entry by a tenth",
    "margin doubled",
    "goal smaller",
    "shapes exchanged",
    "nominal shifted",
    "another inertia",
    "a monomial counted twice",
}


@pytest.mark.parametrize("what", slow_among(FORGERIES, LONG))
def test_a_forgery_with_fresh_digests_is_refused_for_what_it_is(files: Files, what: str) -> None:
    forge, reason = FORGERIES[what]
    refusals.refused_with_fresh_digests(forged_by(forge, files), reason)


@pytest.mark.parametrize("what", ["rho at one knot", "gain lower", "another inertia"])
def test_a_forged_file_is_refused_by_its_digest(files: Files, what: str) -> None:
    forged = forged_by(FORGERIES[what][0], files)
    with refusals.refused("mismatch"):
        proofs.decide(forged[PROOF], forged)


def test_writing_the_files_again_as_they_are_changes_nothing(files: Files, tmp_path: Path) -> None:
    """And with other white space one of them is another file."""
    path = write(files, tmp_path)
    assert proofs.check(path).margin > 0
    (tmp_path / POLICY).write_text(json.dumps(files[POLICY]))
    with pytest.raises(CertificateMismatch, match=r"policy\.json is not the policy"):
        proofs.check(path)


@pytest.mark.slow
def test_no_proof_is_found_for_a_funnel_that_is_one_percent_too_wide() -> None:
    found = satellite()
    knots = len(found.funnel.t)
    wide = replace(found.funnel, rho=found.funnel.rho * np.linspace(1.01, 1, knots))
    assert prove_pieces(LSteps(found.model, found.policy), wide).unproved
