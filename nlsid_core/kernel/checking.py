"""`check`: a proof file in, a verdict out, or `Rejected` with the reason."""

import os
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from .files import (
    MAX_TOTAL,
    Node,
    Read,
    Rejected,
    digest,
    itself,
    limit,
    parse,
    plain,
    read_regular,
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


def check(path: str | os.PathLike[str]) -> Verdict:
    """Decide the proof file at `path` about the files beside it.

    Raises Rejected with the reason.
    OSError if `path` itself cannot be read.
    """
    folder = Path(path).parent
    return decide(read_regular(Path(path)), lambda name: read_regular(folder / name))


def decide(content: bytes, read: Read) -> Verdict:
    """Decide a proof's bytes; `read` gives those of the files it names. Raises Rejected."""
    total, files = len(content), {}

    def limited(name: str) -> bytes:
        nonlocal total
        found = read(name)
        total = limit(total + len(found), MAX_TOTAL, "bytes of all files of the claim")
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
    former = document.value.get("version") == 1
    refuse_if(former, "version 1 left; make the proof again, by what wrote it", "left")
    parts = document.document("proof", {"claim": itself, "proof": itself})
    kind = parts["claim"].kind()
    refuse_if(kind in LEFT, f"kind {kind} left with version 0.3", "left")
    refuse_if(kind not in KINDS, f"claim {kind!r} is unknown; known: {', '.join(KINDS)}", "unknown")
    former = kind == "continuous_funnel" and "decay" in parts["claim"].value
    refuse_if(former, f"decay, of a {kind}, left with version 0.3", "left")
    decide_claim: Any = import_module(f".{kind}", __package__).decide
    verdict: Verdict = decide_claim(parts["claim"], parts["proof"], read)
    return replace(verdict, kind=kind)
