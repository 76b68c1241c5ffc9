"""Time and memory end by the operating system, with a reason; no file chooses equal hashes."""

import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction

import pytest

from nlsid_core import files, kernel
from nlsid_core.deciding import KERNEL, Deciding, Limits
from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel.polynomials import Ring
from tests.core.kernel.hostile_claims import Claim, equal_hashes, network
from tests.core.kernel.mutations import CORPUS


def deciding(claim: Claim, limits: Limits) -> Deciding:
    document, about = claim
    contents = {name: files.encode(content) for name, content in about.items()}
    return Deciding.of(files.encode(document), contents, limits)


@pytest.mark.parametrize(
    ("made", "size", "limits", "reason"),
    [
        (network, 100, Limits(seconds=1), "more than 1 s of processor time"),
        (equal_hashes, 12, Limits(memory=60), "memory"),
    ],
)
def test_a_claim_that_takes_too_much_is_ended_with_the_reason(
    made: Callable[[int], Claim], size: int, limits: Limits, reason: str
) -> None:
    with pytest.raises(CertificateRejected, match=reason):
        deciding(made(size), limits).wait()


def test_lower_limits_of_the_system_stay_and_the_proof_is_decided() -> None:
    """It was no verdict but a traceback: a limit cannot be raised."""
    proof = CORPUS / "stability" / "linear" / "claim.proof.json"
    program = f"ulimit -t 15; ulimit -v 3000000; exec {sys.executable} -I {KERNEL} {proof}"
    found = subprocess.run(["sh", "-c", program], capture_output=True, text=True, check=False)
    assert ": PROVED " in found.stdout, found.stderr


def test_a_margin_too_long_to_be_read_is_rounded_down() -> None:
    for margin in (Fraction(1, 3), Fraction(1, 3**10_000)):
        shown = kernel.Verdict("it is so", margin, (), {}).short_margin
        assert len(shown) < 4300
        assert 0.999 * margin < Fraction(shown) <= margin


def test_monomials_that_a_file_chose_for_their_hashes_take_no_longer() -> None:
    """2^14 of them took 27 s, as all were in one place of a dictionary."""
    document, about = equal_hashes(9)
    with pytest.raises(kernel.Rejected) as refused:
        kernel.decide(files.encode(document), lambda name: files.encode(about[name]))
    assert refused.value.reason in kernel.REASONS
    ring = Ring(11, 64)
    packed = {ring.key([1] + [0] * 10), ring.key([0] * 10 + [2])}
    assert len({hash(key) for key in packed}) == 2
    assert {ring.exponents(key) for key in packed} == {(1, *[0] * 10), (*[0] * 10, 2)}


@pytest.mark.parametrize("kind", kernel.LEFT)
def test_a_kind_that_left_is_refused_by_name(kind: str) -> None:
    document = {"format": "nlsid/proof", "version": 2, "proof": {}, "claim": {"kind": kind}}
    with pytest.raises(kernel.Rejected, match=f"kind {kind} left with version 0.3") as refused:
        kernel.decide(files.encode(document), lambda _: b"")
    assert refused.value.reason == "left"
