"""`check`: a proof file in, a verdict out, or `Rejected` with the reason."""

import os
import stat
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from .files import (
    MAX_BYTES,
    MAX_TOTAL,
    Node,
    Read,
    Rejected,
    digest,
    limit,
    parse,
    plain,
    refuse_if,
)
from .text import Verdict

# Each claim is a module of this package with a function `decide(claim, proof, read) -> Verdict`.
KINDS = (
    "stability",
    "stable_set",
    "tube",
    "sampled_funnel",
    "continuous_funnel",
    "funnel_composition",
)
# Kinds of version 2 that are not decided any more.
LEFT = (
    "dissipation",
    "small_gain",
    "hybrid_funnel",
    "polynomial_bound",
    "region_of_attraction",
    "falsification",
)

# Why a proof is refused: the code of each "no".
REASONS = {
    "malformed": "a file is not as its page says",
    "too_large": "a stated limit on sizes is exceeded, or memory",
    "too_long": "it takes more processor time than is allowed",
    "mismatch": "a file is not the one that the proof is about",
    "unknown": "the kind of claim is not known",
    "left": "the kind of claim, or the version of the file, is not decided any more",
    "not_definite": "a matrix is not positive definite, or semidefinite",
    "not_positive": "a polynomial is not shown to be positive",
    "not_below": "a number exceeds its bound",
    "not_covered": "a piece, a vertex or a mode is missing",
    "not_valid": "the claim leaves where its model or equations hold",
    "not_decided": "the kernel met what it did not expect",
}


def check(path: str | os.PathLike[str]) -> Verdict:
    """Decide the proof file at `path` about the files beside it.

    Raises Rejected with the reason.
    OSError if `path` itself cannot be read.
    """
    return decide(read_regular(Path(path)), lambda name: read_regular(Path(path).parent / name))


def read_regular(path: Path) -> bytes:
    """A regular file's bytes; OSError for anything else, Rejected if it is too large."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(handle, "rb") as stream:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(0, "not a regular file", str(path))
        content = stream.read(MAX_BYTES + 1)
    limit(len(content), MAX_BYTES, f"{plain(path.name)}: bytes")
    return content


def decide(content: bytes, read: Read) -> Verdict:
    """Decide a proof's bytes; `read` gives those of the files it names. Raises Rejected."""
    sizes, files = [len(content)], {}

    def limited(name: str) -> bytes:
        found = read(name)
        sizes.append(len(found))
        limit(sum(sizes), MAX_TOTAL, "bytes of all files of the claim")
        files[name] = digest(found)
        return found

    try:
        verdict = _decided(parse(content, "proof file"), limited)
    except Rejected:
        raise
    except (RecursionError, MemoryError) as error:
        much = f"the proof takes too much memory to decide ({type(error).__name__})"
        raise Rejected(much, "too_large") from error
    except Exception as error:
        unexpected = f"not decided: {type(error).__name__}: {plain(str(error))}"
        raise Rejected(unexpected, "not_decided") from error
    return replace(verdict, digests={**verdict.digests, "proof": digest(content)}, files=files)


def _decided(document: Node, read: Read) -> Verdict:
    refuse_if(
        document.value.get("version") == 1,
        "version 1 left; make the proof again, by what wrote it",
        "left",
    )
    parts = document.document("proof", {"claim": None, "proof": None})
    kind = parts["claim"].kind()
    refuse_if(kind in LEFT, f"kind {kind} left with version 0.3", "left")
    refuse_if(kind not in KINDS, f"claim {kind!r} is unknown; known: {', '.join(KINDS)}", "unknown")
    refuse_if(
        kind == "continuous_funnel" and "decay" in parts["claim"].value,
        f"decay, of a {kind}, left with version 0.3",
        "left",
    )
    decide_claim: Any = import_module(f".{kind}", __package__).decide
    verdict: Verdict = decide_claim(parts["claim"], parts["proof"], read)
    return replace(verdict, kind=kind)
