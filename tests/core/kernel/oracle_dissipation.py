"""Claims `dissipation` and `small_gain` decided again, from their pages alone, in Fractions.

A difference of two runs is a row of numbers, one for each name of z: ("v", j), ("x", i),
("past", i, d) and ("u", i). Each model's own equation is written once more in these rows.
"""

from collections.abc import Callable, Mapping
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

from tests.core.kernel.oracle_stability import (
    Json,
    Rows,
    exact,
    interpolated,
    is_definite,
    padded,
    slopes,
    zeros,
)
from tests.core.kernel.oracle_tube import Implicit, matrix

Box = list[tuple[Fraction, Fraction]]
Name = tuple[Any, ...]
Row = dict[Name, Fraction]


def plus(*rows: tuple[Fraction | int, Row]) -> Row:
    total: Row = {}
    for weight, row in rows:
        for name, entry in row.items():
            total[name] = total.get(name, Fraction(0)) + weight * entry
    return total


def one(*name: Any) -> Row:
    return {name: Fraction(1)}


class Driven:
    """states: a row x⁺ for each name of the state; y: rows; E: rows for each vertex of a box."""

    def __init__(self, unknowns: int, inputs: int) -> None:
        self.unknowns, self.inputs = unknowns, inputs
        self.states: dict[Name, Row] = {}
        self.y: list[Row] = []
        self.box: Box = []
        self.ray = False
        self.kept = 0  # entries of the box that are not split
        self.whole = True  # for every input and output
        self.hull: Callable[[Box], list[list[Row]]] = lambda _: [[]]

    def remember(self, window: list[list[int]]) -> None:
        """The past inputs that a window asks for."""
        for i in range(self.inputs):
            for d in range(1, max((d for j, d in window if j == i), default=0) + 1):
                self.states["past", i, d] = one("u", i) if d == 1 else one("past", i, d - 1)

    def names(self) -> list[Name]:
        unknowns: list[Name] = [("v", j) for j in range(self.unknowns)]
        return [*unknowns, *self.states, *(("u", i) for i in range(self.inputs))]

    def rows(self, given: list[Row]) -> Rows:
        names = self.names()
        assert all(name in names for row in given for name in row)
        return [[row.get(name, Fraction(0)) for name in names] for row in given]


def entry(i: int, d: int) -> Row:
    """An input at a delay."""
    return one("past", i, d) if d else one("u", i)


def shift(found: Driven, count: int, outputs: int) -> None:
    """x: `count` groups of past outputs, the newest first."""
    for i in range(count * outputs):
        found.states["x", i] = one("v", i) if i < outputs else one("x", i - outputs)


def driven(model: Json, box: Json | None) -> Driven:
    kind = model["kind"]
    makers: dict[str, Callable[[Json, Json | None], Driven]] = {
        "state_affine": state_affine,
        "implicit": implicit,
    }
    if kind in makers:
        return makers[kind](model, box)
    assert box is None
    return {
        "difference_equation": linear, "block_cascade": cascade, "cell_network": network,
        "monotone_equation": monotone,
    }[kind](model)  # fmt: skip


def linear(model: Json) -> Driven:
    """y = Σ a y(t-k) + Σ b u(t-k) with x_i what is known at t - 1 of y(t + i) without u(t …)."""
    found = Driven(0, 1)
    a, b = [exact(v) for v in model["a"]], [exact(v) for v in model["b"]]
    y = plus((1, one("x", 0)), (b[0], one("u", 0)))
    for i in range(len(a)):
        after = [(1, one("x", i + 1))] if i + 1 < len(a) else []
        found.states["x", i] = plus((a[i], y), (b[i + 1], one("u", 0)), *after)
    found.y = [y]
    return found


def cascade(model: Json) -> Driven:
    b1, b2 = model["b1"], model["b2"]
    M = len(b1)
    n1 = max(len(model["a1"]), len(b1[0]) - 1)
    n2 = max(len(model["a2"]), len(b2[0]) - 1)
    found = Driven(M, 1)
    past = [one("x", k) for k in range(n1)]
    v = plus((1, one("u", 0)), *zip(padded(model["a1"], n1), past, strict=True))
    for k in range(n1):
        found.states["x", k] = v if k == 0 else past[k - 1]
    seen = [plus((exact(row[0]), v), *zip(padded(row[1:], n1), past, strict=True)) for row in b1]
    y = plus(
        *((exact(row[0]), one("v", j)) for j, row in enumerate(b2)),
        *([(1, one("x", n1))] if n2 else []),
    )
    for i, a in enumerate(padded(model["a2"], n2)):
        after = [(1, one("x", n1 + i + 1))] if i + 1 < n2 else []
        fed = [(padded(row[1:], n2)[i], one("v", j)) for j, row in enumerate(b2)]
        found.states["x", n1 + i] = plus((a, y), *fed, *after)
    found.y = [y]
    found.hull = lambda _: [
        [plus((1, one("v", j)), (-s, seen[j])) for j, s in enumerate(corner)]
        for corner in product(slopes(model), repeat=M)
    ]
    return found


def network(model: Json) -> Driven:
    m, n, q = len(model["maps"]), len(model["start"]), len(model["u"])
    names = [("v", j) for j in range(m)] + [("x", i) for i in range(n)]
    everything: list[Name] = [*names, *(("u", i) for i in range(q))]
    found = Driven(m, q)

    def row(values: list[float]) -> Row:
        assert len(values) == len(everything) + 1
        return {name: exact(v) for name, v in zip(everything, values, strict=False)}

    for i, values in enumerate(model["next"]):
        found.states["x", i] = row(values)
    assert len(found.states) == n
    found.y = [row(values) for values in model["output"]]
    ends = []
    for f in model["maps"]:
        knots, values = ([exact(v) for v in f[key]] for key in ("knots", "values"))
        assert all(a < b for a, b in pairwise(knots))
        steep = [
            (values[k + 1] - values[k]) / (knots[k + 1] - knots[k]) for k in range(len(knots) - 1)
        ]
        ends.append((min(steep), max(steep)))
    assert not any(model["into"][j][k] for j in range(m) for k in range(j, m))
    found.hull = lambda _: [
        [plus((1, one("v", j)), (-s, row(model["into"][j]))) for j, s in enumerate(corner)]
        for corner in product(*ends)
    ]
    return found


def monotone(model: Json) -> Driven:
    found = Driven(1, len(model["u"]))
    shift(found, len(model["a"]), 1)
    found.remember(model["window"])
    e1, e2, e3 = (exact(v) for v in model["e"])
    assert e3 > 0 or (e3 == 0 and e2 == 0)
    least = e1 - e2 * e2 / (3 * e3) if e3 else e1
    row = plus(
        (least, one("v", 0)),
        *((-exact(a), one("x", i)) for i, a in enumerate(model["a"])),
        *((-exact(b), entry(i, d))
          for b, (i, d) in zip(model["b"], model["window"], strict=True)),
    )  # fmt: skip
    found.hull = lambda _: [[row]]
    found.ray = e3 > 0
    found.y = [one("v", 0)]
    return found


def state_affine(model: Json, box: Json | None) -> Driven:
    """Values of the derivatives of Σ G_k(w) ȳ_k + p(w), by rules of calculus at each point."""
    p, n, window = len(model["y"]), len(model["G"]) - 1, model["window"]
    found = Driven(p, len(model["u"]))
    shift(found, n, p)
    found.remember(window)
    found.y = [{("v", j): exact(model["y_scale"][j])} for j in range(p)]
    groups = p * (n + 1)
    varying = any(any(e) for G in model["G"] for e in G["exponents"])
    assert varying == (box is not None)
    inputs: Box = []
    for i, _ in window:
        offset, scale = exact(model["u_offset"][i]), exact(model["u_scale"][i])
        low, high = ((exact(end) - offset) / scale for end in model["u_range"][i])
        inputs.append((low, high))
    outputs: Box = []
    if box is not None:
        assert set(box) == {"y"}
        for (low, high), offset, scale in zip(
            box["y"], model["y_offset"], model["y_scale"], strict=True
        ):
            assert low < high
            outputs.append(
                ((exact(low) - exact(offset)) / exact(scale),
                 (exact(high) - exact(offset)) / exact(scale))
            )  # fmt: skip
    found.box = [*(outputs * (n + 1)), *inputs]

    def power(w: list[Fraction], e: list[int], by: int | None = None) -> Fraction:
        value = Fraction(1)
        for k, (base, exponent) in enumerate(zip(w, e, strict=True)):
            if k == by:
                value *= exponent * base ** (exponent - 1) if exponent else 0
            else:
                value *= base**exponent
        return value

    def at(z: list[Fraction]) -> Rows:
        y, w = (z[:groups], z[groups:]) if box is not None else ([Fraction(0)] * groups, z)
        E = zeros(p, groups + len(window))
        for k, G in enumerate(model["G"]):
            for e, block in zip(G["exponents"], G["coefficients"], strict=True):
                for i, j in product(range(p), range(p)):
                    E[i][k * p + j] += exact(block[i][j]) * power(w, e)
                    for by in range(len(window)):
                        E[i][groups + by] += exact(block[i][j]) * power(w, e, by) * y[k * p + j]
        for e, column in zip(model["p"]["exponents"], model["p"]["coefficients"], strict=True):
            for i, by in product(range(p), range(len(window))):
                E[i][groups + by] += exact(column[i]) * power(w, e, by)
        return E

    degrees = [0] * (groups + len(window))
    for e in [e for G in model["G"] for e in G["exponents"]]:
        for k, exponent in enumerate(e):
            degrees[groups + k] = max(degrees[groups + k], exponent)
        if any(e):
            degrees[:groups] = [1] * groups
    for e in model["p"]["exponents"]:
        for by in range(len(window)):
            if e[by]:
                for k, exponent in enumerate(e):
                    degrees[groups + k] = max(degrees[groups + k], exponent - int(k == by))
    # ȳ_k has degree 1 only where its own factor varies.
    for k, G in enumerate(model["G"]):
        if not any(any(e) for e in G["exponents"]):
            degrees[k * p : (k + 1) * p] = [0] * p
    used = degrees if box is not None else degrees[groups:]

    def rows(E: Rows) -> list[Row]:
        return [
            plus(
                *((row[j], one("v", j)) for j in range(p)),
                *((row[p + j], one("x", j)) for j in range(p * n)),
                *((row[groups + k] / exact(model["u_scale"][i]), entry(i, d))
                  for k, (i, d) in enumerate(window)),
            )
            for row in E
        ]  # fmt: skip

    found.hull = lambda part: [rows(E) for E in interpolated(at, used, part)]
    found.kept = len(found.box) if p > 1 else 0
    found.whole = model["on_out_of_range"] == "clip" and box is None
    return found


def implicit(model: Json, box: Json | None) -> Driven:
    known = Implicit(model)
    p, n, q = known.p, known.n, known.q
    window = model["window"]
    found = Driven(p, len(model["u"]))
    for i in range(p):
        found.states["x", i] = one("v", i)
    if "shift" in model:
        shifted: list[Row] = [{} for _ in range(n - p)]
        for e, row in zip(model["shift"]["exponents"], model["shift"]["coefficients"], strict=True):
            for k, c in enumerate(row):
                if c and any(e):
                    assert sum(e) == 1
                    j = e.index(1)
                    name = one("x", j) if j < n else entry(*window[j - n])
                    shifted[k] = plus((1, shifted[k]), (exact(c), name))
        for k, terms in enumerate(shifted):
            found.states["x", p + k] = terms
    found.remember(window)
    found.y = [one("v", i) for i in range(p)]
    size = p + n + q

    def at(z: list[Fraction]) -> Rows:
        E = zeros(p, size)
        for e, row in known.terms:
            for j in range(size):
                if e[j]:
                    value = Fraction(e[j])
                    for k, power in enumerate(e):
                        value *= z[k] ** (power - int(k == j))
                    for i in range(p):
                        E[i][j] += value * row[i]
        return E

    def rows(E: Rows) -> list[Row]:
        return [
            plus(
                *((row[j], one("v", j)) for j in range(p)),
                *((row[p + j], one("x", j)) for j in range(n)),
                *((row[p + n + k], entry(i, d)) for k, (i, d) in enumerate(window)),
            )
            for row in E
        ]

    used = [(e, row) for e, row in known.terms if any(e) and any(row)]
    origin = [Fraction(0)] * size
    if all(sum(e) == 1 for e, _ in used):
        assert box is None
        found.hull = lambda _: [rows(at(origin))]
        return found
    cubic = [Fraction(0)] * 4
    pure = all(sum(e) == 1 or (sum(e) == e[0] and e[0] <= 3) for e, _ in used)
    if p == 1 and pure:
        for e, (c,) in used:
            if sum(e) == e[0]:
                cubic[e[0]] += c
        if cubic[3] > 0:
            assert box is None
            E = at(origin)
            E[0][0] = cubic[1] - cubic[2] ** 2 / (3 * cubic[3])
            found.hull, found.ray = lambda _: [rows(E)], True
            return found
    assert box is not None
    assert set(box) == {"y", "u"}
    found.box = known.box(box)
    degrees = [0] * size
    for e, row in known.terms:
        for j in range(size):
            if e[j] and any(row):
                for k, power in enumerate(e):
                    degrees[k] = max(degrees[k], power - int(k == j))
    found.hull = lambda part: [rows(E) for E in interpolated(at, degrees, part)]
    found.kept = len(found.box) if p > 1 else 0
    found.whole = False
    return found


def supplied(found: Driven, claim: Json) -> list[tuple[Fraction, Rows]]:
    """s(w̄, ȳ) = Σ weight · (first row)(second row), both linear in z."""
    u = [exact(v) for v in claim["scales"]["u"]]
    y = [exact(v) for v in claim["scales"]["y"]]
    assert min(u + y) > 0
    w = found.rows([{("u", i): 1 / u[i]} for i in range(found.inputs)])
    o = found.rows([plus((1 / by, row)) for by, row in zip(y, found.y, strict=True)])
    assert len(u) == found.inputs
    number, kind = exact(claim["supply"]["number"]), claim["supply"]["kind"]
    if kind == "gain":
        assert number > 0
        return [(number * number, [row, row]) for row in w] + [(Fraction(-1), [r, r]) for r in o]
    assert kind == "passivity"
    pairs = [(Fraction(2), [a, b]) for a, b in zip(w, o, strict=True)]
    return pairs + [(-2 * number, [row, row]) for row in w]


def is_proved(model: Json, claim: Json, proof: Json) -> bool:
    found = driven(model, claim.get("box"))
    if claim["supply"]["kind"] == "passivity" and model.get("on_out_of_range") == "clip":
        return False
    names, states, m = found.names(), list(found.states), found.unknowns
    size, n = len(names), len(states)
    P = matrix(proof["P"], n, n)
    fade = exact(claim["discount"])
    if not (0 < fade <= 1 and is_definite(P) and n <= 120):
        return False
    after = found.rows([found.states[name] for name in states])
    M = zeros(size, size)
    for i, j in product(range(size), range(size)):
        grown = sum(
            (after[a][i] * P[a][b] * after[b][j] for a in range(n) if after[a][i]
             for b in range(n)),
            Fraction(0),
        )  # fmt: skip
        M[i][j] = -fade * grown
        if m <= i < m + n and m <= j < m + n:
            M[i][j] += P[i - m][j - m]
    for weight, (a, b) in supplied(found, claim):
        for i, j in product(range(size), range(size)):
            M[i][j] += weight * (a[i] * b[j] + b[i] * a[j]) / 2
    if m == 0:
        return "multipliers" not in proof and is_definite(M)

    def holds(tree: Json, box: Box) -> bool:
        if "split" in tree:
            i = tree["split"]
            assert set(tree) == {"split", "parts"}
            assert found.kept <= i
            low, high = box[i]
            halves = [(low, (low + high) / 2), ((low + high) / 2, high)]
            return all(
                holds(part, [*box[:i], half, *box[i + 1 :]])
                for part, half in zip(tree["parts"], halves, strict=True)
            )
        assert set(tree) == {"N"}
        N = matrix(tree["N"], size, m)
        if found.ray and (N[0][0] < 0 or any(row[0] for row in N[1:])):
            return False
        for vertex in found.hull(box):
            E = found.rows(vertex)
            whole = [row[:] for row in M]
            for i, j in product(range(size), range(size)):
                for k in range(m):
                    whole[i][j] += N[i][k] * E[k][j] + N[j][k] * E[k][i]
            if not is_definite(whole):
                return False
        return True

    return holds(proof["multipliers"], found.box)


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether a document about these files proves its claim, of either kind."""
    try:
        claim = document["claim"]
        if claim["kind"] == "small_gain":
            return is_small(claim, about)
        model = about[claim["about"]["model"]["file"]]
        return is_proved(model, claim, document["proof"])
    except (ArithmeticError, AssertionError, LookupError, StopIteration, TypeError, ValueError):
        return False


def is_small(claim: Json, about: Mapping[str, Json]) -> bool:
    first, second = (about[claim["about"][role]["file"]] for role in ("first", "second"))
    models, product_of_gains = [], Fraction(1)
    for part in (first, second):
        own = part["claim"]
        model = about[own["about"]["model"]["file"]]
        if own["kind"] != "dissipation" or own["supply"]["kind"] != "gain" or "box" in own:
            return False
        if exact(own["discount"]) != 1 or model.get("on_out_of_range", "clip") != "clip":
            return False
        if not is_proved(model, own, part["proof"]):
            return False
        product_of_gains *= exact(own["supply"]["number"])
        models.append((model, own["scales"]))
    for (one_model, one_scales), (other_model, other_scales) in (models, models[::-1]):
        units = [signal["unit"] for signal in signals(one_model["y"])]
        if units != [signal["unit"] for signal in signals(other_model["u"])]:
            return False
        if list(map(exact, one_scales["y"])) != list(map(exact, other_scales["u"])):
            return False
    return models[0][0]["period"] == models[1][0]["period"] and product_of_gains < 1


def signals(given: Any) -> list[Json]:
    return given if isinstance(given, list) else [given]
