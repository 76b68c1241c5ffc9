"""The first family of models: polynomial equations 0 = h(v, x, w), x⁺ = [v; ã(x, w)].

Of two solutions under one input, E = [∂h/∂v, ∂h/∂x] is averaged on the segment between them, and
so it is in the hull of the Bernstein coefficients of these derivatives on a box that both are in.
Where they depend on the input alone, the box is the model's own range of it; where they are
constant there is none. docs/certificate_stability.md and docs/certificate_tube.md.
"""

from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from math import comb, prod

from .exact import MAX_ORDER, Matrix, combined, definite, unit
from .files import Node, Rejected, Terms, refuse_if
from .implicit_models import IMPLICIT, ImplicitModel, derivative, read_implicit_model
from .increments import Box, Hull, Linear, Model, read_recorded, sized
from .signals import Signal, ranges, read_signal, read_signals
from .text import PRINTED

MAX_POWER = 20  # of a variable in a monomial of E
MAX_VERTICES = 10**5  # of a box

MatrixTerms = list[tuple[bytes, Matrix]]  # of a matrix polynomial: powers and coefficients


def read_linear(node: Node) -> Model:
    """A `difference_equation`: ŷ = x_1 + b_0 u + c, x⁺ = a ŷ + shift(x) + b_1..n u; no ν."""
    parts, period = read_recorded(node, "difference_equation", "y u a b c u_range")
    a = parts["a"].array(None)
    n = sized(len(a), parts["a"])
    direct, *b = parts["b"].array(n + 1)
    parts["c"].number()
    low, high = parts["u_range"].array(2)
    refuse_if(low > high, f"{node.where} u_range is empty")
    F = [[a_i, *unit(i + 1, n + 1)[1:n]] for i, a_i in enumerate(a)]
    linear = Linear(
        [b_i + a_i * direct for a_i, b_i in zip(a, b, strict=True)], direct, (low, high)
    )
    y, u = (read_signal(parts["y"]),), (read_signal(parts["u"]),)
    none = Hull(lambda _, __: [])
    return Model(period, y, u, F, [unit(0, n)], none, "for every input", linear)


def read_affine(node: Node) -> Model:
    """A `state_affine` model: 0 = Σ_k G_k(w) ȳ(t-k) + p(w), ν = ȳ(t), E = [G_0 … G_n](w)."""
    names = "y u window G p y_offset y_scale u_offset u_scale u_range on_out_of_range"
    parts, period = read_recorded(node, "state_affine", names)
    y, u = read_signals(parts["y"], "outputs", 1), read_signals(parts["u"], "inputs", 1)
    p, n_u, window = len(y), len(u), parts["window"].wholes(None, 2)
    size = sized(p * (len(parts["G"].items(2)) - 1), node)
    G = [_matrix_terms(entry, len(window), p, p) for entry in parts["G"].items()]
    _matrix_terms(parts["p"], len(window), p)
    parts["y_offset"].array(p)
    y_scale, u_scale = parts["y_scale"].array(p), parts["u_scale"].array(n_u)
    limits, offsets = parts["u_range"].array(n_u, 2), parts["u_offset"].array(n_u)
    refuse_if(
        min(y_scale + u_scale) <= 0 or any(low >= high for low, high in limits),
        f"{node.where}: scales should be positive and input ranges not empty",
    )
    refuse_if(
        any(not (0 <= i < n_u and 0 <= d < len(G)) for i, d in window),
        f"{node.where} window names inputs or delays that are not there",
    )

    own = [tuple((end - offsets[i]) / u_scale[i] for end in limits[i]) for i, _ in window]
    box = [(low, high) for low, high in own]
    E = _side_by_side(G, p)

    def vertices(part: Box, ends: Node | None) -> list[Matrix]:
        return bernstein(E, part) if ends is None else _between(E, part, ends)

    F = [unit(i, p + size) for i in range(size)]  # x⁺ = [ν; all but the oldest of x]
    H = [[y_scale[i] * entry for entry in unit(i, p + size)] for i in range(p)]
    where = _within(parts["on_out_of_range"].text(), u, limits)
    return Model(period, y, u, F, H, Hull(vertices, box), where)


def read_monotone(node: Node) -> Model:
    """A `monotone_equation`: e(ȳ(t)) = affine in the past, E = [e', -a]."""
    parts, period = read_recorded(node, "monotone_equation", "y u e a b c window y_offset u_offset")
    e, a = parts["e"].array(3), parts["a"].array(None)
    n, u = sized(len(a), parts["a"]), read_signals(parts["u"], "inputs")
    window = parts["window"].wholes(None, 2)
    parts["b"].array(len(window))
    parts["u_offset"].array(len(u))
    parts["c"].number()
    parts["y_offset"].number()
    _refuse_window(window, len(u), node)
    refuse_if(
        e[2] < 0 or (e[2] == 0 and e[1] != 0),
        f"{node.where} e is not increasing everywhere",
        "not_valid",
    )
    only = [[[_least_slope(e), *(-entry for entry in a)]]]
    F, H = [unit(i, n + 1) for i in range(n)], [unit(0, n + 1)]
    hull = Hull(lambda _, __: only, ray=e[2] > 0)
    return Model(period, (read_signal(parts["y"]),), u, F, H, hull, "for every input")


def read_implicit(node: Node, bounds: Node | None) -> Model:
    """An `implicit` model of recorded signals, y = v: ν = v - v̂.

    Where ∂h is constant, E is one matrix. Where h = e(v) - (affine in x), v one number and e a
    cubic that increases, e' is at least its least slope: a ray. Else both solutions are in a box
    of v, x and w. Their (v, x) may be in two leaves: for one h there is a point between them where
    E ζ = 0 (mean value theorem), whatever leaf it is in; for several there need be none, so only w
    is split.
    """
    given = read_implicit_model(node)
    parts = node.members(f"format version kind {IMPLICIT} y u window", "shift centre training bags")
    y, u = read_signals(parts["y"], "outputs"), read_signals(parts["u"], "inputs")
    window = parts["window"].wholes(given.inputs, 2)
    p, n = given.unknowns, given.states
    refuse_if(len(y) != p or n % p, f"{node.where}: outputs and states do not fit")
    _refuse_window(window, len(u), node)
    F = [unit(i, p + n) for i in range(p)]
    for terms in given.shift:
        refuse_if(
            any(sum(e) > 1 and any(e[:n]) for e, _ in terms),
            f"{node.where}: the shift should be linear in the states",
        )
        linear = {e.index(1): c for e, c in terms if any(e[:n])}
        F.append([Fraction(linear.get(j - p, 0)) for j in range(p + n)])

    E = _jacobian(given.h, p + n)
    constant, least = all(not any(e) for e, _ in E), _least_cubic(given)
    known = constant or least is not None
    if known != (bounds is None):
        wanted = "needs no box: they are known everywhere" if known else "are known on a box only"
        raise Rejected(f"{node.where}: the increments of this model, which {wanted}", "not_valid")
    where, box = (
        "for every input",
        [] if bounds is None else _read_box(given, bounds, window, len(u)),
    )
    if box:
        where = "while signals stay in the box"

    def vertices(part: Box, ends: Node | None) -> list[Matrix]:
        refuse_if(ends is not None, f"{node.where}: ends are for state-affine models")
        return bernstein(E, part) if least is None else [least]

    hull = Hull(vertices, box, ray=least is not None, whole=p + n if p > 1 and box else 0)
    return Model(given.period, y, u, F, [unit(i, p + n) for i in range(p)], hull, where)


def bernstein(E: MatrixTerms, box: Box) -> list[Matrix]:
    """The Bernstein coefficients of E(w) on a box: their convex hull holds its values.

    On [lo, hi], w^e has the coefficient Σ_j C(e, j) lo^(e-j) (hi - lo)^j C(k, j)/C(d, j) at index k
    of degree d. Where they differ in one entry only, the two extreme ones have the same hull.
    """
    degrees = [max(powers[i] for powers, _ in E) for i in range(len(box))]
    refuse_if(
        prod(d + 1 for d in degrees) > MAX_VERTICES,
        f"a box with more than {MAX_VERTICES} vertices",
        "too_large",
    )
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
    refuse_if(
        len(E[0][1]) != 1 or any(any(e) and any(c[0][1:]) for e, c in E),
        f"{node.where}: ends are for one output whose lags have constant factors",
    )
    refuse_if(
        any(sum(e) > 2 for e, _ in q),
        f"{node.where}: ends are for a leading coefficient of degree 2 at most",
    )
    refuse_if(
        len(box) >= MAX_ORDER,
        f"{node.where}: at most {MAX_ORDER - 1} entries of the box",
        "too_large",
    )
    parts = node.members("low high low_weights high_weights")
    ends = parts["low"].number(), parts["high"].number()
    for name, sign, end in (("low", 1, ends[0]), ("high", -1, ends[1])):
        weights = parts[f"{name}_weights"].array(len(box))
        refuse_if(min(weights) < 0, f"{node.where}: weights should be 0 or more", "not_below")
        M = [[Fraction(0)] * (len(box) + 1) for _ in range(len(box) + 1)]
        M[0][0] = -sign * end
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
    return [[[end, *lags]] for end in ends]


def _least_slope(e: Sequence[Fraction]) -> Fraction:
    """The least slope of e_1 v + e_2 v² + e_3 v³, for e_3 > 0 or e_2 = e_3 = 0."""
    return e[0] - e[1] ** 2 / (3 * e[2]) if e[2] else e[0]


def _least_cubic(model: ImplicitModel) -> Matrix | None:
    """[min e', -a] of one equation e(v) = a'x + (terms in w), e an increasing cubic; else None."""
    if model.unknowns != 1:
        return None
    n, e = model.states, [Fraction(0)] * 3
    E = [Fraction(0)] * (1 + n)
    for powers, c in model.h[0]:
        ours, v = powers[: 1 + n], powers[0]
        if any(ours) and (any(powers[1 + n :]) or (v and any(ours[1:])) or v > 3):
            return None
        if v:
            e[v - 1] += c
        elif sum(ours) > 1:
            return None
        elif any(ours):
            E[ours.index(1)] += c
    return [[_least_slope(e), *E[1:]]] if e[2] > 0 else None


def _read_box(model: ImplicitModel, bounds: Node, window: list[list[int]], inputs: int) -> Box:
    """The box of (v, x, w), from ranges of outputs and inputs; x stacks past outputs."""
    p, n, ends = model.unknowns, model.states, bounds.members("y u")
    y_box, u_box = ends["y"].array(p, 2), ends["u"].array(inputs, 2)
    refuse_if(
        any(low >= high for low, high in [*y_box, *u_box]),
        f"{bounds.where}: a range is empty",
        "not_valid",
    )
    for i, terms in enumerate(model.shift):  # else a state is no output: it has another range
        refuse_if(
            terms != [(bytes(int(j == i) for j in range(n + model.inputs)), Fraction(1))],
            f"{bounds.where}: on a box, the states should be the past outputs",
        )
    rows = [*y_box, *y_box * (n // p), *(u_box[i] for i, _ in window)]
    return [(low, high) for low, high in rows]


def _jacobian(rows: Sequence[Terms], variables: int) -> MatrixTerms:
    """The derivatives of polynomials by their first variables, as a matrix polynomial."""
    found: dict[bytes, Matrix] = {}
    for i, row in enumerate(rows):
        for j in range(variables):
            for powers, c in derivative(row, j):
                refuse_if(
                    max(powers, default=0) > MAX_POWER,
                    f"powers should be from 0 to {MAX_POWER}",
                    "too_large",
                )
                entry = found.setdefault(powers, [[Fraction(0)] * variables for _ in rows])
                entry[i][j] += c
    refuse_if(not found, "the model's equation does not depend on its output")
    return sorted(found.items())


def _side_by_side(G: Sequence[MatrixTerms], rows: int) -> MatrixTerms:
    """[G_0 … G_n] as one matrix polynomial."""
    found: dict[bytes, Matrix] = {}
    for k, terms in enumerate(G):
        for powers, block in terms:
            entry = found.setdefault(powers, [[Fraction(0)] * (rows * len(G)) for _ in range(rows)])
            for i, row in enumerate(block):
                entry[i][k * rows : (k + 1) * rows] = row
    return sorted(found.items())


def _matrix_terms(node: Node, variables: int, *shape: int) -> MatrixTerms:
    parts = node.members("exponents coefficients")
    exponents = parts["exponents"].monomials(variables)
    coefficients = parts["coefficients"].array(len(exponents), *shape)
    refuse_if(
        not exponents or any(power > MAX_POWER for row in exponents for power in row),
        f"{node.where} should have monomials, with powers from 0 to {MAX_POWER}",
    )
    return list(zip(exponents, coefficients, strict=True))


def _refuse_window(window: list[list[int]], inputs: int, node: Node) -> None:
    refuse_if(
        any(not (0 <= i < inputs and d >= 0) for i, d in window),
        f"{node.where} window names inputs or delays that are not there",
    )


def _within(beyond: str, u: Sequence[Signal], limits: Sequence[Sequence[Fraction]]) -> str:
    """For which inputs, in words: the model's range of them."""
    refuse_if(
        beyond not in ("clip", "refuse"), f"on_out_of_range is {beyond!r}; known: clip, refuse"
    )
    shown = ranges(u, list(map(PRINTED["inner_range"], limits)))
    if beyond == "clip":
        return f"for every input (the model clips its inputs: {shown})"
    return f"for every input in the model's range ({shown}; it refuses others)"
