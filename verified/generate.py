#!/usr/bin/env python3
"""Turn a proof file of version 2 into data for the second kernel, without deciding anything.

    python generate.py FILE.proof.json --coq OUT.v     a theorem for Coq about the file's numbers

Untrusted: a theorem of Coq is about the numbers that it shows, whoever wrote them. What the second
kernel does not cover is refused by name (NotCovered). Standard library only.
"""

import argparse
import hashlib
import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

WORD = 2**61  # rows of factors are machine words in Coq


class NotCovered(Exception):  # noqa: N818 - says what the second kernel does not decide
    """What the file has and the second kernel does not cover; or what is wrong with the file."""


class Problem:
    """The numbers of a continuous funnel: what the theorem is about, and its witness."""

    def __init__(self, path: Path) -> None:
        document = _load(path.read_bytes(), path.name)
        claim, proof = document["claim"], document["proof"]
        kind = claim["kind"]
        if kind != "continuous_funnel":
            raise NotCovered(f"claims of kind {kind} are not covered by the second kernel")
        _only(claim, "kind about", "goal")
        files, self.digests = _bound(claim["about"], path.parent)
        self.field, self.policy, self.funnel = files
        required = "margin basis multiplier pieces"
        _only(proof, required, "goal_multiplier sides kappa")
        if "kappa" in proof:
            raise NotCovered("kappa is not covered by the second kernel")
        self.claim, self.proof = claim, proof
        field, policy, funnel = files
        _only(field, "format version states inputs uncertain breaks valid expansion pieces")
        _only(policy, "format version kind vector_field t x u K limits")
        _only(funnel, "format version kind vector_field policy t x P rho")
        if policy["t"] != funnel["t"] or policy["x"] != funnel["x"]:
            raise NotCovered("the funnel is around another nominal than the policy's")
        self.spans = [sum(at <= start for at in field["breaks"]) for start in funnel["t"][:-1]]
        t = funnel["t"]
        if any(t[0] < at < t[-1] and at not in t for at in field["breaks"]):
            raise NotCovered("the dynamics change at a time that is no knot")
        rows = policy["limits"]
        if [row[0] for row in rows] != sorted({row[0] for row in rows}):
            raise NotCovered("limits that are not sorted by input")


def _load(content: bytes, name: str) -> Any:
    def members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise NotCovered(f"{name}: a member occurs twice")
        return dict(pairs)

    try:
        document = json.loads(content, object_pairs_hook=members)
    except ValueError as error:
        raise NotCovered(f"{name} is not JSON: {error}") from error
    if type(document) is not dict or document.get("version") != 2:
        raise NotCovered(f"{name} is not of version 2")
    return document


def _only(members: dict[str, Any], required: str, optional: str = "") -> None:
    """Raise NotCovered unless the members are those, and no others."""
    missing = set(required.split()) - set(members)
    unknown = set(members) - set(required.split()) - set(optional.split())
    if missing:
        raise NotCovered(f"missing: {', '.join(sorted(missing))}")
    if unknown:
        raise NotCovered(f"not covered by the second kernel: {', '.join(sorted(unknown))}")


def _bound(about: dict[str, Any], folder: Path) -> tuple[list[Any], dict[str, str]]:
    """The vector field, the policy and the funnel, by digests of their bytes."""
    _only(about, "vector_field policy funnel")
    files, digests = [], {}
    for role in ("vector_field", "policy", "funnel"):
        name = about[role]["file"]
        if not name or any(sign in name for sign in "/\\:"):
            raise NotCovered(f"{name!r} is not a plain file name")
        content = (folder / name).read_bytes()
        digests[role] = "sha256:" + hashlib.sha256(content).hexdigest()
        if digests[role] != about[role]["digest"]:
            raise NotCovered(f"{name} is not the file that the proof is about")
        files.append(_load(content, name))
    if any(file["vector_field"] != digests["vector_field"] for file in files[1:]):
        raise NotCovered("a file names another vector field")
    if files[2]["policy"] != digests["policy"]:
        raise NotCovered("the funnel names another policy")
    return files, digests


def number(value: Any) -> Fraction:
    """The exact value of a number of a file."""
    if type(value) is bool or not isinstance(value, int | float | str):
        raise NotCovered(f"{value!r} is not a number")
    return Fraction(value)


# Coq.


def num(value: Any) -> str:
    """A fraction of Claim.v."""
    fraction = number(value)
    return f"({fraction.numerator}, {fraction.denominator}%positive)"


def listed(entries: Any) -> str:
    """A list of Coq."""
    return "[" + "; ".join(entries) + "]"


def monomial(row: list[int]) -> str:
    """A monomial of x as the list of its variables."""
    return listed(f"{i + 1}%positive" for i, e in enumerate(row) for _ in range(e))


def upper(P: list[list[Any]], what: str) -> str:
    """The upper triangle of a symmetric matrix."""
    if any(number(P[i][j]) != number(P[j][i]) for i in range(len(P)) for j in range(i)):
        raise NotCovered(f"{what} is not symmetric")
    return listed(listed(num(e) for e in row[i:]) for i, row in enumerate(P))


def word(value: int) -> str:
    """A whole number as a machine word: twice its size, plus one if it is negative."""
    if type(value) is not int or abs(value) >= WORD:
        raise NotCovered("a factor has an entry of more than 61 bits")
    return str(2 * value if value >= 0 else -2 * value + 1)


def squares(stated: dict[str, Any]) -> str:
    """The factors of a witness: [word_squares] of Data.v."""
    _only(stated, "unit factors", "scale weights")
    factors = []
    for factor in stated["factors"]:
        weights = stated.get("weights", [1] * len(factor))
        if len(weights) != len(factor):
            raise NotCovered("one weight for each row of each factor")
        rows = zip(weights, factor, strict=True)
        factors.append(listed(f"({int(w)}, {listed(map(word, row))}%uint63)" for w, row in rows))
    return f"(word_squares {stated['unit']} {int(stated.get('scale', 1))} {listed(factors)})"


def coq(problem: Problem) -> str:
    """The file with the problem, the witness and the theorem."""
    field, policy, funnel = problem.field, problem.policy, problem.funnel
    proof, claim = problem.proof, problem.claim
    n, m = field["states"], field["inputs"]
    limits: list[str] = ["None"] * m
    for i, low, high in policy["limits"]:
        limits[int(i)] = f"Some ({num(low)}, {num(high)})"
    box = [f"({num(low)}, {num(high)})" for low, high in field["uncertain"]]
    out = [
        "(* Made by generate.py. The theorem is about the numbers below. *)",
        "From Coq Require Import ZArith Reals List Uint63.",
        "From Verified Require Import Integers Forms Polynomials Positive Claim Funnel Goal Data.",
        "Import ListNotations.",
        "Open Scope Z_scope.",
    ]
    for k, (t, P, rho) in enumerate(zip(funnel["t"], funnel["P"], funnel["rho"], strict=True)):
        out.append(f"Definition knot_{k} := Knot {num(t)} {upper(P, f'P at knot {k}')} {num(rho)}.")
    for span, piece in enumerate(field["pieces"]):
        equations = [
            listed(
                f"({listed(f'{e}%nat' for e in row)}, {num(c)})"
                for row, c in zip(equation["exponents"], equation["coefficients"], strict=True)
            )
            for equation in piece
        ]
        out.append(f"Definition field_{span} : list equation := {listed(equations)}.")
        bounds = [
            f"({int(row[0])}%nat, ({num(row[1])}, {num(row[2])}))"
            for row in field["valid"]
            if len(row) == 3 or row[3] == span
        ]
        out.append(f"Definition bounds_{span} : list (nat * (num * num)) := {listed(bounds)}.")
    for k, span in enumerate(problem.spans):
        x = listed(listed(num(point[i]) for point in funnel["x"][k]) for i in range(n))
        u = listed(listed(num(point[i]) for point in policy["u"][k]) for i in range(m))
        gains = listed(
            listed(listed(num(point[i][j]) for point in policy["K"][k]) for j in range(n))
            for i in range(m)
        )
        out.append(
            f"Definition segment_{k} := Segment knot_{k} knot_{k + 1} {x} {u} {gains}"
            f" field_{span} bounds_{span}."
        )
    goal = "None"
    if "goal" in claim:
        _only(claim["goal"], "centre P")
        centre = listed(map(num, claim["goal"]["centre"]))
        goal = f"(Some ({centre}, {upper(claim['goal']['P'], 'the matrix of the goal')}))"
    segments = listed(f"segment_{k}" for k in range(len(problem.spans)))
    out.append(f"Definition data := Problem {segments} {listed(limits)} {listed(box)} {goal}.")
    by_segment: list[list[str]] = [[] for _ in problem.spans]
    order = sorted(
        proof["pieces"], key=lambda p: (p["interval"], Fraction(p["index"], 2 ** p["level"]))
    )
    for i, piece in enumerate(order):
        _only(piece, "interval vertex level index mu columns squares", "mode tau")
        mu = piece["mu"]
        _only(mu, "shifts start end")
        rows = zip(mu["shifts"], mu["start"], mu["end"], strict=True)
        lines = listed(f"({shift}, ({a}, {b}))" for shift, a, b in rows)
        mode = 0
        for side in piece.get("mode", []):
            mode = 3 * mode + side + 1
        tau = listed(
            f"({listed(map(str, entry['columns']))}, {squares(entry['squares'])})"
            for entry in piece.get("tau", [])
        )
        out.append(
            f"Definition piece_{i} := Piece {piece['level']} {piece['index']} {piece['vertex']}%nat"
            f" {mode}%nat (big_mu {lines}) {listed(map(str, piece['columns']))}"
            f" {squares(piece['squares'])} {tau}."
        )
        by_segment[piece["interval"]].append(f"piece_{i}")
    names = ("basis", "multiplier", "sides")
    bases = (listed(map(monomial, proof.get(name, []))) for name in names)
    out.append(
        f"Definition proof := Witness {num(proof['margin'])} {' '.join(bases)}"
        f" {listed(map(listed, by_segment))} {num(proof.get('goal_multiplier', 0))}."
    )
    out.append(
        "Theorem accepted : funnel_ok data proof = true.\n"
        "Proof. vm_cast_no_check (eq_refl true). Qed.\n"
        "Theorem funnel : forall x, solution data x ->\n"
        "  forall ta, (begin data <= ta <= finish data)%R -> inside data x ta ->\n"
        "  (forall t, (ta <= t <= finish data)%R -> inside data x t) /\\ in_goal data x.\n"
        "Proof. exact (funnel_proved data proof accepted). Qed.\n"
        "Print Assumptions funnel."
    )
    return "\n".join(out) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--coq", type=Path, required=True)
    given = parser.parse_args()
    try:
        given.coq.write_text(coq(Problem(given.file)))
    except (NotCovered, KeyError, ValueError, TypeError, IndexError) as error:
        print(f"{given.file}: NOT COVERED {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
