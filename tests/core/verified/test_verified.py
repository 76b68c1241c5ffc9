"""The second kernel: Coq builds it, accepts what is true, and refuses what is forged."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from nlsid_core import proofs
from nlsid_core.errors import CertificateRejected
from tests.funnel_files import FIELD, FUNNEL, POLICY, PROOF, Files, bind, write

ROOT = Path(__file__).resolve().parents[3]
VERIFIED = ROOT / "verified"
CLIPPED = ROOT / "tests" / "core" / "kernel" / "corpus" / "continuous_funnel" / "clipped"
GAPS = re.compile(r"\b(Admitted|admit|Axiom|Parameter|Conjecture|Unset Guard Checking)\b")

needs_coq = pytest.mark.skipif(
    shutil.which("coqc") is None or shutil.which("make") is None,
    reason="Coq is not here (Debian: apt install coq libcoq-bignums make)",
)


def test_nothing_is_left_to_believe_in_the_theory() -> None:
    sources = sorted(VERIFIED.glob("*.v"))
    assert len(sources) > 5
    for source in sources:
        assert not GAPS.search(source.read_text()), source.name


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the theory is built, once."""
    folder = tmp_path_factory.mktemp("verified")
    command = ["make", "-C", str(VERIFIED), f"BUILD={folder}"]
    subprocess.run(command, check=True, capture_output=True)
    return folder


def accepted(proof: Path, build: Path) -> subprocess.CompletedProcess[str]:
    """The build of the theorem of one file."""
    command = ["make", "-C", str(VERIFIED), f"BUILD={build}", f"FILE={proof}"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@needs_coq
@pytest.mark.coq
def test_coq_proves_the_theorem_of_a_clipped_funnel(build: Path) -> None:
    done = accepted(CLIPPED / "claim.proof.json", build)
    assert done.returncode == 0, done.stderr
    assert "accepted: " in done.stdout


def rho_raised(files: Files) -> None:
    """At one knot, by 0.1 %."""
    files[FUNNEL]["rho"][1] *= 1.001


def gain_lower(files: Files) -> None:
    """By half."""
    K = files[POLICY]["K"]
    files[POLICY]["K"] = [[[[g / 2 for g in row] for row in k] for k in ks] for ks in K]


def multiplier_sign(files: Files) -> None:
    """Of one piece."""
    mu = files[PROOF]["proof"]["pieces"][3]["mu"]
    for end in ("start", "end"):
        mu[end] = [-entry for entry in mu[end]]


def piece_missing(files: Files) -> None:
    """One mode of one part of time."""
    del files[PROOF]["proof"]["pieces"][7]


def limit_wider(files: Files) -> None:
    """The proof is about another clip."""
    files[POLICY]["limits"][0][2] *= 2


def goal_smaller(files: Files) -> None:
    """By 18 % in every direction."""
    goal = files[PROOF]["claim"]["goal"]
    goal["P"] = [[1.5 * entry for entry in row] for row in goal["P"]]


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize(
    "forge",
    [rho_raised, gain_lower, multiplier_sign, piece_missing, limit_wider, goal_smaller],
)
def test_both_kernels_refuse_a_forgery(
    forge: Callable[[Files], None], build: Path, tmp_path: Path
) -> None:
    names = {"claim.proof.json": PROOF, "vector_field.json": FIELD}
    names |= {"policy.json": POLICY, "funnel.json": FUNNEL}
    files = {new: json.loads((CLIPPED / old).read_text()) for old, new in names.items()}
    forge(files)
    bind(files)
    write(files, tmp_path)
    with pytest.raises(CertificateRejected):
        proofs.check(tmp_path / PROOF)
    done = accepted(tmp_path / PROOF, build)
    assert done.returncode != 0
    assert "theorem.v" in done.stderr, "refused by Coq, not before"
