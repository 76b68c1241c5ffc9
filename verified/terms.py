"""The numbers of a problem as terms of Coq, by kind of claim, with nothing decided.

Standard library only.
"""

from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import printed
import strict
from problems import Composition, Funnel, Increments, NotCovered, Sampled
from strict import Refused

WORD = 2**61  # rows of factors are machine words in Coq
SHIFT, LEVEL = 400, 16  # of powers of two, of subdivision


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


def _whole(value: Any) -> int:
    """An index that is stored as a number."""
    if number(value).denominator != 1 or not 0 <= value <= 1000:
        raise NotCovered(f"{value!r} is not an index")
    return int(value)


def bits(value: Any) -> int:
    """A whole number or a text of one, of a factor."""
    if type(value) is str and value.removeprefix("-").isdecimal() and len(value) < 60:
        value = int(value)
    return integer(value, -WORD + 1, WORD - 1)


class Coq:
    """Terms of Coq; what is defined is named."""

    def __init__(self) -> None:
        self.mark = ""  # before every name
        self.lines: list[str] = []

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
        self.lines.append(f"Definition {self.mark}{name} := {term}.")
        return self.mark + name


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

    def __init__(self, to: Coq) -> None:
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

    def monomials(self, rows: list[list[int]]) -> str:
        """Monomials of x, each as the list of its variables."""
        to = self.to
        return to.listed(
            to.listed(to.variable(i + 1) for i, e in enumerate(row) for _ in range(e))
            for row in rows
        )

    def upper(self, P: list[list[Any]], what: str) -> str:
        """The upper triangle of a symmetric matrix."""
        if any(number(P[i][j]) != number(P[j][i]) for i in range(len(P)) for j in range(i)):
            raise Refused(f"{what} is not symmetric")
        return self.to.listed(self.nums(row[i:]) for i, row in enumerate(P))

    def squares(self, stated: dict[str, Any]) -> str:
        """The factors of a witness."""
        to, factors = self.to, []
        for factor in stated["factors"]:
            weights = stated.get("weights", [1] * len(factor))
            rows = []
            for w, row in zip(weights, factor, strict=True):
                entries = [bits(e) for e in row]
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
            return to.made("Linear", self.nums(model["a"]))
        if kind == "monotone_equation":
            a = [-number(entry) for entry in model["a"]]
            return self.monotone([number(entry) for entry in model["e"]], a, shifted(len(a), 1))
        if kind == "state_affine":
            p, n = len(model["y"]), len(model["y"]) * (len(model["G"]) - 1)
            ranges = [
                [
                    (number(end) - number(model["u_offset"][i])) / number(model["u_scale"][i])
                    for end in model["u_range"][i]
                ]
                for i, _ in model["window"]
            ]
            return self.affine(p, n, model["y_scale"], ranges, beside(model["G"], p))
        if kind == "implicit":
            return self.implicit(model)
        if kind == "cell_network":
            tables = (zip(f["knots"], f["values"], strict=True) for f in model["maps"])
            maps = to.listed(
                to.made("Broken", to.listed(map(self.ends, table))) for table in tables
            )
            size = len(model["maps"]) + len(model["start"])
            known = ([row[:size] for row in model[key]] for key in ("into", "next", "output"))
            return to.made("Cells", maps, *map(self.matrix, known))
        if kind == "block_cascade":
            f, parts = model["f"], printed.cascade(model, *printed.orders(model))
            numbers = self.num(f["low"]), self.num(f["spacing"]), self.nums(f["coefficients"])
            maps = to.listed([to.made("Spline", *numbers)] * len(model["b1"]))
            return to.made("Cells", maps, *map(self.matrix, parts))
        raise NotCovered(f"models of kind {kind} are not covered")

    def affine(
        self,
        p: int,
        n: int,
        scale: list[Any],
        ranges: list[list[Fraction]],
        terms: list[tuple[list[int], list[list[Any]]]],
    ) -> str:
        """0 = (a matrix polynomial in w) [v; x] + what the inputs add, x+ = [v; x] cut off."""
        to = self.to
        rows = to.listed(to.pair(self.counts(e, 20), self.matrix(C)) for e, C in terms)
        box = to.listed(to.pair(self.num(low), self.num(high)) for low, high in ranges)
        return to.made("Affine", to.count(p), to.count(n), self.nums(scale), box, rows)

    def monotone(self, e: list[Fraction], a: list[Fraction], shift: list[list[Fraction]]) -> str:
        """0 = e(v) + a'x + what the inputs add, x+ = [v; shift x]."""
        return self.to.made("Monotone", *map(self.num, e), self.nums(a), self.matrix(shift))

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
            E = [
                [
                    sum((number(row[i]) for e, row in known if e[j]), Fraction(0))
                    for j in range(p + n)
                ]
                for i in range(p)
            ]
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
            return to.made("Leaf", to.maybe(None), to.listed([to.listed([])] * forms))
        if set(tree) == {"split", "parts"}:
            lower, upper = (self.tree(part, forms) for part in tree["parts"])
            return to.made("Split", to.count(integer(tree["split"], 0, 99)), lower, upper)
        stated = None
        if "ends" in tree:
            ends = tree["ends"]
            weights = (self.nums(ends[f"{name}_weights"]) for name in ("low", "high"))
            stated = to.made("Ends", self.num(ends["low"]), self.num(ends["high"]), *weights)
        Ns = tree["N"] if forms > 1 else [tree["N"]]
        columns = to.listed(self.matrix(zip(*N, strict=True)) for N in Ns)
        return to.made("Leaf", to.maybe(stated), columns)

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
            "Tube",
            self.num(tube["rho"]),
            self.matrix(tube["L"]),
            self.symmetric(tube["P"], "P"),
            self.symmetric(tube["R"], "R"),
            self.nums(tube["tau"]),
            self.nums(tube["half_widths"]),
            self.num(tube["level"]),
            self.num(tube["inlet"]),
        )

    def shifts(self, values: Iterable[Any]) -> str:
        """Powers of two."""
        return self.to.listed(self.to.whole(integer(e, -SHIFT, SHIFT)) for e in values)

    def counts(self, values: Iterable[Any], most: int = 7) -> str:
        """Exponents of a monomial."""
        return self.to.listed(self.to.count(integer(e, 0, most)) for e in values)

    def field(self, field: dict[str, Any]) -> str:
        """The vector field, as its file has it."""
        to = self.to
        spans = []
        for k, piece in enumerate(field["pieces"]):
            equations = []
            for equation in piece:
                rows = zip(
                    equation["exponents"], map(rational, equation["coefficients"]), strict=True
                )
                terms = [to.pair(self.counts(row), self.fraction(c)) for row, c in rows]
                equations.append(to.listed(terms))
            spans.append(to.named(f"span_{k}", to.listed(equations)))
        valid = []
        for j, low, high, *span in field["valid"]:
            only = to.maybe(to.count(_whole(span[0])) if span else None)
            bound = to.pair(to.count(_whole(j)), self.ends([low, high]))
            valid.append(to.pair(bound, only))
        sizes = to.count(integer(field["states"], 1, 16)), to.count(integer(field["inputs"], 0, 16))
        box = to.listed(map(self.ends, field["uncertain"]))
        return to.made(
            "Field", *sizes, box, self.nums(field["breaks"]), to.listed(valid), to.listed(spans)
        )

    def ends(self, row: Iterable[Any]) -> str:
        """A row [low, high]."""
        low, high = row
        return self.to.pair(self.num(low), self.num(high))

    def composition(self, problem: Composition) -> None:
        """What the theorem is about, stage by stage, and what is used to decide it."""
        to, parts = self.to, ("field", "policy", "funnel", "goal")
        stages, proofs = [], []
        for i, stage in enumerate(problem.stages, start=1):
            to.mark = f"stage{i}_"
            self.problem(stage)
            proofs.append(to.named("proof", self.witness(stage)))
            stages.append(to.made("Stage", *(to.mark + part for part in parts)))
        to.mark = ""
        to.named("stages", to.listed(stages))
        to.named("proofs", to.listed(proofs))
        to.named("multipliers : list num", self.nums(problem.multipliers))

    def sampled(self, problem: Sampled) -> None:
        """What the theorem is about: model, policy, funnel."""
        to, model, policy, funnel = self.to, problem.model, problem.policy, problem.funnel
        rows = to.listed(self.counts(row, strict.DEGREES) for row in model["exponents"])
        ranges = (to.listed(map(self.ends, model[name])) for name in ("x_range", "u_range"))
        to.named("model", to.made("Map", rows, self.matrix(model["coefficients"]), *ranges))
        K = to.listed(map(self.matrix, policy["K"]))
        to.named("policy", to.made("Track", self.matrix(policy["u"]), self.matrix(policy["x"]), K))
        given = funnel["assumption"]
        level = (self.num(given[name]) for name in ("bound", "rate", "gain"))
        radii = self.nums(funnel["tube"]), self.nums(funnel["inlet"])
        shapes = (to.listed(map(self.matrix, funnel[name])) for name in ("S", "A"))
        sides = *radii, self.matrix(funnel["half_widths"]), *shapes
        to.named("funnel", to.made("Sampled", given["form"].capitalize(), *level, *sides))

    def links(self, proof: dict[str, Any]) -> str:
        """The witnesses of every step."""
        to = self.to
        bases = (self.monomials(proof[name]) for name in ("basis", "ball_basis"))
        steps = enumerate(proof["steps"])
        return to.made(
            "Links", *bases, to.listed(to.named(f"link_{k}", self.link(step)) for k, step in steps)
        )

    def link(self, step: dict[str, Any]) -> str:
        """Those of one."""
        numbers = self.matrix(step["T"]), self.num(step["kappa"]), self.nums(step["curvature"])
        return self.to.made("Link", *numbers, self.chain(step["tube"]), self.chain(step["inlet"]))

    def chain(self, chain: dict[str, Any]) -> str:
        """Those of a chain of radii."""
        sums = (
            term
            for entry in (chain, chain["ball"])
            for term in (self.shifts(entry["columns"]), self.squares(entry["squares"]))
        )
        return self.to.made("Chain", self.num(chain["reach"]), *sums)

    def curves(self, name: str, intervals: Iterable[Any], entry: Any) -> str:
        """Control points, by interval."""
        to = self.to
        rows = (to.listed(map(entry, points)) for points in intervals)
        return to.listed(to.named(f"{name}_{k}", row) for k, row in enumerate(rows))

    def problem(self, problem: Funnel) -> None:
        """What the theorem is about: field, policy, funnel, goal."""
        to, policy, funnel = self.to, problem.policy, problem.funnel
        to.named("field", self.field(problem.field))
        limits = (
            to.pair(to.count(_whole(i)), self.ends([low, high]))
            for i, low, high in policy["limits"]
        )
        feeds = self.curves("feed", policy["u"], self.nums)
        gains = self.curves("gain", policy["K"], self.matrix)
        to.named("policy", to.made("Policy", feeds, gains, to.listed(limits)))
        nominals = self.curves("nominal", funnel["x"], self.nums)
        shapes = to.listed(
            to.named(f"shape_{k}", self.matrix(P)) for k, P in enumerate(funnel["P"])
        )
        sides = self.nums(funnel["t"]), nominals, shapes, self.nums(funnel["rho"])
        to.named("funnel", to.made("Funnel", *sides))
        goal = None
        if "goal" in problem.claim:
            stated = problem.claim["goal"]
            goal = to.pair(self.nums(stated["centre"]), self.matrix(stated["P"]))
        to.named("goal : option (list num * list (list num))", to.maybe(goal))

    def by_interval(self, name: str, problem: Funnel, entries: list[Any], made: Any) -> str:
        """Pieces of each interval, in the order in which they begin."""
        to = self.to
        found: list[list[str]] = [[] for _ in range(problem.intervals)]
        order = sorted(
            entries, key=lambda p: (p["interval"], Fraction(p["index"], 2 ** p["level"]))
        )
        for i, piece in enumerate(order):
            k = integer(piece["interval"], 0, len(found) - 1)
            found[k].append(to.named(f"{name}_{i}", made(piece, k)))
        return to.listed(map(to.listed, found))

    def held(self, problem: Funnel) -> None:
        """The hold, the errors, the rates and what proves them."""
        to, proof = self.to, problem.proof
        to.named("period : num", self.num(problem.period))
        to.named("errors : list num", self.nums(problem.errors))
        none = [[0] * problem.field["inputs"]] * problem.intervals
        to.named("rates : list (list num)", self.matrix(proof.get("rates", none)))

        def turn(piece: dict[str, Any], _interval: int) -> str:
            up = "true" if integer(piece["sign"], -1, 1) > 0 else "false"
            return to.made("RatePiece", to.count(piece["input"]), up, self.piece(piece, []))

        pieces = self.by_interval("turn", problem, proof.get("rate_pieces", []), turn)
        to.named("turns : list (list rate_piece)", pieces)

    def witness(self, problem: Funnel) -> str:
        """What is used to decide it."""
        to, proof = self.to, problem.proof
        pieces = self.by_interval(
            "piece", problem, proof["pieces"], lambda p, k: self.piece(p, problem.kappa[k])
        )
        names = ("basis", "multiplier", "sides")
        bases = [self.monomials(proof.get(name, [])) for name in names]
        pushed = "true" if "kappa" in proof else "false"
        least = self.num(proof.get("goal_multiplier", 0))
        return to.made("Witness", self.num(proof.get("margin", 1)), *bases, pieces, pushed, least)

    def piece(self, piece: dict[str, Any], kappa: list[Any]) -> str:
        """One part of time, at a vertex and in a mode."""
        to = self.to
        none: dict[str, Any] = {"shifts": [], "start": [], "end": []}
        rows = zip(*(piece.get("mu", none)[name] for name in none), strict=True)
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
            "Piece",
            *place,
            self.nums(kappa),
            to.made("big_mu", lines),
            self.shifts(piece["columns"]),
            self.squares(piece["squares"]),
            tau,
        )
