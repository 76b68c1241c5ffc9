#!/usr/bin/env python3
"""What a generated file of Coq may hold, line by line, and what its theorems may assume.

    python theorems.py THEOREM.v                  holds it to its template; prints a file for Coq
                                                  that asks what its theorems assume
    python theorems.py THEOREM.v --assumed TEXT   holds Coq's answer to axioms.txt, word for word

Trusted: read this file and axioms.txt. The answer is asked for in a file of its own. Nothing of the
generated file is imported there, and every name and type is printed in full, without notations. So
no line of the generated file can change how the answer reads. Standard library only.
"""

import argparse
import re
import sys
from pathlib import Path

HEAD = """\
(* Made by generate.py. The theorem is about the numbers below. *)
From Coq Require Import ZArith Reals List Uint63.
From Verified Require Import {modules}.
Import ListNotations.
Open Scope Z_scope.
"""
THEOREM = """\
Definition data := stated field policy funnel goal.
Theorem accepted : files_ok field policy funnel goal proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem funnel_stays : forall x, solution data x ->
  forall ta, (begin data <= ta <= finish data)%R -> inside data x ta ->
  (forall t, (ta <= t <= finish data)%R -> inside data x t /\\ in_bounds data x t) /\\
  in_goal data x.
Proof. exact (funnel_theorem field policy funnel goal proof accepted). Qed.
"""
HELD = """\
Definition data := stated field policy funnel goal.
Theorem accepted :
  held_files_ok field policy funnel goal period errors proof rates turns = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem held_stays : forall since x u, held_solution data period errors since x u ->
  (begin data <= since <= finish data)%R -> inside data x since ->
  (forall t, (since <= t <= finish data)%R -> inside data x t /\\ held_in_bounds data x u t) /\\
  in_goal data x.
Proof.
  exact (held_theorem field policy funnel goal period errors proof rates turns accepted).
Qed.
"""
NEAR = """\
Theorem accepted : tubes_ok data tubes proofs = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem near : Forall (stays_near data) tubes.
Proof. exact (tubes_proved data tubes proofs accepted). Qed.
"""
PLANNED = """\
Theorem planned : forallb (plan_ok a b b0 feedback) tubes = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem near_plan : Forall (stays_near_plan a b b0 c feedback) tubes.
Proof. exact (plans_proved a b b0 c feedback tubes planned). Qed.
"""
COMPOSED = """\
Theorem accepted : composed_ok stages proofs multipliers = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem follow : composed (map stated_by stages).
Proof. exact (composed_theorem stages proofs multipliers accepted). Qed.
"""
SAMPLED = """\
Theorem accepted : sampled_ok model policy funnel proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem stays : stays_in_tube model policy funnel /\\ arrives_from_inlet model policy funnel.
Proof. exact (sampled_theorem model policy funnel proof accepted). Qed.
"""
STABLE = """\
Theorem accepted : stability_ok data storage rate proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem stable : forgets data storage rate.
Proof. exact (stability_proved data storage rate proof accepted). Qed.
"""
FLOWS = "Integers Forms Polynomials Positive Claim Funnel Goal Files"
MODELS = "Integers Forms Claim Data Tubes Boxes Near Driven"
STEPS = "Integers Forms Polynomials Positive Claim Tubes Samples Steps Stepwise Data"
# By kind: the modules that are imported, and the theorems.
KINDS = {
    "funnel": (f"{FLOWS} Data", THEOREM),
    "held": (f"{FLOWS} Turning Held Data", HELD),
    "composed": (f"{FLOWS} Composed Data", COMPOSED),
    "sampled": (STEPS, SAMPLED),
    "stability": (MODELS, STABLE),
    "tube": (MODELS, NEAR),
    "plan": (MODELS, NEAR + PLANNED),
}
# Definitions of numbers, one a line: a name, perhaps its type, and a term of numbers, lists, pairs
# and the constructors below.
NAMED = (
    "field|policy|funnel|goal|proof|period|errors|rates|turns|data|tubes|proofs|a|b|b0|c|"
    "feedback|stages|multipliers|model|storage|rate|"
    r"(?:span|feed|gain|nominal|shape|piece|turn|link)_\d+"
)
TYPED = (
    r"num|list num|list \(list num\)|matrix|"
    r"option \(list num \* list \(list num\)\)|list \(list rate_piece\)"
)
DEFINED = re.compile(rf"Definition ((?:stage\d+_)?(?:{NAMED}))(?: : (?:{TYPED}))? := (.+)\.")
TOKEN = re.compile(r"-?\d+|[A-Za-z_][A-Za-z_0-9]*|%(?:nat|positive|uint63)|[\[\]();,]| ")
CONSTRUCTORS = (
    "None Some true false Linear Affine Monotone Cells Broken Spline Leaf Split Ends Tube Map "
    "Track Sampled Response Peak Energy Fading Links Link Chain Field Policy Funnel Stage Witness "
    "Piece RatePiece big_mu word_squares"
)
ALLOWED = Path(__file__).with_name("axioms.txt")


class NotTemplate(Exception):  # noqa: N818 - says where a file is no theorem of the template
    """A line that the template does not have, or an assumption that axioms.txt does not have."""


def text(kind: str, definitions: list[str]) -> str:
    """The file of Coq for a kind of theorem about the numbers that are defined."""
    modules, theorem = KINDS[kind]
    return HEAD.format(modules=modules) + "".join(f"{line}\n" for line in definitions) + theorem


def proved(content: str) -> list[str]:
    """The names of the theorems of a file, of which every line is the template's.

    Raises:
        NotTemplate: at the first line that is not.
    """
    for modules, theorem in KINDS.values():
        head = HEAD.format(modules=modules)
        if content.startswith(head) and content.endswith("\n" + theorem):
            _hold_definitions(content[len(head) : -len(theorem)].removesuffix("\n").split("\n"))
            return re.findall(r"^Theorem (\w+)", theorem, re.MULTILINE)
    raise NotTemplate("the lines are not those of a theorem of this folder")


def _hold_definitions(lines: list[str]) -> None:
    known: set[str] = set()
    for line in lines:
        match = DEFINED.fullmatch(line)
        if match is None:
            raise NotTemplate(f"not a definition of numbers: {line[:60]}")
        name, term = match.groups()
        tokens = TOKEN.findall(term)
        words = {token for token in tokens if token[0].isalpha() or token[0] == "_"}
        if "".join(tokens) != term or words - set(CONSTRUCTORS.split()) - known:
            raise NotTemplate(f"{name} is not made of numbers")
        known.add(name)


def question(names: list[str], module: str) -> str:
    """The file of Coq that asks what theorems assume, with every name and type in full."""
    asked = "".join(f"Print Assumptions {module}.{name}.\n" for name in names)
    return f"Set Printing All.\nSet Printing Width 1000.\nRequire {module}.\n{asked}"


def assumptions(answer: str) -> list[str]:
    """Each assumption of Coq's answers, with its type; lines that go on belong to the one above."""
    found: list[str] = []
    for line in answer.splitlines():
        if line.startswith(" ") and found:
            found[-1] += " " + line.strip()
        elif line not in ("Axioms:", "Closed under the global context"):
            found.append(line)
    return found


def hold_assumptions(answer: str, theorems: int) -> None:
    """Refuse an answer that is not made of lines of axioms.txt, whole, one answer a theorem.

    Raises:
        NotTemplate: naming the first that is none.
    """
    begun = len(re.findall("^(?:Axioms:|Closed under the global context)$", answer, re.MULTILINE))
    if begun != theorems:
        raise NotTemplate(f"Coq answered {begun} questions of {theorems}")
    allowed = set(assumptions(ALLOWED.read_text()))
    for assumed in assumptions(answer):
        if assumed not in allowed:
            raise NotTemplate(f"the theorem assumes {assumed}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("theorem", type=Path)
    parser.add_argument("--assumed", type=Path, metavar="TEXT")
    given = parser.parse_args()
    try:
        names = proved(given.theorem.read_text())
        if given.assumed is None:
            print(question(names, given.theorem.stem), end="")
        else:
            hold_assumptions(given.assumed.read_text(), len(names))
    except NotTemplate as error:
        print(f"refused: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
