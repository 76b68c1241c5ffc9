"""A pytest plugin: keeps every proof that the first kernel decides in a session, with what it said.

    RECORDED=FOLDER python -m pytest -p tests.core.verified.recorded tests/...

Each lies in a folder of its own, named by its content, with the files that it is about; `said`
beside them is "proved" or the refusal. `benchmarks.verified --forgeries` asks the second kernel.
"""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nlsid_core import files, kernel, proofs
from nlsid_core.errors import CertificateMismatch, CertificateRejected

PROOF, SAID = "claim.proof.json", "said"
MOST = 10_000_000  # bytes of the files of one


def keep(contents: Mapping[str, bytes], said: str) -> None:
    """The proof and its files by name, in a folder."""
    if sum(map(len, contents.values())) > MOST:
        return
    name = hashlib.sha256(repr(sorted(contents.items())).encode()).hexdigest()[:16]
    folder = Path(os.environ["RECORDED"]) / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in contents.items():
        if Path(file).name == file:
            (folder / file).write_bytes(content)
    (folder / SAID).write_text(said)


def recorded(decided: Any, contents: Any) -> Any:
    """The function, whose verdicts are kept with the contents of what they are about."""

    def record(*given: Any) -> Any:
        try:
            verdict = decided(*given)
        except (kernel.Rejected, CertificateMismatch, CertificateRejected) as refusal:
            keep(contents(*given), f"{type(refusal).__name__}: {refusal}")
            raise
        keep(contents(*given), "proved")
        return verdict

    return record


def in_memory(document: Any, about: Mapping[str, Any]) -> dict[str, bytes]:
    """What `proofs.decide` is given."""
    given = {**about, PROOF: document}
    return {
        name: content if isinstance(content, bytes) else files.encode(content)
        for name, content in given.items()
    }


def in_folder(path: Path | str) -> dict[str, bytes]:
    """What `kernel.check` finds beside a proof."""
    beside = {file.name: file.read_bytes() for file in Path(path).parent.glob("*.json")}
    return {**beside, PROOF: Path(path).read_bytes()}


proofs.decide = recorded(proofs.decide, in_memory)
kernel.check = recorded(kernel.check, in_folder)
