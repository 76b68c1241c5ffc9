"""`check`: a proof file in, a verdict out, or `Rejected` with the reason."""

import os
from dataclasses import dataclass, field
from fractions import Fraction
from importlib import import_module
from pathlib import Path

from . import text
from .decision import Decision
from .files import MAX_TOTAL, Node, Read, Rejected, digest, parse, plain, read_regular, refuse_if

# Each claim is a module of this package with a function `decide(claim, proof, read) -> Decision`.
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
LEFT_WITH = "left with version 0.3"


@dataclass(frozen=True)
class Verdict:
    """What is proved: it exists only for a claim that was decided.

    statement: one sentence. margin: how much room the proof has, in the unit that the kind states;
    rounded down when printed. assumptions: what the statement rests on and the kernel cannot know.
    digests: by role, of the files that it is about, and of the proof itself (role `proof`). files:
    the digests by name of all that was read beside the proof.
    """

    kind: str
    statement: str
    margin: Fraction
    assumptions: tuple[str, ...] = ()
    digests: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        lines = [f"PROVED {self.statement}, margin {text.below(self.margin)}"]
        return "\n".join(lines + [f"  assuming {assumption}" for assumption in self.assumptions])


def check(path: str | os.PathLike[str]) -> Verdict:
    """Decide the proof file at `path` about the files beside it.

    Raises Rejected with the reason (Mismatch if a file is not the one that the proof is about).
    OSError if `path` itself cannot be read.
    """
    folder = Path(path).parent
    return decide(read_regular(Path(path)), lambda name: read_regular(folder / name))


def decide(content: bytes, read: Read) -> Verdict:
    """Decide a proof's bytes; `read` gives those of the files it names. Raises Rejected."""
    left, files = MAX_TOTAL - len(content), {}

    def limited(name: str) -> bytes:
        nonlocal left
        found = read(name)
        left -= len(found)
        refuse_if(
            left < 0, f"the files of one claim have at most {MAX_TOTAL} bytes together", "too_large"
        )
        files[name] = digest(found)
        return found

    try:
        document = parse(content, "proof file")
        _refuse_former(document)
        parts = document.document("proof", "claim proof")
        kind = parts["claim"].kind()
        decided = _decided(kind, parts["claim"], parts["proof"], limited)
    except Rejected:
        raise
    except (RecursionError, MemoryError) as error:
        much = f"the proof takes too much memory to decide ({type(error).__name__})"
        raise Rejected(much, "too_large") from error
    except Exception as error:
        unexpected = f"not decided: {type(error).__name__}: {plain(str(error))}"
        raise Rejected(unexpected, "not_decided") from error
    digests = {**decided.digests, "proof": digest(content)}
    return Verdict(kind, decided.statement, decided.margin, decided.assumptions, digests, files)


def _decided(kind: str, claim: Node, proof: Node, read: Read) -> Decision:
    refuse_if(kind in LEFT, f"kind {kind} {LEFT_WITH}", "left")
    refuse_if(kind not in KINDS, f"claim {kind!r} is unknown; known: {', '.join(KINDS)}", "unknown")
    refuse_if(
        type(claim.value) is dict and kind == "continuous_funnel" and "decay" in claim.value,
        f"decay, a member of a {kind}'s claim, {LEFT_WITH}",
        "left",
    )
    decision: Decision = import_module(f".{kind}", __package__).decide(claim, proof, read)
    return decision


def _refuse_former(document: Node) -> None:
    if type(document.value) is dict and document.value.get("version") == 1:
        again = "make it again, by the command that wrote it"
        raise Rejected(f"a proof of version 1 is not decided any more; {again}", "left")
