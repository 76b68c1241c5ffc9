#!/usr/bin/env python3
"""Turn a proof file of version 2 into data for the second kernel, without deciding anything.

    python generate.py FILE.proof.json --coq OUT.v     a theorem for Coq about the file's numbers
    python generate.py FILE.proof.json --ask CHECKER   what the extracted checker says of these
                                                       numbers: status 0, 1; 3 is not covered

Untrusted: a theorem of Coq is about the numbers that it shows, whoever wrote them, and printed.py
prints those back into the files before anything is said. What the second kernel does not cover is
told by name (NotCovered, status 3); what the pages do not allow is refused (strict.py, status 1).
Standard library only.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import printed
from problems import Composition, Funnel, Increments, NotCovered, Problem, Sampled, read
from strict import Refused
from terms import Coq, Writer

THEOREM = """\
Definition data := stated field policy funnel goal decay.
Theorem accepted : files_ok field policy funnel goal decay proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem funnel_stays : forall x, solution data x ->
  forall ta, (begin data <= ta <= finish data)%R -> inside data x ta ->
  (forall t, (ta <= t <= finish data)%R -> inside data x t /\\ in_bounds data x t) /\\
  in_goal data x /\\ decays data x ta.
Proof. exact (funnel_theorem field policy funnel goal decay proof accepted). Qed.
Print Assumptions funnel_stays.
"""
HELD = """\
Definition data := stated field policy funnel goal decay.
Theorem accepted :
  held_files_ok field policy funnel goal decay period errors proof rates turns = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem held_stays : forall since x u, held_solution data period errors since x u ->
  (begin data <= since <= finish data)%R -> inside data x since ->
  (forall t, (since <= t <= finish data)%R -> inside data x t /\\ held_in_bounds data x u t) /\\
  in_goal data x /\\ decays data x since.
Proof.
  exact (held_theorem field policy funnel goal decay period errors proof rates turns accepted).
Qed.
Print Assumptions held_stays.
"""
NEAR = """\
Theorem accepted : tubes_ok data tubes proofs = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem near : Forall (stays_near data) tubes.
Proof. exact (tubes_proved data tubes proofs accepted). Qed.
Print Assumptions near.
"""
PLANNED = """\
Theorem planned : forallb (plan_ok a b b0 feedback) tubes = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem near_plan : Forall (stays_near_plan a b b0 c feedback) tubes.
Proof. exact (plans_proved a b b0 c feedback tubes planned). Qed.
Print Assumptions near_plan.
"""
COMPOSED = """\
Theorem accepted : composed_ok stages proofs multipliers = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem follow : composed (map stated_by stages).
Proof. exact (composed_theorem stages proofs multipliers accepted). Qed.
Print Assumptions follow.
"""
SAMPLED = """\
Theorem accepted : sampled_ok model policy funnel proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem stays : stays_in_tube model policy funnel /\\ arrives_from_inlet model policy funnel.
Proof. exact (sampled_theorem model policy funnel proof accepted). Qed.
Print Assumptions stays.
"""
STABLE = """\
Theorem accepted : stability_ok data storage rate proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem stable : forgets data storage rate.
Proof. exact (stability_proved data storage rate proof accepted). Qed.
Print Assumptions stable.
"""


def coq(problem: Problem) -> str:
    """A file of Coq: the problem, the witness and the theorem."""
    if isinstance(problem, Funnel):
        modules = "Turning Held " if problem.held else ""
        to = Coq(f"Integers Forms Polynomials Positive Claim Funnel Goal Files {modules}Data")
        writer = Writer(to)
        writer.problem(problem)
        to.named("proof", writer.witness(problem))
        if problem.held:
            writer.held(problem)
            return "\n".join(to.lines) + "\n" + HELD
        return "\n".join(to.lines) + "\n" + THEOREM
    if isinstance(problem, Composition):
        to = Coq("Integers Forms Polynomials Positive Claim Funnel Goal Files Composed Data")
        Writer(to).composition(problem)
        return "\n".join(to.lines) + "\n" + COMPOSED
    if isinstance(problem, Sampled):
        to = Coq("Integers Forms Polynomials Positive Claim Tubes Samples Steps Stepwise Data")
        writer = Writer(to)
        writer.sampled(problem)
        to.named("proof", writer.links(problem.proof))
        return "\n".join(to.lines) + "\n" + SAMPLED
    to = Coq("Integers Forms Claim Data Tubes Boxes Near Driven")
    writer = Writer(to)
    to.named("data", writer.model(problem.model))
    if problem.boxed:
        raise Refused("a box of a model that needs none")
    if problem.tubes is None:
        to.named("storage : matrix", writer.symmetric(problem.P, "P"))
        to.named("rate : num", writer.num(problem.rate))
        to.named("proof", writer.tree(problem.trees[0], 1))
        return "\n".join(to.lines) + "\n" + STABLE
    to.named("tubes", to.listed(map(writer.tube, problem.tubes)))
    to.named("proofs", to.listed(trees(writer, problem)))
    if problem.policy is None:
        return "\n".join(to.lines) + "\n" + NEAR
    names = ("a : list num", "b : list num", "b0 : num", "c : num", "feedback : list num")
    for name, term in zip(names, writer.plan(problem), strict=True):
        to.named(name, term)
    return "\n".join(to.lines) + "\n" + NEAR + PLANNED


def trees(writer: Writer, problem: Increments) -> list[str]:
    """The multipliers of every tube."""
    assert problem.tubes is not None
    pairs = zip(problem.tubes, problem.trees, strict=True)
    return [writer.tree(tree, 1 + len(tube["tau"])) for tube, tree in pairs]


ASKED = {
    "held": "field policy funnel goal decay period errors proof rates turns",
    "funnel": "field policy funnel goal decay proof",
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
        Funnel: printed.funnel, Increments: printed.near, Sampled: printed.sampled,
        Composition: printed.composed,
    }[type(problem)]  # fmt: skip
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
