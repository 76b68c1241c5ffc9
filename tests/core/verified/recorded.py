"""A pytest plugin: keeps the files of every proof that a session asks the first kernel about.

    RECORDED=FOLDER python -m pytest -p tests.core.verified.recorded tests/...

Each proof lies in a folder of its own, named by its content, with the files that it is about.
`benchmarks.verified` asks both kernels about them.
"""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nlsid_core import files, kernel, proofs

FOLDER = "RECORDED"
PROOF = "claim.proof.json"
MOST = 10_000_000  # bytes of the files of one


def keep(contents: Mapping[str, bytes]) -> None:
    """The proof and its files by name, in a folder."""
    if sum(map(len, contents.values())) > MOST:
        return
    name = hashlib.sha256(repr(sorted(contents.items())).encode()).hexdigest()[:16]
    folder = Path(os.environ[FOLDER]) / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in contents.items():
        if Path(file).name == file:
            (folder / file).write_bytes(content)


def recorded(decided: Any, contents: Any) -> Any:
    """The function, which keeps the contents of what it decides."""

    def record(*given: Any) -> Any:
        keep(contents(*given))
        return decided(*given)

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


if FOLDER in os.environ:
    proofs.decide = recorded(proofs.decide, in_memory)
    kernel.check = recorded(kernel.check, in_folder)
