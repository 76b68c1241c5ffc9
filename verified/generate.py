#!/usr/bin/env python3
"""Turn a proof file of version 2 into data for the second kernel, without deciding anything.

    python generate.py FILE.proof.json --coq OUT.v     a theorem for Coq about the file's numbers
    python generate.py FILE.proof.json --ask CHECKER   what the extracted checker says of these
                                                       numbers: status 0, 1; 3 is not covered

Untrusted: a theorem of Coq is about the numbers that it shows, whoever wrote them. printed.py
prints those back into the files before anything is said, and theorems.py holds every line to its
template. What the second kernel does not cover is told by name (NotCovered, status 3); what the
pages do not allow is refused (strict.py, status 1).
Standard library only.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import printed
import theorems
from problems import Composition, Funnel, Increments, NotCovered, Problem, Sampled, read
from strict import Refused
from terms import Coq, Writer


def coq(problem: Problem) -> str:
    """A file of Coq: the problem, the witness and the theorem."""
    to = Coq()
    writer = Writer(to)

    if isinstance(problem, Funnel):
        writer.problem(problem)
        to.named("proof", writer.witness(problem))
        if problem.held:
            writer.held(problem)
        return theorems.text("held" if problem.held else "funnel", to.lines)

    if isinstance(problem, Composition):
        writer.composition(problem)
        return theorems.text("composed", to.lines)

    if isinstance(problem, Sampled):
        writer.sampled(problem)
        to.named("proof", writer.links(problem.proof))
        return theorems.text("sampled", to.lines)

    to.named("data", writer.model(problem.model))
    if problem.boxed:
        raise Refused("a box of a model that needs none")
    if problem.tubes is None:
        to.named("storage : matrix", writer.symmetric(problem.P, "P"))
        to.named("rate : num", writer.num(problem.rate))
        to.named("proof", writer.tree(problem.trees[0], 1))
        return theorems.text("stability", to.lines)

    to.named("tubes", to.listed(map(writer.tube, problem.tubes)))
    to.named("proofs", to.listed(trees(writer, problem)))
    if problem.policy is None:
        return theorems.text("tube", to.lines)

    names = ("a : list num", "b : list num", "b0 : num", "c : num", "feedback : list num")
    for name, term in zip(names, writer.plan(problem), strict=True):
        to.named(name, term)
    return theorems.text("plan", to.lines)


def trees(writer: Writer, problem: Increments) -> list[str]:
    """The multipliers of every tube."""
    assert problem.tubes is not None
    pairs = zip(problem.tubes, problem.trees, strict=True)
    return [writer.tree(tree, 1 + len(tube["tau"])) for tube, tree in pairs]


ASKED = {
    "held": "field policy funnel goal period errors proof rates turns",
    "funnel": "field policy funnel goal proof",
    "plan": "data tubes proofs a b b0 feedback",
    "tube": "data tubes proofs",
    "stability": "data storage rate proof",
    "sampled": "model policy funnel proof",
    "composed": "stages proofs multipliers",
}


def words(terms: dict[str, Any]) -> str:
    """The terms of a theorem for the extracted checker, which a word tells what they are about."""
    kind = next(kind for kind, names in ASKED.items() if set(names.split()) <= set(terms))
    return " ".join([kind, *(printed.words(terms[name]) for name in ASKED[kind].split())]) + "\n"


def compared(problem: Problem, text: str) -> dict[str, Any]:
    """The terms of the theorem, which print as the files that it was made of."""
    terms = printed.read(text)
    write = {
        Funnel: printed.funnel,
        Increments: printed.near,
        Sampled: printed.sampled,
        Composition: printed.composed,
    }[type(problem)]
    printed.differences(write(terms, problem.files), problem.files)
    return terms


def asked(checker: Path, terms: dict[str, Any]) -> int:
    """The extracted checker's status: 0 accepted, 1 refused."""
    with tempfile.NamedTemporaryFile("w", suffix=".words") as file:
        file.write(words(terms))
        file.flush()
        return subprocess.run(
            [checker, file.name], check=False, stdout=subprocess.DEVNULL
        ).returncode


def decided(file: Path, out: Path | None = None, checker: Path | None = None) -> tuple[int, str]:
    """The status for a proof file, and why where it is not 0: 1 refused, 3 not covered.

    out: where the theorem is written. checker: the extracted one, which is asked.
    """
    try:
        problem = read(file)
        text = coq(problem)
        terms = compared(problem, text)
    except Refused as error:
        return 1, f"refused: {error}"
    except printed.Differs as error:
        return 3, f"not covered: not written as the theorem prints it: {error}"
    except (NotCovered, KeyError, ValueError, TypeError, IndexError) as error:
        said = error if isinstance(error, NotCovered) else f"{type(error).__name__} {error}"
        return 3, f"not covered: {said}"
    if out is not None:
        out.write_text(text)
    return (0 if checker is None else asked(checker, terms)), ""


FAILED = 4  # status: nothing was decided


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--coq", type=Path)
    parser.add_argument("--ask", type=Path, metavar="CHECKER")
    given = parser.parse_args()
    try:
        status, said = decided(given.file, given.coq, given.ask)
    except Exception as error:
        print(f"failed: {type(error).__name__}: {error}", file=sys.stderr)
        return FAILED
    if said:
        print(said, file=sys.stderr)
    elif given.ask is not None:
        print("refused" if status else "accepted")
    return status


if __name__ == "__main__":
    sys.exit(main())
