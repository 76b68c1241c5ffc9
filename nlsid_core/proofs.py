"""Proof documents, and `check`: the kernel's verdict with this project's errors.

The kernel decides; nothing here does. Source of the format: docs/certificate.md.
"""

from collections.abc import Mapping
from pathlib import Path

from nlsid_core import files, kernel
from nlsid_core.arrays import Json
from nlsid_core.deciding import Deciding, as_ours
from nlsid_core.kernel import Verdict

__all__ = ["Verdict", "binding", "check", "decide", "proof_document"]

FORMAT = "nlsid/proof"


def check(path: Path | str) -> Verdict:
    """Decide the proof file at `path` about the files beside it, in a process with limits.

    Returns a Verdict if, and only if, the claim is proved. Raises CertificateMismatch if a file
    is not the one that the proof is about, CertificateRejected with the reason if the proof is
    damaged, incomplete or does not prove its claim. OS errors for `path` itself pass through.
    """
    return Deciding(Path(path)).wait()


def decide(document: Json | bytes, about: Mapping[str, Json | bytes]) -> Verdict:
    """`check` for a proof in memory; `about`: documents or bytes by the file names it binds."""

    def content_of(given: Json | bytes) -> bytes:
        return given if isinstance(given, bytes) else files.encode(given)

    def read(name: str) -> bytes:
        if name not in about:
            raise FileNotFoundError(2, "not given", name)
        return content_of(about[name])

    try:
        return kernel.decide(content_of(document), read)
    except kernel.Rejected as refusal:
        raise as_ours(str(refusal), refusal.reason) from refusal


def proof_document(claim: Json, proof: Json) -> Json:
    """The content of a proof file."""
    return {"format": FORMAT, "version": files.VERSION, "claim": claim, "proof": proof}


def binding(name: str, document: Json) -> Json:
    """How a claim names a file: its plain name, and the digest of its bytes."""
    return {"file": name, "digest": files.digest(document)}
