"""`check`: a proof file in, a verdict out, or `Rejected` with the reason."""

import os
from contextvars import copy_context
from dataclasses import dataclass, field
from fractions import Fraction
from importlib import import_module
from pathlib import Path

from . import text
from .decision import Decision
from .exact import allow_elimination
from .files import MAX_TOTAL, Node, Read, Rejected, digest, parse, plain, read_regular

# Each claim is a module of this package with a function `decide(claim, proof, read) -> Decision`.
KINDS = (
    "stability",
    "dissipation",
    "small_gain",
    "tube",
    "stable_set",
    "sampled_funnel",
    "continuous_funnel",
    "funnel_composition",
    "hybrid_funnel",
    "polynomial_bound",
    "region_of_attraction",
    "falsification",
)
# What makes proofs again whose kinds, of version 1, are not decided any more.
FORMER = {
    "nlsid identify": "incremental_stability state_affine_stability block_cascade_stability "
    "monotone_equation_stability implicit_stability well_posedness",
    "nlsid funnel": "energy_tube",
    "nlsid funnel of a motion": "discrete_funnel implicit_funnel",
    "nlsid funnel --problem": "trajectory_funnel",
    "nlsid funnel --compose": "funnel_composition",
    "the search that wrote it": "matrix_inequality polynomial_bound region_of_attraction",
}


@dataclass(frozen=True)
class Verdict:
    """What is proved, or proved to be false: it exists only for a claim that was decided.

    statement: one sentence. margin: how much room the proof has, in the unit that the kind states;
    rounded down when printed. assumptions: what the statement rests on and the kernel cannot know.
    digests: of the files that it is about, and of the proof itself (role `proof`).
    """

    kind: str
    statement: str
    margin: Fraction
    assumptions: tuple[str, ...] = ()
    digests: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        word = "FALSIFIED" if self.kind == "falsification" else "PROVED"
        lines = [f"{word} {self.statement}, margin {text.below(self.margin)}"]
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
    left = MAX_TOTAL - len(content)

    def limited(name: str) -> bytes:
        nonlocal left
        found = read(name)
        left -= len(found)
        if left < 0:
            raise Rejected(f"the files of one claim have at most {MAX_TOTAL} bytes together")
        return found

    try:
        document = parse(content, "proof file")
        _refuse_former(document)
        parts = document.document("proof", "claim proof")
        kind = parts["claim"].kind()
        decided = copy_context().run(_decided, kind, parts["claim"], parts["proof"], limited)
    except Rejected:
        raise
    except (RecursionError, MemoryError) as error:
        raise Rejected(
            f"the proof takes too much memory to decide ({type(error).__name__})"
        ) from error
    except Exception as error:
        raise Rejected(f"not decided: {type(error).__name__}: {plain(str(error))}") from error
    digests = {**decided.digests, "proof": digest(content)}
    return Verdict(kind, decided.statement, decided.margin, decided.assumptions, digests)


def _decided(kind: str, claim: Node, proof: Node, read: Read) -> Decision:
    if kind not in KINDS:
        raise Rejected(f"claim {kind!r} is unknown; known: {', '.join(KINDS)}")
    allow_elimination()
    decision: Decision = import_module(f".{kind}", __package__).decide(claim, proof, read)
    return decision


def _refuse_former(document: Node) -> None:
    if type(document.value) is dict and document.value.get("version") == 1:
        claim = document.value.get("claim")
        kind = claim.get("kind") if type(claim) is dict else None
        again = (command for command, kinds in FORMER.items() if kind in kinds.split())
        how = next(again, "the command that wrote it")
        raise Rejected(f"a proof of version 1 is not decided any more; make it again: {how}")
