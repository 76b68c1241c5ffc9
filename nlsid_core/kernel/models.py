"""Model files in increment form; the first family: equations 0 = h(v, x, w), x⁺ = [v; ã(x, w)].

Of two solutions under one input, E = [∂h/∂v, ∂h/∂x] is averaged on the segment between them, and
so it is in the hull of the Bernstein coefficients of these derivatives on a box that both are in.
Where they depend on the input alone, the box is the model's own range of it; where they are
constant there is none. docs/certificate_stability.md and docs/certificate_tube.md.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import product
from math import comb, prod
from typing import Any

from .exact import MAX_ORDER, Matrix, combined, definite, identity, unit
from .files import Node, Table, Terms, each, itself, limit, one_of, refuse_if, rows_of
from .implicit_models import EQUATIONS, ImplicitModel, derivative, read_implicit_model
from .increments import Box, Hull, Linear, Model, read_recorded, sized
from .networks import read_cascade, read_cells
from .signals import Signal, ranges, read_signal, signals
from .text import PRINTED

MAX_POWER = 20  # of a variable in a monomial of E
MAX_VERTICES = 10**5  # of a box

MatrixTerms = list[tuple[bytes, Matrix]]  # of a matrix polynomial: powers and coefficients


def read_linear(node: Node) -> Model:
    """A `difference_equation`: ŷ = x_1 + b_0 u + c, x⁺ = a ŷ + shift(x) + b_1..n u; no ν."""
    table: Table = {"y": read_signal, "u": read_signal, "a": (None,), "b": (None,), "c": ()}
    given = read_recorded(node, "difference_equation", {**table, "u_range": (2,)})
    a, n, (low, high) = given["a"], sized(len(given["a"]), node), given["u_range"]
    fits = len(given["b"]) == n + 1
    node.require({"b should have one number more than a": fits, "u_range": low <= high})
    direct, *b = given["b"]
    F = [[a_i, *unit(i + 1, n + 1)[1:n]] for i, a_i in enumerate(a)]
    B = [b_i + a_i * direct for a_i, b_i in zip(a, b, strict=True)]
    y, u, H = (given["y"],), (given["u"],), [unit(0, n)]
    none, linear = Hull(lambda _, __: []), Linear(B, direct, (low, high))
    return Model(given["period"], y, u, F, H, none, "for every input", linear)


def read_affine(node: Node) -> Model:
    """A `state_affine` model: 0 = Σ_k G_k(w) ȳ(t-k) + p(w), ν = ȳ(t), E = [G_0 … G_n](w)."""
    table: Table = {
        "y": signals("outputs", 1),
        "u": signals("inputs", 1),
        "window": rows_of(2),
        "G": each(itself, 2),
        "p": itself,
        **dict.fromkeys(("y_offset", "y_scale", "u_offset", "u_scale"), (None,)),
        "u_range": (None, 2),
        "on_out_of_range": one_of("clip", "refuse"),
    }
    given = read_recorded(node, "state_affine", table)
    p, m, window, limits = len(given["y"]), len(given["u"]), given["window"], given["u_range"]
    scales, offsets = given["u_scale"], given["u_offset"]
    node.require(
        {
            "one offset and scale an output": len(given["y_offset"]) == len(given["y_scale"]) == p,
            "one offset, scale and range an input": len(offsets) == len(scales) == len(limits) == m,
            "scales should be positive": min([*given["y_scale"], *scales]) > 0,
            "input ranges should not be empty": all(low < high for low, high in limits),
        }
    )
    size = sized(p * (len(given["G"]) - 1), node)
    _require_window(window, m, len(given["G"]), node)
    G = [_matrix_terms(entry, len(window), p, p) for entry in given["G"]]
    _matrix_terms(given["p"], len(window), p)

    E, box = _side_by_side(G, p), []
    for i, _ in window:
        low, high = ((end - offsets[i]) / scales[i] for end in limits[i])
        box.append((low, high))

    def vertices(part: Box, ends: Node | None) -> list[Matrix]:
        return bernstein(E, part) if ends is None else _between(E, part, ends)

    F = identity(p + size)[:size]  # x⁺ = [ν; all but the oldest of x]
    H = [[scale * entry for entry in unit(i, p + size)] for i, scale in enumerate(given["y_scale"])]
    where = _within(given["on_out_of_range"], given["u"], limits)
    return Model(given["period"], given["y"], given["u"], F, H, Hull(vertices, box), where)


def read_monotone(node: Node) -> Model:
    """A `monotone_equation`: e(ȳ(t)) = affine in the past, E = [e', -a]."""
    table: Table = {
        "y": read_signal,
        "u": signals("inputs"),
        "window": rows_of(2),
        "e": (3,),
        **dict.fromkeys(("a", "b", "u_offset"), (None,)),
        **dict.fromkeys(("c", "y_offset"), ()),
    }
    given = read_recorded(node, "monotone_equation", table)
    e, u, n = given["e"], given["u"], sized(len(given["a"]), node)
    _require_window(given["window"], len(u), None, node)
    fits = len(given["b"]) == len(given["window"]), len(given["u_offset"]) == len(u)
    node.require({"one b an entry of the window": fits[0], "one u_offset an input": fits[1]})
    increases = e[2] > 0 or e[1] == e[2] == 0
    node.require({"e should increase everywhere": increases}, "not_valid")
    only = [[[_least_slope(e), *(-entry for entry in given["a"])]]]
    F, H = identity(n + 1)[:n], [unit(0, n + 1)]
    hull = Hull(lambda _, __: only, ray=e[2] > 0)
    return Model(given["period"], (given["y"],), u, F, H, hull, "for every input")


def read_implicit(node: Node, bounds: Node | None) -> Model:
    """An `implicit` model of recorded signals, y = v: ν = v - v̂.

    Where ∂h is constant, E is one matrix. Where h = e(v) - (affine in x), v one number and e a
    cubic that increases, e' is at least its least slope: a ray. Else both solutions are in a box
    of v, x and w. Their (v, x) may be in two leaves: for one h there is a point between them where
    E ζ = 0 (mean value theorem), whatever leaf it is in; for several there need be none, so only w
    is split.
    """
    model = read_implicit_model(node)
    parts = node.members(f"{EQUATIONS} y u window", "shift centre training bags")
    y, u = signals("outputs")(parts["y"]), signals("inputs")(parts["u"])
    window = parts["window"].wholes(model.inputs, 2)
    p, n, h = model.unknowns, model.states, model.h
    node.require({"one output an equation, and past ones the states": len(y) == p and n % p == 0})
    _require_window(window, len(u), None, node)
    F = identity(p + n)[:p]
    for terms in model.shift:
        linear = all(sum(e) == 1 for e, _ in terms if any(e[:n]))
        node.require({"the shift should be linear in the states": linear})
        slopes = {e.index(1): c for e, c in terms if any(e[:n])}
        F.append([Fraction(slopes.get(j - p, 0)) for j in range(p + n)])

    E, least = _jacobian(h, p + n), _least_cubic(model)
    known = least is not None or not any(any(e) for e, _ in E)
    wanted = "it needs no box" if known else "its increments are known on a box only"
    node.require({wanted: known == (bounds is None)}, "not_valid")
    box = [] if bounds is None else _read_box(model, bounds, window, len(u))

    def vertices(part: Box, ends: Node | None) -> list[Matrix]:
        node.require({"ends are for state-affine models": ends is None})
        return bernstein(E, part) if least is None else [least]

    hull = Hull(vertices, box, ray=least is not None, whole=p + n if p > 1 and box else 0)
    where = "while signals stay in the box" if box else "for every input"
    return Model(model.period, y, u, F, identity(p + n)[:p], hull, where)


def bernstein(E: MatrixTerms, box: Box) -> list[Matrix]:
    """The Bernstein coefficients of E(w) on a box: their convex hull holds its values.

    On [lo, hi], w^e has the coefficient Σ_j C(e, j) lo^(e-j) (hi - lo)^j C(k, j)/C(d, j) at index k
    of degree d. Where they differ in one entry only, the two extreme ones have the same hull.
    """
    degrees = [max(powers[i] for powers, _ in E) for i in range(len(box))]
    limit(prod(d + 1 for d in degrees), MAX_VERTICES, "vertices of a box")
    tables = [
        [[_weight(e, k, d, low, high) for k in range(d + 1)] for e in range(d + 1)]
        for d, (low, high) in zip(degrees, box, strict=True)
    ]
    found: list[Matrix] = []
    for k in product(*(range(d + 1) for d in degrees)):
        value = [[Fraction(0)] * len(row) for row in E[0][1]]
        for powers, coefficients in E:
            factors = (tables[i][e][k[i]] for i, e in enumerate(powers[: len(box)]) if e)
            weight = prod(factors, start=Fraction(1))
            if weight:
                value = combined(value, coefficients, weight)
        found.append(value)

    places = [(i, j) for i, row in enumerate(found[0]) for j in range(len(row))]
    varying = [(i, j) for i, j in places if any(E[i][j] != found[0][i][j] for E in found)]
    if len(varying) > 1:
        return found
    i, j = varying[0] if varying else (0, 0)
    ends = [min(found, key=lambda E: E[i][j]), max(found, key=lambda E: E[i][j])]
    return ends[: 1 + len(varying)]


def _weight(e: int, k: int, d: int, low: Fraction, high: Fraction) -> Fraction:
    parts = (
        comb(e, j) * low ** (e - j) * (high - low) ** j * Fraction(comb(k, j), comb(d, j))
        for j in range(min(e, k) + 1)
    )
    return sum(parts, Fraction(0))


def _between(E: MatrixTerms, box: Box, node: Node) -> list[Matrix]:
    """E at the stated ends of its first entry q, a quadratic; the others are constant.

    low <= q(w) <= high on the box by the S-procedure: with weights a, b >= 0, as forms in [1; w],
        q - low - Σ a_i (w_i - lo_i)(hi_i - w_i) ≻ 0,
        high - q - Σ b_i (w_i - lo_i)(hi_i - w_i) ≻ 0.
    """
    q = [(e, c[0][0]) for e, c in E if c[0][0]]
    others = any(any(e) and any(c[0][1:]) for e, c in E)
    fits = len(E[0][1]) == 1 and not others and all(sum(e) <= 2 for e, _ in q)
    node.require({"ends are for one output, constant lags, and degree 2 at most": fits})
    limit(len(box), MAX_ORDER - 1, f"{node.where}: entries of the box")
    weighted = (len(box),)
    table: Table = {"low": (), "high": (), "low_weights": weighted, "high_weights": weighted}
    given = node.read(table)
    for name, sign in (("low", 1), ("high", -1)):
        weights = given[f"{name}_weights"]
        node.require({"weights should be 0 or more": min(weights) >= 0}, "not_below")
        M = [[Fraction(0)] * (len(box) + 1) for _ in range(len(box) + 1)]
        M[0][0] = -sign * given[name]
        for e, c in q:
            used = [i + 1 for i, power in enumerate(e) for _ in range(power)]
            i, j = [0] * (2 - len(used)) + used
            M[i][j] += sign * c / 2
            M[j][i] += sign * c / 2
        for i, (weight, (low, high)) in enumerate(zip(weights, box, strict=True), 1):
            M[0][0] += weight * low * high
            M[i][i] += weight
            M[0][i] -= weight * (low + high) / 2
            M[i][0] -= weight * (low + high) / 2
        definite(M, f"the {name} end of the leading coefficient")
    lags = [sum((c[0][j] for _, c in E), Fraction(0)) for j in range(1, len(E[0][1][0]))]
    return [[[given[end], *lags]] for end in ("low", "high")]


def _least_slope(e: Sequence[Fraction]) -> Fraction:
    """The least slope of e_1 v + e_2 v² + e_3 v³, for e_3 > 0 or e_2 = e_3 = 0."""
    return e[0] - e[1] ** 2 / (3 * e[2]) if e[2] else e[0]


def _least_cubic(model: ImplicitModel) -> Matrix | None:
    """[min e', -a] of one equation e(v) = a'x + (terms in w), e an increasing cubic; else None."""
    if model.unknowns != 1:
        return None
    n, cubic, slopes = model.states, [Fraction(0)] * 3, [Fraction(0)] * (1 + model.states)
    for powers, c in model.h[0]:
        v, x, w = powers[0], powers[1 : 1 + n], powers[1 + n :]
        if v and v <= 3 and not any(x) and not any(w):
            cubic[v - 1] += c
        elif not v and sum(x) == 1 and not any(w):
            slopes[1 + x.index(1)] += c
        elif v or any(x):
            return None
    slopes[0] = _least_slope(cubic)
    return [slopes] if cubic[2] > 0 else None


def _read_box(model: ImplicitModel, bounds: Node, window: list[list[int]], inputs: int) -> Box:
    """The box of (v, x, w), from ranges of outputs and inputs; x stacks past outputs."""
    p, n, ends = model.unknowns, model.states, bounds.members("y u")
    y_box, u_box = ends["y"].array(p, 2), ends["u"].array(inputs, 2)
    full = all(low < high for low, high in [*y_box, *u_box])
    bounds.require({"no range should be empty": full}, "not_valid")
    for i, terms in enumerate(model.shift):  # else a state is no output: it has another range
        same = [(bytes(int(j == i) for j in range(n + model.inputs)), Fraction(1))]
        bounds.require({"on a box the states should be the past outputs": terms == same})
    rows = [*y_box, *y_box * (n // p), *(u_box[i] for i, _ in window)]
    return [(low, high) for low, high in rows]


def _jacobian(rows: Sequence[Terms], variables: int) -> MatrixTerms:
    """The derivatives of polynomials by their first variables, as a matrix polynomial."""
    entries = [
        (powers, i, j, c)
        for i, row in enumerate(rows)
        for j in range(variables)
        for powers, c in derivative(row, j)
    ]
    refuse_if(not entries, "the model's equation does not depend on its output")
    most = max(power for powers, *_ in entries for power in powers)
    limit(most, MAX_POWER, "the power of a variable")
    return _collected(entries, len(rows), variables)


def _side_by_side(G: Sequence[MatrixTerms], rows: int) -> MatrixTerms:
    """[G_0 … G_n] as one matrix polynomial."""
    entries = [
        (powers, i, k * rows + j, entry)
        for k, terms in enumerate(G)
        for powers, block in terms
        for i, row in enumerate(block)
        for j, entry in enumerate(row)
    ]
    return _collected(entries, rows, rows * len(G))


def _collected(
    entries: Sequence[tuple[bytes, int, int, Fraction]], rows: int, columns: int
) -> MatrixTerms:
    """The matrix polynomial with these entries: powers, row, column, coefficient."""
    found: dict[bytes, Matrix] = {}
    for powers, i, j, c in entries:
        found.setdefault(powers, [[Fraction(0)] * columns for _ in range(rows)])[i][j] += c
    return sorted(found.items())


def _matrix_terms(node: Node, variables: int, *shape: int) -> MatrixTerms:
    parts = node.members("exponents coefficients")
    exponents = parts["exponents"].monomials(variables)
    coefficients = parts["coefficients"].array(len(exponents), *shape)
    fits = exponents and all(power <= MAX_POWER for row in exponents for power in row)
    node.require({f"monomials are missing, or a power is above {MAX_POWER}": fits})
    return list(zip(exponents, coefficients, strict=True))


def _require_window(window: Any, inputs: int, delays: int | None, node: Node) -> None:
    """Of rows (input, delay), delays below `delays` if there is such a bound."""
    known = all(0 <= i < inputs and 0 <= d < (delays or d + 1) for i, d in window)
    node.require({"the window should name inputs and delays that are there": known})


def _within(beyond: str, u: Sequence[Signal], limits: Sequence[Sequence[Fraction]]) -> str:
    """For which inputs, in words: the model's range of them."""
    shown = ranges(u, list(map(PRINTED["inner_range"], limits)))
    if beyond == "clip":
        return f"for every input (the model clips its inputs: {shown})"
    return f"for every input in the model's range ({shown}; it refuses others)"


READERS: dict[str, Callable[[Node], Model]] = {
    "difference_equation": read_linear,
    "state_affine": read_affine,
    "monotone_equation": read_monotone,
    "block_cascade": read_cascade,
    "cell_network": read_cells,
}


def read_model(node: Node, bounds: Node | None = None) -> Model:
    """The increment form of a model file's content.

    bounds: {y, u}, of the outputs and inputs of an implicit model that has no global form.
    """
    kind = node.kind()
    if kind == "implicit":
        return read_implicit(node, bounds)
    refuse_if(kind not in READERS, f"{node.where}: no model kind {kind!r} is known")
    refuse_if(bounds is not None, f"a model of kind {kind} needs no box")
    return READERS[kind](node)
