#!/usr/bin/env python3
"""Turn a proof file of version 2 into data for the second kernel, without deciding anything.

    python generate.py FILE.proof.json --coq OUT.v     a theorem for Coq about the file's numbers
    python generate.py FILE.proof.json --words OUT     the same numbers for the extracted checker
    python generate.py FILE.proof.json --ask CHECKER   what that says: status 0, 1; 3 is not covered

Untrusted: a theorem of Coq is about the numbers that it shows, whoever wrote them. What the second
kernel does not cover is refused by name (NotCovered). Standard library only.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

WORD = 2**61  # rows of factors are machine words in Coq
SHIFT, LEVEL = 400, 16  # of powers of two, of subdivision


class NotCovered(Exception):  # noqa: N818 - says what the second kernel does not decide
    """What the file has and the second kernel does not cover; or what is wrong with the file."""


class Funnel:
    """The numbers of a continuous funnel: what the theorem is about, and its witness."""

    def __init__(self, claim: Any, proof: Any, folder: Path) -> None:
        _only(claim, "kind about", "goal")
        files, digests = _bound(claim["about"], folder, "vector_field policy funnel")
        _kinds(files)
        if any(file["vector_field"] != digests["vector_field"] for file in files[1:]):
            raise NotCovered("a file names another vector field")
        if files[2]["policy"] != digests["policy"]:
            raise NotCovered("the funnel names another policy")
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


def _bound(about: dict[str, Any], folder: Path, roles: str) -> tuple[list[Any], dict[str, str]]:
    """The files of these roles, by digests of their bytes."""
    _only(about, roles)
    files, digests = [], {}
    for role in roles.split():
        name = about[role]["file"]
        if not name or any(sign in name for sign in "/\\:"):
            raise NotCovered(f"{name!r} is not a plain file name")
        content = (folder / name).read_bytes()
        digests[role] = "sha256:" + hashlib.sha256(content).hexdigest()
        if digests[role] != about[role]["digest"]:
            raise NotCovered(f"{name} is not the file that the proof is about")
        files.append(_load(content, name))
    return files, digests


class Increments:
    """The numbers of a model, and of tubes around it or of its stability, with the multipliers."""

    def __init__(self, claim: Any, proof: Any, folder: Path) -> None:
        self.tubes: list[Any] | None = None
        self.policy: Any = None
        if claim["kind"] == "stability":
            _only(claim, "kind about rate")
            (self.model,), _ = _bound(claim["about"], folder, "model")
            _only(proof, "P", "multipliers")
            self.P, self.rate = proof["P"], claim["rate"]
            self.trees = [proof.get("multipliers")]
        else:
            _only(claim, "kind about")
            planned = "policy" in claim["about"]
            roles = "model policy funnel" if planned else "model funnel"
            (self.model, *plan, funnel), digests = _bound(claim["about"], folder, roles)
            if any(entry["model"] != digests["model"] for entry in (*plan, funnel)):
                raise NotCovered("a file names another model")
            if planned:
                self.policy = plan[0]
                if funnel["policy"] != digests["policy"]:
                    raise NotCovered("the funnel names another policy")
                if any(tube["L"] != self.policy["L"] for tube in funnel["tubes"]):
                    raise NotCovered("the observer of a tube is not the policy's")
            _only(proof, "", "multipliers")
            self.tubes = funnel["tubes"]
            self.trees = proof.get("multipliers", [None] * len(self.tubes))


def number(value: Any) -> Fraction:
    """The exact value of a number of a file, or a fraction made of such."""
    if type(value) not in (int, float, Fraction):
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

    def __init__(self, modules: str) -> None:
        self.lines = [
            "(* Made by generate.py. The theorem is about the numbers below. *)",
            "From Coq Require Import ZArith Reals List Uint63.",
            f"From Verified Require Import {modules}.",
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

    def chosen(self, constructor: str, _place: int, *terms: str) -> str:
        return self.made(constructor, *terms)

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

    def chosen(self, _constructor: str, place: int, *terms: str) -> str:
        return " ".join([str(place), *terms])

    def named(self, _name: str, term: str) -> str:
        return term


def shifted(n: int, p: int) -> list[list[Fraction]]:
    """The first n - p of n entries, as a matrix."""
    return [[Fraction(int(i == j)) for j in range(n)] for i in range(n - p)]


def beside(G: list[Any], p: int) -> list[tuple[list[int], list[list[Any]]]]:
    """[G_0 ... G_n] as one matrix polynomial."""
    found = [dict(zip(map(tuple, g["exponents"]), g["coefficients"], strict=True)) for g in G]
    nothing = [[0] * p] * p
    return [
        (list(e), [[entry for g in found for entry in g.get(e, nothing)[i]] for i in range(p)])
        for e in sorted({e for g in found for e in g})
    ]


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

    def matrix(self, rows: Iterable[Iterable[Any]]) -> str:
        """Rows of numbers."""
        return self.to.listed(map(self.nums, rows))

    def symmetric(self, P: list[list[Any]], what: str) -> str:
        """A symmetric matrix, whole."""
        self.upper(P, what)
        return self.matrix(P)

    def model(self, model: dict[str, Any]) -> str:
        """What two solutions under the same inputs are told apart by (Tubes.v)."""
        to, kind = self.to, model["kind"]
        if kind == "difference_equation":
            return to.chosen("Linear", 0, self.nums(model["a"]))
        if kind == "monotone_equation":
            a = [-number(entry) for entry in model["a"]]
            return self.monotone([number(entry) for entry in model["e"]], a, shifted(len(a), 1))
        if kind == "state_affine":
            p, n = len(model["y"]), len(model["y"]) * (len(model["G"]) - 1)
            ranges = [
                [(number(end) - number(model["u_offset"][i])) / number(model["u_scale"][i])
                 for end in model["u_range"][i]]
                for i, _ in model["window"]
            ]  # fmt: skip
            return self.affine(p, n, model["y_scale"], ranges, beside(model["G"], p))
        if kind == "implicit":
            return self.implicit(model)
        raise NotCovered(f"models of kind {kind} are not covered")

    def affine(
        self, p: int, n: int, scale: list[Any], ranges: list[list[Fraction]],
        terms: list[tuple[list[int], list[list[Any]]]],
    ) -> str:  # fmt: skip
        """0 = (a matrix polynomial in w) [v; x] + what the inputs add, x+ = [v; x] cut off."""
        to = self.to
        rows = to.listed(to.pair(self.counts(e, 20), self.matrix(C)) for e, C in terms)
        box = to.listed(to.pair(self.num(low), self.num(high)) for low, high in ranges)
        return to.chosen("Affine", 1, to.count(p), to.count(n), self.nums(scale), box, rows)

    def monotone(self, e: list[Fraction], a: list[Fraction], shift: list[list[Fraction]]) -> str:
        """0 = e(v) + a'x + what the inputs add, x+ = [v; shift x]."""
        return self.to.chosen("Monotone", 2, *map(self.num, e), self.nums(a), self.matrix(shift))

    def implicit(self, model: dict[str, Any]) -> str:
        """An implicit model whose equations are affine in v and x, or a cubic in one v."""
        n = len(model["states"])
        table = list(zip(model["h"]["exponents"], model["h"]["coefficients"], strict=True))
        p = len(table[0][1])
        moved = [[Fraction(0)] * n for _ in range(n - p)]
        if p < n:
            rows = zip(model["shift"]["exponents"], model["shift"]["coefficients"], strict=True)
            for e, coefficients in rows:
                if any(e[:n]) and sum(e) > 1:
                    raise NotCovered("a shift that is not linear in the states")
                for i, c in enumerate(coefficients):
                    if any(e[:n]):
                        moved[i][e.index(1)] += number(c)
        known = [(e, row) for e, row in table if any(e[: p + n]) and any(map(number, row))]
        if all(sum(e) == 1 for e, _ in known):
            if moved != shifted(n, p):
                raise NotCovered("an implicit model that does more than shift its states")
            E = [[sum((number(row[i]) for e, row in known if e[j]), Fraction(0))
                  for j in range(p + n)] for i in range(p)]  # fmt: skip
            return self.affine(p, n, [1] * p, [], [([], E)])
        cubic, a = [Fraction(0)] * 4, [Fraction(0)] * n
        for e, row in known:
            if p == 1 and sum(e) == e[0] <= 3:
                cubic[e[0]] += number(row[0])
            elif p == 1 and sum(e) == 1:
                a[e.index(1) - 1] += number(row[0])
            else:
                raise NotCovered("an implicit model whose increments are known on a box only")
        if cubic[3] <= 0:
            raise NotCovered("an implicit model whose increments are known on a box only")
        return self.monotone(cubic[1:], a, moved)

    def tree(self, tree: Any, forms: int) -> str:
        """The multipliers of the leaves, by columns, one for each form."""
        to = self.to
        if tree is None:
            return to.chosen("Leaf", 0, to.listed([to.listed([])] * forms))
        if set(tree) == {"split", "parts"}:
            lower, upper = (self.tree(part, forms) for part in tree["parts"])
            return to.chosen("Split", 1, to.count(integer(tree["split"], 0, 99)), lower, upper)
        if "ends" in tree:
            raise NotCovered("stated ends of a leaf are not covered")
        _only(tree, "N")
        Ns = tree["N"] if forms > 1 else [tree["N"]]
        return to.chosen("Leaf", 0, to.listed(self.matrix(zip(*N, strict=True)) for N in Ns))

    def plan(self, problem: "Increments") -> list[str]:
        """a, b_1 ..., b_0, c of a difference equation, and the policy's feedback."""
        model = problem.model
        if model["kind"] != "difference_equation":
            raise NotCovered(f"a plan of a model of kind {model['kind']} is not covered")
        direct, *b = model["b"]
        (feedback,) = problem.policy["K"]
        rows = self.nums(model["a"]), self.nums(b)
        return [*rows, self.num(direct), self.num(model["c"]), self.nums(feedback)]

    def tube(self, tube: dict[str, Any]) -> str:
        """The numbers of one tube."""
        return self.to.made(
            "Tube", self.num(tube["rho"]), self.matrix(tube["L"]),
            self.symmetric(tube["P"], "P"), self.symmetric(tube["R"], "R"),
            self.nums(tube["tau"]), self.nums(tube["half_widths"]), self.num(tube["level"]),
            self.num(tube["inlet"]),
        )  # fmt: skip

    def shifts(self, values: Iterable[Any]) -> str:
        """Powers of two."""
        return self.to.listed(self.to.whole(integer(e, -SHIFT, SHIFT)) for e in values)

    def counts(self, values: Iterable[Any], most: int = 7) -> str:
        """Exponents of a monomial."""
        return self.to.listed(self.to.count(integer(e, 0, most)) for e in values)

    def segments(self, problem: Funnel) -> str:
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

    def problem(self, problem: Funnel) -> str:
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

    def witness(self, problem: Funnel) -> str:
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
STABLE = """\
Theorem accepted : stability_ok data storage rate proof = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
Theorem stable : forgets data storage rate.
Proof. exact (stability_proved data storage rate proof accepted). Qed.
Print Assumptions stable.
"""


def read(path: Path) -> Funnel | Increments:
    """The numbers of a proof file of a kind that is covered."""
    document = _load(path.read_bytes(), path.name)
    claim, proof = document["claim"], document["proof"]
    if claim["kind"] == "continuous_funnel":
        return Funnel(claim, proof, path.parent)
    if claim["kind"] in ("tube", "stability"):
        return Increments(claim, proof, path.parent)
    raise NotCovered(f"claims of kind {claim['kind']} are not covered by the second kernel")


def coq(problem: Funnel | Increments) -> str:
    """A file of Coq: the problem, the witness and the theorem."""
    if isinstance(problem, Funnel):
        to = Coq("Integers Forms Polynomials Positive Claim Funnel Goal Data")
        writer = Writer(to)
        data, proof = writer.problem(problem), writer.witness(problem)
        to.lines += [f"Definition data : problem := {data}.", f"Definition proof := {proof}."]
        return "\n".join(to.lines) + "\n" + THEOREM
    to = Coq("Integers Forms Claim Data Tubes Boxes Near Driven")
    writer = Writer(to)
    to.named("data", writer.model(problem.model))
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


def words(problem: Funnel | Increments) -> str:
    """The same as whole numbers, for the extracted checker."""
    to = Words()
    writer = Writer(to)
    if isinstance(problem, Funnel):
        return f"funnel {writer.problem(problem)}\n{writer.witness(problem)}\n"
    model = writer.model(problem.model)
    if problem.tubes is None:
        stated = writer.symmetric(problem.P, "P"), writer.num(problem.rate)
        return "\n".join(["stability", model, *stated, writer.tree(problem.trees[0], 1)])
    tubes = to.listed(map(writer.tube, problem.tubes))
    terms = [model, tubes, to.listed(trees(writer, problem))]
    if problem.policy is None:
        return "\n".join(["tube", *terms])
    return "\n".join(["plan", *terms, *writer.plan(problem)])


def asked(checker: Path, problem: Funnel | Increments) -> int:
    """The extracted checker's status: 0 accepted, 1 refused."""
    with tempfile.NamedTemporaryFile("w", suffix=".words") as file:
        file.write(words(problem))
        file.flush()
        return subprocess.run([checker, file.name], check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--coq", type=Path)
    parser.add_argument("--words", type=Path)
    parser.add_argument("--ask", type=Path, metavar="CHECKER")
    given = parser.parse_args()
    try:
        problem = read(given.file)
        for path, write in ((given.coq, coq), (given.words, words)):
            if path is not None:
                path.write_text(write(problem))
        return asked(given.ask, problem) if given.ask is not None else 0
    except (NotCovered, KeyError, ValueError, TypeError, IndexError) as error:
        said = error if isinstance(error, NotCovered) else f"{type(error).__name__} {error}"
        print(f"not covered: {said}", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
