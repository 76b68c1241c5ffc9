#!/usr/bin/env python3
"""Turn a proof file of version 2 into data for the second kernel, without deciding anything.

    python generate.py FILE.proof.json --coq OUT.v     a theorem for Coq about the file's numbers
    python generate.py FILE.proof.json --words OUT     the same numbers for the extracted checker

Untrusted: a theorem of Coq is about the numbers that it shows, whoever wrote them. What the second
kernel does not cover is refused by name (NotCovered). Standard library only.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Iterable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

WORD = 2**61  # rows of factors are machine words in Coq
SHIFT, LEVEL = 400, 16  # of powers of two, of subdivision


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


def _kinds(documents: list[Any]) -> None:
    """Raise NotCovered unless these are a vector field, a policy and a funnel."""
    for document, kind in zip(documents, ("vector_field", "policy", "funnel"), strict=True):
        continuous = kind == "vector_field" or document.get("kind") == "continuous"
        if document.get("format") != f"nlsid/{kind}" or not continuous:
            raise NotCovered(f"a file is not a continuous {kind}")


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
    _kinds(files)
    if any(file["vector_field"] != digests["vector_field"] for file in files[1:]):
        raise NotCovered("a file names another vector field")
    if files[2]["policy"] != digests["policy"]:
        raise NotCovered("the funnel names another policy")
    return files, digests


def number(value: Any) -> Fraction:
    """The exact value of a number of a file."""
    if type(value) not in (int, float):
        raise NotCovered(f"{value!r} is not a number")
    return Fraction(value)


def rational(value: Any) -> Fraction:
    """A number, or a text "p/q"."""
    return Fraction(value) if type(value) is str else number(value)


def integer(value: Any, least: int, most: int) -> int:
    """A whole number of a file, in a range."""
    if type(value) is not int or not least <= value <= most:
        raise NotCovered(f"{value!r} is not a whole number from {least} to {most}")
    return value


def bits(value: Any) -> int:
    """A whole number or a text of one, of a factor."""
    if type(value) is str and value.removeprefix("-").isdecimal() and len(value) < 60:
        value = int(value)
    return integer(value, -WORD + 1, WORD - 1)


class Coq:
    """Terms of Coq; what is defined is named."""

    def __init__(self) -> None:
        self.lines = [
            "(* Made by generate.py. The theorem is about the numbers below. *)",
            "From Coq Require Import ZArith Reals List Uint63.",
            "From Verified Require Import Integers Forms Polynomials Positive Claim.",
            "From Verified Require Import Funnel Goal Data.",
            "Import ListNotations.",
            "Open Scope Z_scope.",
        ]

    def whole(self, value: int) -> str:
        return str(value)

    def variable(self, value: int) -> str:
        return f"{value}%positive"

    def count(self, value: int) -> str:
        return f"{value}%nat"

    def row(self, entries: list[int]) -> str:
        """Machine words: twice the size of each entry, plus one if it is negative."""
        if any(abs(e) >= WORD for e in entries):
            raise NotCovered("a factor has an entry of more than 61 bits")
        return listing(str(2 * e if e >= 0 else -2 * e + 1) for e in entries) + "%uint63"

    def pair(self, a: str, b: str) -> str:
        return f"({a}, {b})"

    def listed(self, entries: Iterable[str]) -> str:
        return listing(entries)

    def maybe(self, term: str | None) -> str:
        return "None" if term is None else f"(Some {term})"

    def made(self, constructor: str, *terms: str) -> str:
        return f"({constructor} {' '.join(terms)})"

    def named(self, name: str, term: str) -> str:
        self.lines.append(f"Definition {name} := {term}.")
        return name


class Words:
    """Whole numbers in a row: a list begins with its length, an option with 0 or 1."""

    def whole(self, value: int) -> str:
        return str(value)

    variable = count = whole

    def row(self, entries: list[int]) -> str:
        return self.listed(map(str, entries))

    def pair(self, a: str, b: str) -> str:
        return f"{a} {b}"

    def listed(self, entries: Iterable[str]) -> str:
        terms = list(entries)
        return " ".join([str(len(terms)), *terms])

    def maybe(self, term: str | None) -> str:
        return "0" if term is None else f"1 {term}"

    def made(self, _constructor: str, *terms: str) -> str:
        return " ".join(terms)

    def named(self, _name: str, term: str) -> str:
        return term


def listing(entries: Iterable[str]) -> str:
    """A list of Coq."""
    return "[" + "; ".join(entries) + "]"


class Writer:
    """A problem and its witness, by either way of writing."""

    def __init__(self, to: Coq | Words) -> None:
        self.to = to

    def num(self, value: Any) -> str:
        """A fraction of Claim.v."""
        return self.fraction(number(value))

    def fraction(self, fraction: Fraction) -> str:
        """The same."""
        to = self.to
        return to.pair(to.whole(fraction.numerator), to.variable(fraction.denominator))

    def nums(self, values: Iterable[Any]) -> str:
        """A list of them."""
        return self.to.listed(map(self.num, values))

    def monomials(self, rows: list[list[int]], n: int) -> str:
        """Monomials of x (n,), distinct, each as the list of its variables."""
        to = self.to
        if any(len(row) != n for row in rows) or len({tuple(row) for row in rows}) != len(rows):
            raise NotCovered(f"monomials should be distinct and have {n} exponents")
        return to.listed(
            to.listed(
                to.variable(i + 1) for i, e in enumerate(row) for _ in range(integer(e, 0, 31))
            )
            for row in rows
        )

    def upper(self, P: list[list[Any]], what: str) -> str:
        """The upper triangle of a symmetric matrix."""
        if any(number(P[i][j]) != number(P[j][i]) for i in range(len(P)) for j in range(i)):
            raise NotCovered(f"{what} is not symmetric")
        return self.to.listed(self.nums(row[i:]) for i, row in enumerate(P))

    def squares(self, stated: dict[str, Any]) -> str:
        """The factors of a witness."""
        _only(stated, "unit factors", "scale weights")
        to, factors = self.to, []
        for factor in stated["factors"]:
            weights = stated.get("weights", [1] * len(factor))
            rows = []
            for w, row in zip(weights, factor, strict=True):
                entries = [bits(e) for e in row]
                if not entries:
                    raise NotCovered("a row of a factor without entries")
                rows.append(to.pair(to.whole(bits(w)), to.row(entries)))
            factors.append(to.listed(rows))
        scale = to.whole(bits(stated.get("scale", 1)))
        unit = to.whole(integer(stated["unit"], 0, SHIFT))
        return to.made("word_squares", unit, scale, to.listed(factors))

    def shifts(self, values: Iterable[Any]) -> str:
        """Powers of two."""
        return self.to.listed(self.to.whole(integer(e, -SHIFT, SHIFT)) for e in values)

    def counts(self, values: Iterable[Any]) -> str:
        """Exponents of a monomial."""
        return self.to.listed(self.to.count(integer(e, 0, 7)) for e in values)

    def segments(self, problem: Problem) -> str:
        """Every interval between knots."""
        to, field, policy, funnel = self.to, problem.field, problem.policy, problem.funnel
        n, m = field["states"], field["inputs"]
        rows = zip(funnel["t"], funnel["P"], funnel["rho"], strict=True)
        knots = [
            to.named(
                f"knot_{k}",
                to.made("Knot", self.num(t), self.upper(P, f"P at knot {k}"), self.num(rho)),
            )
            for k, (t, P, rho) in enumerate(rows)
        ]
        fields, bounds, size = [], [], 1 + n + m + len(field["uncertain"])
        for span, piece in enumerate(field["pieces"]):
            terms = [
                zip(equation["exponents"], equation["coefficients"], strict=True)
                for equation in piece
            ]
            if any(len(row) != size for equation in piece for row in equation["exponents"]):
                raise NotCovered(f"a monomial should have {size} exponents")
            for equation in piece:
                if any(a >= b for a, b in pairwise(equation["exponents"])):
                    raise NotCovered("monomials should be distinct, in increasing order")
            equations = to.listed(
                to.listed(to.pair(self.counts(row), self.fraction(rational(c))) for row, c in rows)
                for rows in terms
            )
            fields.append(to.named(f"field_{span}", equations))
            valid = [row for row in field["valid"] if len(row) == 3 or row[3] == span]
            kept = to.listed(
                to.pair(to.count(int(row[0])), to.pair(self.num(row[1]), self.num(row[2])))
                for row in valid
            )
            bounds.append(to.named(f"bounds_{span}", kept))
        made = []
        for k, span in enumerate(problem.spans):
            x = to.listed(self.nums(point[i] for point in funnel["x"][k]) for i in range(n))
            u = to.listed(self.nums(point[i] for point in policy["u"][k]) for i in range(m))
            gains = to.listed(
                to.listed(self.nums(point[i][j] for point in policy["K"][k]) for j in range(n))
                for i in range(m)
            )
            ends = knots[k], knots[k + 1]
            term = to.made("Segment", *ends, x, u, gains, fields[span], bounds[span])
            made.append(to.named(f"segment_{k}", term))
        return to.listed(made)

    def problem(self, problem: Problem) -> str:
        """What the theorem is about."""
        to, field = self.to, problem.field
        limits: list[str | None] = [None] * field["inputs"]
        for i, low, high in problem.policy["limits"]:
            limits[int(i)] = to.pair(self.num(low), self.num(high))
        box = to.listed(to.pair(self.num(low), self.num(high)) for low, high in field["uncertain"])
        goal = None
        if "goal" in problem.claim:
            stated = problem.claim["goal"]
            _only(stated, "centre P")
            matrix = self.upper(stated["P"], "the matrix of the goal")
            goal = to.pair(self.nums(stated["centre"]), matrix)
        clipped = to.listed(map(to.maybe, limits))
        return to.made("Problem", self.segments(problem), clipped, box, to.maybe(goal))

    def witness(self, problem: Problem) -> str:
        """What is used to decide it."""
        to, proof = self.to, problem.proof
        by_segment: list[list[str]] = [[] for _ in problem.spans]
        order = sorted(
            proof["pieces"], key=lambda p: (p["interval"], Fraction(p["index"], 2 ** p["level"]))
        )
        for i, piece in enumerate(order):
            by_segment[integer(piece["interval"], 0, len(by_segment) - 1)].append(
                to.named(f"piece_{i}", self.piece(piece))
            )
        names, n = ("basis", "multiplier", "sides"), problem.field["states"]
        bases = [self.monomials(proof.get(name, []), n) for name in names]
        pieces = to.listed(map(to.listed, by_segment))
        least = self.num(proof.get("goal_multiplier", 0))
        return to.made("Witness", self.num(proof["margin"]), *bases, pieces, least)

    def piece(self, piece: dict[str, Any]) -> str:
        """One part of time, at a vertex and in a mode."""
        to = self.to
        _only(piece, "interval vertex level index mu columns squares", "mode tau")
        _only(piece["mu"], "shifts start end")
        rows = zip(*(piece["mu"][name] for name in ("shifts", "start", "end")), strict=True)
        lines = to.listed(
            to.pair(
                to.whole(integer(shift, -SHIFT, SHIFT)),
                to.pair(to.whole(bits(a)), to.whole(bits(b))),
            )
            for shift, a, b in rows
        )
        mode = 0
        for side in piece.get("mode", []):
            mode = 3 * mode + integer(side, -1, 1) + 1
        tau = to.listed(
            to.pair(self.shifts(entry["columns"]), self.squares(entry["squares"]))
            for entry in piece.get("tau", [])
        )
        level = integer(piece["level"], 0, LEVEL)
        index = integer(piece["index"], 0, 2**level - 1)
        vertex = integer(piece["vertex"], 0, 1023)
        place = to.whole(level), to.whole(index), to.count(vertex), to.count(mode)
        return to.made(
            "Piece", *place, to.made("big_mu", lines),
            self.shifts(piece["columns"]), self.squares(piece["squares"]), tau,
        )  # fmt: skip


THEOREM = """\
Theorem accepted : funnel_ok data proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem funnel : forall x, solution data x ->
  forall ta, (begin data <= ta <= finish data)%R -> inside data x ta ->
  (forall t, (ta <= t <= finish data)%R -> inside data x t) /\\ in_goal data x.
Proof. exact (funnel_proved data proof accepted). Qed.
Print Assumptions funnel.
"""


def coq(problem: Problem) -> str:
    """A file of Coq: the problem, the witness and the theorem."""
    to = Coq()
    writer = Writer(to)
    data, proof = writer.problem(problem), writer.witness(problem)
    to.lines += [f"Definition data : problem := {data}.", f"Definition proof := {proof}."]
    return "\n".join(to.lines) + "\n" + THEOREM


def words(problem: Problem) -> str:
    """The same as whole numbers, for the extracted checker."""
    writer = Writer(Words())
    return f"{writer.problem(problem)}\n{writer.witness(problem)}\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--coq", type=Path)
    parser.add_argument("--words", type=Path)
    given = parser.parse_args()
    try:
        problem = Problem(given.file)
        for path, write in ((given.coq, coq), (given.words, words)):
            if path is not None:
                path.write_text(write(problem))
    except (NotCovered, KeyError, ValueError, TypeError, IndexError) as error:
        print(f"{given.file}: NOT COVERED {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
