"""The increment form of an identified model: how two of its solutions under one input differ.

With ζ = (ν, x̄), x̄ the difference of the states and ν those of quantities that the model defines by
an equation,
    E(θ) ζ = 0,    x̄⁺ = F ζ,    o = H ζ,    E(θ) in the convex hull of finitely many matrices,
plus multiples of [1, 0] where the form has a ray. θ is what is not known: the input where the model
is affine in its outputs, the slope of a nonlinearity elsewhere. A quadratic form that is positive
at each of the matrices is so at every E(θ). docs/certificate_stability.md has the forms and why.

Driven, the two solutions have inputs of their own: x̄ has the past inputs that the model remembers
too, w̄ is the difference of the present ones, and its columns are the last of E, F and H.
docs/certificate_dissipation.md.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

from . import text
from .exact import Matrix, combined, definite, transposed
from .exact import product as times
from .files import Node, Rejected
from .implicit_models import MEMBERS, ImplicitModel, read_implicit_model
from .matrix_polynomials import Box, Terms, bernstein, between, effort, side_by_side
from .polynomials import Work
from .signals import Signal, read_signal, read_signals, within
from .terms import derivative

MAX_STATES = 120
MAX_PHASES = 8  # a cascade or a network has 2^phases or 2^maps matrices
MAX_POWER = 20  # of a variable of the window in a monomial
MAX_WORK = 2 * 10**8  # order³ + MATRIX over all matrices of a claim: about a minute
MATRIX = 500  # what deciding one costs at the least
MAX_SLOPES = 10**7  # entries of all coefficients of ∂h/∂(v, x), in which a term may occur often
MAX_SPLITS = 40  # of one box, one inside the other

Polynomial = list[tuple[tuple[int, ...], Fraction]]


@dataclass(frozen=True)
class Linear:
    """x⁺ = A x + B u + f, y = x_1 + D u + c, in the increment form's own state."""

    B: list[Fraction]
    D: Fraction
    f: list[Fraction]
    input_range: tuple[Fraction, Fraction]


@dataclass(frozen=True)
class Model:
    """A model file in increment form.

    F: (n, m + n), H: (p, m + n) for m quantities ν. vertices: matrices E, each (m, m + n), whose
    convex hull holds E(θ) for θ in a box inside `box`, perhaps by stated ends. ray: E(θ) may have
    any multiple of [1, 0] added. inputs: for which inputs this is so, in words. whole: so many
    entries of the box, the first, cannot be split. driven: so many columns more, those of w̄.
    limits: none, `clip` or `refuse`, what the model does with inputs beyond its range.
    """

    period: Fraction
    y: tuple[Signal, ...]
    u: tuple[Signal, ...]
    F: Matrix
    H: Matrix
    inputs: str
    box: Box
    vertices: Callable[[Box, Node | None], list[Matrix]]
    ray: bool = False
    linear: Linear | None = None
    effort: int = 0  # of finding the vertices, in products
    whole: int = 0
    driven: int = 0
    limits: str = ""

    @property
    def states(self) -> int:
        """n."""
        return len(self.F)

    @property
    def unknowns(self) -> int:
        """m."""
        return len(self.F[0]) - len(self.F) - self.driven


def positive(
    model: Model, multipliers: Node | None, forms: Sequence[tuple[str, Matrix]], work: Work
) -> None:
    """Raise Rejected unless M + sym(N [E 0]) ≻ 0 for each form (what, M), at every vertex E.

    work: MAX_WORK of a claim, shared by all that it decides. M is of order m + n or more.
    `multipliers` is a leaf {N}, N of M's order × m, a list of one for each form if there are
    several; or {split, parts}: the variable of the box that is halved, and the multipliers of the
    lower and of the upper half. A leaf may state `ends` beside N: bounds of the one entry of E that
    varies, in the place of the vertices (`between`).
    """
    m, size = model.unknowns, len(forms[0][1])
    if multipliers is None:
        if m:
            raise Rejected("the proof needs multipliers for this class of models")
        for what, M in forms:
            definite(M, what)
        return
    if not m:
        raise Rejected("this class of models has no multipliers")
    slow = f"{forms[0][0]} takes too long to decide: too many"
    for box, leaf in _leaves(multipliers, model.box, model.whole, 0):
        given = leaf["N"]
        Ns = given.array(len(forms), size, m) if len(forms) > 1 else [given.array(size, m)]
        if model.ray and any(N[0][0] < 0 or any(row[0] for row in N[1:]) for N in Ns):
            raise Rejected("the multiplier of an unbounded slope should be (T, 0, ..., 0), T >= 0")
        work.spend(30 * model.effort, f"{slow} coefficients")
        for E in model.vertices(box, leaf.get("ends")):
            work.spend(len(forms) * (size**3 + MATRIX), f"{slow} matrices")
            wide = [row + [Fraction(0)] * (size - len(row)) for row in E]
            for (what, M), N in zip(forms, Ns, strict=True):
                cross = times(N, wide)
                definite(combined(M, combined(cross, transposed(cross))), what)


def _leaves(node: Node, box: Box, whole: int, depth: int) -> Iterator[tuple[Box, dict[str, Node]]]:
    parts = node.members("", "N ends split parts")
    if set(parts) == {"N"} or (set(parts) == {"N", "ends"} and box):
        yield box, parts
        return
    if set(parts) != {"split", "parts"} or not box:
        raise Rejected(
            f"{node.where} should be a multiplier N, or the split of a box and its parts"
        )
    if depth == MAX_SPLITS:
        raise Rejected(f"{node.where}: more than {MAX_SPLITS} splits, one inside the other")
    i = parts["split"].whole(whole, len(box) - 1)
    low, high = box[i]
    halves = ((low, (low + high) / 2), ((low + high) / 2, high))
    for half, part in zip(halves, parts["parts"].items(2, 2), strict=True):
        yield from _leaves(part, [*box[:i], half, *box[i + 1 :]], whole, depth + 1)


def read_model(node: Node, bounds: Node | None = None, *, driven: bool = False) -> Model:
    """The increment form of a model file's content, of one input or, driven, of two.

    bounds: {y, u}, of the outputs and inputs of an implicit model that has no global form; {y} of a
    driven state-affine one whose factors of the outputs depend on the inputs.
    """
    kind = node.kind()
    if kind not in (*_READERS, "implicit"):
        known = ", ".join([*_READERS, "implicit"])
        raise Rejected(f"{node.where}: kind is {kind!r}; known: {known}")
    if kind == "implicit":
        model = _implicit(node, bounds, driven)
    elif kind == "state_affine" and driven:
        model = _state_affine(node, driven, bounds)
    elif bounds is None:
        model = _READERS[kind](node, driven)
    else:
        raise Rejected(f"a model of kind {kind} needs no box: its increments are known everywhere")
    if not 0 < model.states <= MAX_STATES:
        raise Rejected(f"{node.where}: {model.states} states; 1 to {MAX_STATES} are decided")
    return model


def _difference_equation(node: Node, driven: bool) -> Model:
    """ŷ = x_1 + b_0 u + c, x⁺ = a ŷ + shift(x) + b_1..n u: no ν, F = A, H = [1, 0 ...]."""
    parts = _members(node, "y u a b c u_range")
    a = parts["a"].array(None)
    n = _size(len(a), parts["a"])
    direct, *b = parts["b"].array(n + 1)
    c = parts["c"].number()
    low, high = parts["u_range"].array(2)
    if low > high:
        raise Rejected(f"{node.where} u_range is empty")
    A = [[a[i] if j == 0 else Fraction(int(j == i + 1)) for j in range(n)] for i in range(n)]
    B = [b_i + a_i * direct for a_i, b_i in zip(a, b, strict=True)]
    model = Model(
        _period(parts), (read_signal(parts["y"]),), (read_signal(parts["u"]),),
        A, [_unit(0, n)], "for every input", [], lambda _, __: [],
        linear=Linear(B, direct, [a_i * c for a_i in a], (low, high)),
    )  # fmt: skip
    return _driven(model, [(0, 0)], [[b_i] for b_i in B], [[direct]]) if driven else model


def _state_affine(node: Node, driven: bool, bounds: Node | None) -> Model:
    """0 = Σ_k G_k(w) ȳ(t-k) + p(w): x stacks ȳ(t-1) … ȳ(t-n), ν = ȳ(t), E = [G_0 … G_n](w).

    Driven, E is the mean of the equation's derivatives between two (ȳ, w), with ȳ in a box where
    they depend on it.
    """
    parts = _members(
        node,
        "y u window G p y_offset y_scale u_offset u_scale u_range on_out_of_range",
    )
    y, u = read_signals(parts["y"], "outputs", 1), read_signals(parts["u"], "inputs", 1)
    p, n_u = len(y), len(u)
    window = parts["window"].wholes(None, 2)
    size = _size(p * (len(parts["G"].items(2)) - 1), parts["G"])
    G = [_polynomials(entry, len(window), p, p) for entry in parts["G"].items()]
    drive: Any = _polynomials(parts["p"], len(window), p)  # of vectors
    parts["y_offset"].array(p)
    y_scale, u_scale = parts["y_scale"].array(p), parts["u_scale"].array(n_u)
    ranges, offsets = parts["u_range"].array(n_u, 2), parts["u_offset"].array(n_u)
    if min(y_scale + u_scale) <= 0 or any(low >= high for low, high in ranges):
        raise Rejected(f"{node.where}: scales should be positive and input ranges not empty")
    if any(not (0 <= i < n_u and 0 <= d < len(G)) for i, d in window):
        raise Rejected(f"{node.where} window names inputs or delays that are not there")
    box = [tuple((end - offsets[i]) / u_scale[i] for end in ranges[i]) for i, _ in window]
    F = [_unit(i, p + size) for i in range(size)]  # x⁺ = [ν; all but the oldest of x]
    H = [[y_scale[i] * entry for entry in _unit(i, p + size)] for i in range(p)]
    limits = parts["on_out_of_range"].text()
    inputs = _inputs_in_range(limits, u, ranges)
    if driven:
        reach = None if bounds is None else bounds.members("y")["y"].array(p, 2)
        if reach is not None and any(low >= high for low, high in reach):
            raise Rejected(f"{node.where}: a range of the box is empty")
        E = _with_inputs(G, drive, [u_scale[i] for i, _ in window])
        if any(any(e[: p + size]) for e, _ in E) != (reach is not None):
            raise Rejected(
                f"{node.where}: for two inputs it needs a box of its outputs where the factors of "
                "its outputs depend on its inputs, and none elsewhere"
            )
        if reach is None:
            E = [(e[p + size :], block) for e, block in E]
        else:
            of = zip(reach, parts["y_offset"].array(p), y_scale, strict=True)
            box = [tuple((end - o) / by for end in row) for row, o, by in of] * len(G) + box
    else:
        E = side_by_side(G, p)

    def vertices(part: Box, ends: Node | None) -> list[Matrix]:
        if ends is not None and driven:
            raise Rejected(f"{ends.where}: ends are for two solutions under one input")
        return bernstein(E, part) if ends is None else between(G, part, ends)

    model = Model(
        _period(parts), y, u, F, H, inputs, [(low, high) for low, high in box], vertices,
        effort=effort(E, [(low, high) for low, high in box]),
        whole=len(box) if driven and p > 1 else 0, limits=limits,
    )  # fmt: skip
    return _driven(model, window) if driven else model


def _with_inputs(G: list[Terms], drive: Any, scales: list[Fraction]) -> Terms:
    """The derivatives of Σ G_k(w) ȳ_k + p(w) by ȳ and by the inputs behind w, in (ȳ, w)."""
    p, size = len(G[0][0][1]), len(G[0][0][1]) * len(G)
    _refuse_slopes(sum(map(len, G)) * p**2 + len(drive) * p, p, size + len(scales))
    rows: list[Polynomial] = [
        [((*_powers(k * p + j, size), *e), c[i][j]) for k, g in enumerate(G) for e, c in g
         for j in range(p)] + [((*[0] * size, *e), c[i]) for e, c in drive]
        for i in range(p)
    ]  # fmt: skip
    per = [Fraction(1)] * size + [1 / scale for scale in scales]
    found = _jacobian(rows, range(len(per)))
    return [(e, [[c * by for c, by in zip(row, per, strict=True)] for row in block])
            for e, block in found]  # fmt: skip


def _block_cascade(node: Node, driven: bool) -> Model:
    """Two linear filters around a spline: ν_j = f(x_j) - f(x̂_j), E = [I, -diag(s_j) C_j, 0].

    x stacks v(t-1) … v(t-n₁) of the first filter and the observer form of the second. f' is a
    convex combination of (c_{j+1} - c_j)/spacing everywhere, and constant beyond the knots.
    """
    parts = _members(node, "y u a1 b1 f a2 b2")
    a1, a2 = parts["a1"].array(None), parts["a2"].array(None)
    b1, b2 = parts["b1"].array(None, None), parts["b2"].array(None, None)
    M = len(b1)
    if not 0 < M <= MAX_PHASES or len(b2) != M:
        raise Rejected(f"{node.where}: b1 and b2 should have as many rows, 1 to {MAX_PHASES}")
    if any(len(row) != len(rows[0]) or not row for rows in (b1, b2) for row in rows):
        raise Rejected(f"{node.where}: the rows of b1, and of b2, should have equal lengths")
    spline = parts["f"].members("low spacing coefficients")
    spline["low"].number()
    spacing, c = spline["spacing"].number(), spline["coefficients"].array(None)
    if spacing <= 0 or len(c) < 4:
        raise Rejected(f"{node.where} f: a positive spacing and 4 coefficients or more")
    slopes = [(after - before) / spacing for before, after in pairwise(c)]
    least, most = min(slopes), max(slopes)
    n1, n2 = max(len(a1), len(b1[0]) - 1), max(len(a2), len(b2[0]) - 1)
    n = _size(n1 + n2, node)
    a1, a2 = _padded(a1, n1), _padded(a2, n2)
    F = [[Fraction(0)] * M + a1 + [Fraction(0)] * n2] if n1 else []
    F += [_unit(M + k, M + n) for k in range(n1 - 1)]
    # x_j = b1_j0 v(t) + … with v(t) = u + a1·past gives C_j; the same way behind f gives g_j.
    C = [[row[0] * a + b for a, b in zip(a1, _padded(row[1:], n1), strict=True)] for row in b1]
    g = [[row[0] * a + b for a, b in zip(a2, _padded(row[1:], n2), strict=True)] for row in b2]
    for i in range(n2):
        row = [g[j][i] for j in range(M)] + [Fraction(0)] * n1 + _unit(i + 1, n2 + 1)[:n2]
        row[M + n1] += a2[i]
        F.append(row)
    H = [row[0] for row in b2] + [Fraction(0)] * n1 + _unit(0, n2)

    def corners(_: Box, __: Node | None) -> list[Matrix]:
        return [
            [
                _unit(j, M) + [-s[j] * entry for entry in C[j]] + [Fraction(0)] * n2
                + [-s[j] * b1[j][0]] * driven
                for j in range(M)
            ]
            for s in product(sorted({least, most}), repeat=M)
        ]  # fmt: skip

    covered = f"[{text.below(least)}, {text.above(most)}]"
    model = Model(
        _period(parts), (read_signal(parts["y"]),), (read_signal(parts["u"]),), F, [H],
        f"for every input (the slopes of its nonlinearity are in {covered} everywhere)",
        [], corners,
    )  # fmt: skip
    into = [[one] for one in _unit(0, n)] if n1 else None  # of u(t): v(t) is the first state
    return _driven(model, [(0, 0)], into) if driven else model


def _cell_network(node: Node, driven: bool) -> Model:
    """ν_j = f_j(into_j·s), x⁺ = next·s, y = output·s with s = [ν, x, u, 1]: E = [I - S_ν, -S_x].

    S = diag(σ) into, σ_j between the least and the largest slope of f_j, linear between its knots
    and on beyond them. into is strictly lower triangular in ν, so every output is determined.
    """
    parts = _members(node, "y u maps into next output start start_samples")
    y, u = read_signals(parts["y"], "outputs", 1), read_signals(parts["u"], "inputs")
    ends = [_slope_range(f) for f in parts["maps"].items(1, MAX_PHASES)]
    m, n = len(ends), _size(len(parts["start"].array(None)), parts["start"])
    parts["start_samples"].whole(1)
    width = m + n + len(u) + 1
    into = parts["into"].array(m, width)
    F, H = parts["next"].array(n, width), parts["output"].array(len(y), width)
    known = m + n + len(u) * driven
    if any(any(row[j:m]) for j, row in enumerate(into)):
        raise Rejected(f"{node.where} into: a map should depend on earlier maps only")

    def corners(_: Box, __: Node | None) -> list[Matrix]:
        return [
            [
                [one - slope * entry for one, entry in zip(_unit(j, known), into[j], strict=False)]
                for j, slope in enumerate(slopes)
            ]
            for slopes in product(*ends)
        ]

    model = Model(
        _period(parts), y, u, [row[: m + n] for row in F], [row[: m + n] for row in H],
        "for every input", [], corners,
    )  # fmt: skip
    present, direct = ([row[m + n : -1] for row in rows] for rows in (F, H))
    return _driven(model, [(i, 0) for i in range(len(u))], present, direct) if driven else model


def _driven(
    model: Model,
    window: Sequence[Sequence[int]],
    F_w: Matrix | None = None,
    H_w: Matrix | None = None,
) -> Model:
    """The form with past inputs in its state, and with w̄ behind it.

    `model` is the form in which the window's entries, input i at delay d for each (i, d), are the
    last columns of `vertices`; F_w and H_w are those of F and H, zero if they are not given.
    """
    inputs = range(len(model.u))
    reach = [max((d for j, d in window if j == i), default=0) for i in inputs]
    if len(model.F) + sum(reach) > MAX_STATES:
        what = f"{len(model.F)} states and {sum(reach)} remembered inputs"
        raise Rejected(f"the model has {what}; 1 to {MAX_STATES} together are decided")
    past = [(i, d) for i in inputs for d in range(1, reach[i] + 1)]
    columns = [*past, *((i, 0) for i in inputs)]
    chosen = [_unit(columns.index((i, d)), len(columns)) for i, d in window]

    def wide(rows: Matrix, more: Matrix | None) -> Matrix:
        if more is None:
            return [row + [Fraction(0)] * len(columns) for row in rows]
        return [row + of for row, of in zip(rows, times(more, chosen), strict=True)]

    size = len(model.F[0])
    shift = [[Fraction(0)] * size + _unit(columns.index((i, d - 1)), len(columns)) for i, d in past]
    return replace(
        model,
        F=wide(model.F, F_w) + shift,
        H=wide(model.H, H_w),
        vertices=lambda part, ends: [
            wide([row[:size] for row in E], [row[size:] for row in E])
            for E in model.vertices(part, ends)
        ],
        driven=len(inputs),
    )


def _slope_range(node: Node) -> list[Fraction]:
    """The least and the largest slope of a piecewise-linear map, ascending, each once."""
    parts = node.members("knots values")
    knots = parts["knots"].array(None)
    values = parts["values"].array(len(knots))
    if len(knots) < 2 or any(high <= low for low, high in pairwise(knots)):
        raise Rejected(f"{node.where}: 2 knots or more, ascending")
    steps = zip(pairwise(knots), pairwise(values), strict=True)
    slopes = [(after - before) / (high - low) for (low, high), (before, after) in steps]
    return sorted({min(slopes), max(slopes)})


def _monotone_equation(node: Node, driven: bool) -> Model:
    """e(ȳ(t)) = affine in the past, ν = ȳ(t), E = [e', -a]: e' constant, or its least and a ray."""
    parts = _members(node, "y u e a b c window y_offset u_offset")
    first, second, third = parts["e"].array(3)
    a = parts["a"].array(None)
    n = _size(len(a), parts["a"])
    u = read_signals(parts["u"], "inputs")
    window = parts["window"].wholes(None, 2)
    b = parts["b"].array(len(window))
    parts["u_offset"].array(len(u))
    parts["c"].number()
    parts["y_offset"].number()
    if any(not (0 <= i < len(u) and d >= 0) for i, d in window):
        raise Rejected(f"{node.where} window names inputs or delays that are not there")
    if third < 0 or (third == 0 and second != 0):
        raise Rejected(f"{node.where} e is not increasing everywhere")
    least = first - second**2 / (3 * third) if third else first
    E = [[least, *(-entry for entry in a), *(-entry for entry in b if driven)]]
    F = [_unit(i, n + 1) for i in range(n)]
    model = Model(
        _period(parts), (read_signal(parts["y"]),), u, F, [_unit(0, n + 1)],
        "for every input", [], lambda _, __: [E], ray=third > 0,
    )  # fmt: skip
    return _driven(model, window) if driven else model


def _implicit(node: Node, bounds: Node | None, driven: bool) -> Model:
    """0 = h(v, x, w), x⁺ = [v; ã(x, w)], y = v: ν = v - v̂, E = [∂h/∂v, ∂h/∂x] averaged between.

    Where h is linear in v and x, E is one matrix. Where h = e(v) - (affine in x), v one number and
    e a cubic that increases, e' is at least its least slope: a ray. Else E is in the hull of the
    Bernstein coefficients of ∂h/∂(v, x) on a box of v, x and w, both solutions being in it. Their
    (v, x) may be in two leaves: for one h there is a point between them where E ζ = 0 (mean value
    theorem), whatever leaf it is in; for several there need be none, so only w is split.
    """
    given = read_implicit_model(node)
    parts = node.members("y u window", f"{MEMBERS} training bags")
    y, u = read_signals(parts["y"], "outputs"), read_signals(parts["u"], "inputs")
    window = parts["window"].wholes(given.inputs, 2)
    p, n = given.unknowns, given.states
    if len(y) != p or n % p or any(not (0 <= i < len(u) and d >= 0) for i, d in window):
        raise Rejected(f"{node.where}: outputs, states and window do not fit")
    known = p + n + given.inputs * driven  # columns: v, x, and driven the window w
    F = [_unit(i, known) for i in range(p)]
    for terms in given.shift:
        if any(sum(e) > 1 and any(e[: known - p]) for e, _ in terms):
            what = "the states and inputs" if driven else "the states"
            raise Rejected(f"{node.where}: the shift should be linear in {what}")
        row = [Fraction(0)] * known
        for e, c in terms:
            if any(e[: known - p]):
                row[p + e.index(1)] += c
        F.append(row)
    E = _jacobian(given.h, range(known))
    if not E:
        raise Rejected("the model's equation does not depend on its output")
    constant = all(not any(e) for e, _ in E)
    least = None if constant else _least_slope(given, driven)
    if bounds is None and not constant and least is None:
        raise Rejected(f"{node.where}: the increments of this model are known on a box only")
    box: Box = []
    if bounds is not None:
        if constant or least is not None:
            raise Rejected(f"{node.where} needs no box: its increments are known everywhere")
        ends = bounds.members("y u")
        y_box, u_box = ends["y"].array(p, 2), ends["u"].array(len(u), 2)
        if any(low >= high for low, high in [*y_box, *u_box]):
            raise Rejected(f"{bounds.where}: a range is empty")
        for i, terms in enumerate(given.shift):  # else a state is no output: it has another range
            past = [(_unit(i, n + given.inputs), Fraction(1))]
            if [(list(map(Fraction, e)), c) for e, c in terms] != past:
                raise Rejected(f"{node.where}: on a box, the states should be the past outputs")
        rows = [*y_box, *y_box * (n // p), *(u_box[i] for i, _ in window)]
        box = [(low, high) for low, high in rows]
    only = [least] if least is not None else [E[0][1]] if constant else []

    def vertices(part: Box, ends: Node | None) -> list[Matrix]:
        if ends is not None:
            raise Rejected(f"{ends.where}: ends are for state-affine models")
        return only or bernstein(E, part)

    split = len(box) if driven else p + n
    model = Model(
        given.period, y, u, [row[: p + n] for row in F], [_unit(i, p + n) for i in range(p)],
        "for every input" if bounds is None else "while signals stay in the box", box,
        vertices, ray=least is not None, effort=0 if only else effort(E, box),
        whole=split if p > 1 and box else 0,
    )  # fmt: skip
    return _driven(model, window, [row[p + n :] for row in F]) if driven else model


def _jacobian(rows: Sequence[Polynomial], of: range) -> Terms:
    """The derivatives of polynomials by the variables `of`, as a matrix polynomial."""
    found: dict[tuple[int, ...], list[list[Fraction]]] = {}
    _refuse_slopes(sum(map(len, rows)), len(rows), len(of))
    for i, row in enumerate(rows):
        for j in of:
            for powers, c in derivative(row, j):
                if max(powers, default=0) > MAX_POWER:
                    raise Rejected(f"powers should be from 0 to {MAX_POWER}")
                entry = found.setdefault(powers, [[Fraction(0)] * len(of) for _ in rows])
                entry[i][j] += c
    return [(list(powers), found[powers]) for powers in sorted(found)]


def _refuse_slopes(terms: int, rows: int, variables: int) -> None:
    if terms * rows * variables**2 > MAX_SLOPES:
        raise Rejected("the model has too many terms for its slopes to be written out")


def _least_slope(model: ImplicitModel, driven: bool) -> Matrix | None:
    """[min e', -a] of one equation e(v) = a'x + (terms in w), e an increasing cubic; else None.

    Driven, the terms in w are linear too: [min e', -a, -b].
    """
    p, n = model.unknowns, model.states + model.inputs * driven
    if p != 1:
        return None
    E, e = [Fraction(0)] * (1 + n), [Fraction(0)] * 4
    for powers, c in model.h[0]:
        if not any(powers[: 1 + n]):
            continue
        if any(powers[1 + n :]) or (powers[0] and any(powers[1 : 1 + n])) or powers[0] > 3:
            return None
        if powers[0]:
            e[powers[0]] += c
        elif sum(powers) == 1:
            E[powers.index(1)] += c
        else:
            return None
    if e[3] <= 0:
        return None
    E[0] = e[1] - e[2] ** 2 / (3 * e[3])
    return [E]


_READERS: dict[str, Callable[[Node, bool], Model]] = {
    "difference_equation": _difference_equation,
    "state_affine": lambda node, driven: _state_affine(node, driven, None),
    "block_cascade": _block_cascade,
    "cell_network": _cell_network,
    "monotone_equation": _monotone_equation,
}


def _polynomials(node: Node, variables: int, *shape: int) -> Terms:
    parts = node.members("exponents coefficients")
    exponents = parts["exponents"].monomials(variables)
    coefficients = parts["coefficients"].array(len(exponents), *shape)
    if not exponents or any(power > MAX_POWER for row in exponents for power in row):
        raise Rejected(f"{node.where} should have monomials, with powers from 0 to {MAX_POWER}")
    return list(zip(map(list, exponents), coefficients, strict=True))


def _members(node: Node, names: str) -> dict[str, Node]:
    stated = f"period training bags {names}"
    parts = node.document("model", stated, " ".join(_READERS), optional="equation")
    if "equation" in parts:
        parts["equation"].text()
    parts["training"].text()
    for bag in parts["bags"].items():
        for entry in bag.members("name digest").values():
            entry.text()
    return parts


def _period(parts: dict[str, Node]) -> Fraction:
    period = parts["period"].number()
    if period <= 0:
        raise Rejected("the model's period should be positive")
    return period


def _inputs_in_range(beyond: str, u: Sequence[Signal], ranges: Sequence[Sequence[Fraction]]) -> str:
    if beyond not in ("clip", "refuse"):
        raise Rejected(f"on_out_of_range is {beyond!r}; known: clip, refuse")
    shown = ", ".join(within(*pair) for pair in zip(u, ranges, strict=True))
    if beyond == "clip":
        return f"for every input (the model clips its inputs: {shown})"
    return f"for every input in the model's range ({shown}; it refuses others)"


def _size(n: int, node: Node) -> int:
    if not 0 < n <= MAX_STATES:
        raise Rejected(f"{node.where}: {n} states; 1 to {MAX_STATES} are decided")
    return n


def _unit(i: int, size: int) -> list[Fraction]:
    return [Fraction(int(j == i)) for j in range(size)]


def _powers(i: int, size: int) -> list[int]:
    return [int(j == i) for j in range(size)]


def _padded(values: list[Fraction], size: int) -> list[Fraction]:
    return values + [Fraction(0)] * (size - len(values))
