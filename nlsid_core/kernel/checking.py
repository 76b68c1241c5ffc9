"""`check`: a proof file in, a verdict out, or `Rejected` with the reason."""

import os
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass, field
from fractions import Fraction
from importlib import import_module
from pathlib import Path

from . import text
from .decision import Decision
from .exact import allow_elimination
from .files import MAX_TOTAL, Node, Read, Rejected, digest, parse, plain, read_regular

FORMAT = "nlsid/proof"
VERSION = 2
# Each claim is a module of this package with a function `decide(claim, proof, read) -> Decision`.
KINDS = (
    "stability",
    "tube",
    "stable_set",
    "sampled_funnel",
    "continuous_funnel",
    "funnel_composition",
    "polynomial_bound",
    "region_of_attraction",
)
# Kinds of version 1, and what makes their proofs again.
FORMER = {
    "incremental_stability": "nlsid identify",
    "state_affine_stability": "nlsid identify",
    "block_cascade_stability": "nlsid identify",
    "monotone_equation_stability": "nlsid identify",
    "implicit_stability": "nlsid identify",
    "well_posedness": "nlsid identify",
    "energy_tube": "nlsid funnel",
    "discrete_funnel": "nlsid track",
    "implicit_funnel": "nlsid track",
    "trajectory_funnel": "nlsid funnel --problem",
    "funnel_composition": "nlsid compose",
    "matrix_inequality": "the search that wrote it",
    "polynomial_bound": "the search that wrote it",
    "region_of_attraction": "the search that wrote it",
}


@dataclass(frozen=True)
class Verdict:
    """What is proved: it exists only for a claim that was decided.

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
    try:
        document = parse(content, "proof file")
        kind, claim, proof = opened(document)
        decision = copy_context().run(_decided, kind, claim, proof, _limited(read, content))
    except Rejected:
        raise
    except (RecursionError, MemoryError) as error:
        raise Rejected(
            f"the proof takes too much memory to decide ({type(error).__name__})"
        ) from error
    except Exception as error:
        raise Rejected(f"not decided: {type(error).__name__}: {plain(str(error))}") from error
    return Verdict(
        kind,
        decision.statement,
        decision.margin,
        decision.assumptions,
        {**decision.digests, "proof": digest(content)},
    )


def _limited(read: Read, proof: bytes) -> Read:
    """`read`, for files of MAX_TOTAL bytes together with the proof."""
    left = MAX_TOTAL - len(proof)

    def limited(name: str) -> bytes:
        nonlocal left
        content = read(name)
        left -= len(content)
        if left < 0:
            raise Rejected(f"the files of one claim have at most {MAX_TOTAL} bytes together")
        return content

    return limited


def _decided(kind: str, claim: Node, proof: Node, read: Read) -> Decision:
    allow_elimination()
    return _decider(kind)(claim, proof, read)


def opened(document: Node) -> tuple[str, Node, Node]:
    """The kind, claim and proof of a proof file."""
    if type(document.value) is dict and document.value.get("version") == 1:
        claim = document.value.get("claim")
        kind = claim.get("kind") if type(claim) is dict else None
        again = (
            FORMER.get(kind, "the command that wrote it")
            if type(kind) is str
            else "the command that wrote it"
        )
        raise Rejected(f"a proof of version 1 is not decided any more; make it again: {again}")
    parts = document.members("format version claim proof")
    if parts["format"].text() != FORMAT:
        raise Rejected(f"format is {parts['format'].text()!r}, expected {FORMAT!r}")
    version = parts["version"].whole(0)
    if version != VERSION:
        raise Rejected(f"version {version}; this kernel decides version {VERSION}")
    if type(parts["claim"].value) is not dict or "kind" not in parts["claim"].value:
        raise Rejected("the claim should be an object with a kind")
    kind = Node(parts["claim"].value["kind"], "kind").text()
    return kind, parts["claim"], parts["proof"]


def _decider(kind: str) -> Callable[[Node, Node, Read], Decision]:
    if kind not in KINDS:
        raise Rejected(f"claim {kind!r} is unknown; known: {', '.join(KINDS)}")
    module = import_module(f".{kind}", __package__)
    decider: Callable[[Node, Node, Read], Decision] = module.decide
    return decider
