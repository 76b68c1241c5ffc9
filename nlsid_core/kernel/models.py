"""Model files in increment form, of two families: equations, and networks of bounded slopes.

Equations: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]. Of two solutions under one input, E is [∂h/∂v, ∂h/∂x],
averaged on the segment between them: in the hull of these derivatives' Bernstein coefficients on a
box that both are in. Where they depend on the input alone, the box is the model's own range of it;
where they are constant there is none.
Networks: ν_j = f_j(into_j·[ν, x, u, 1]), x⁺ = next·[ν, x, u, 1], y = output·[ν, x, u, 1], `into`
strictly lower triangular in ν. Of two solutions, ν̄_j = σ_j into_j·[ν̄, x̄], σ_j a mean slope of f_j:
E = [I, 0] - diag(σ) into on the box of the slopes. docs/certificate_stability.md.
"""

from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from typing import Any

from . import text
from .exact import Matrix, identity, unit
from .files import Node, Table, each, limit, one_of, refuse_if
from .implicit_models import derivative, read_implicit
from .increments import MAX_POWER, Box, Entries, Hull, Linear, Model
from .signals import ranges, read_signal, signals

MAX_STATES = 120
MAX_MAPS = 8  # a network has 2^maps matrices
ZERO = Fraction(0)
SLOPES = "for every input (the slopes of its nonlinearity are in {0:outer_range} everywhere)"


def read_model(node: Node, bounds: Node | None = None) -> Model:
    """The increment form of a model file's content.

    bounds: {y, u}, of the outputs and inputs of an implicit model that has no global form.
    """
    kind = node.kind()
    if kind == "implicit":
        return _read_recorded_implicit(node, bounds)
    refuse_if(kind not in READERS, f"{node.where}: no model kind {kind!r} is known")
    refuse_if(bounds is not None, f"a model of kind {kind} needs no box")
    return READERS[kind](node)


def _recorded(node: Node, kind: str, table: Table) -> dict[str, Any]:
    """The members of a model of recorded signals; what made it is not read."""
    heads: Table = {"period": (), "training": None, "bags": None, "equation?": Node.text}
    given = node.document("model", {**heads, **table}, kind)
    node.require({"the period should be positive": given["period"] > 0})
    return given


def _sized(n: int, node: Node) -> int:
    """So many states."""
    return limit(n, MAX_STATES, f"{node.where}: states", least=1)


def _read_linear(node: Node) -> Model:
    """A `difference_equation`: ŷ = x_1 + b_0 u + c, x⁺ = a ŷ + shift(x) + b_1..n u; no ν."""
    table: Table = {"y": read_signal, "u": read_signal, "a": (None,), "b": (None,), "c": ()}
    given = _recorded(node, "difference_equation", {**table, "u_range": (2,)})
    a, n, (low, high) = given["a"], _sized(len(given["a"]), node), given["u_range"]
    fits = len(given["b"]) == n + 1
    node.require({"b should have one number more than a": fits, "u_range": low <= high})
    direct, *b = given["b"]
    F = [[a_i, *unit(i + 1, n + 1)[1:n]] for i, a_i in enumerate(a)]
    B = [p + q * direct for p, q in zip(b, a, strict=True)]
    linear = Linear(B=B, D=direct, input_range=(low, high))
    y, u = (given["y"],), (given["u"],)
    return Model(given["period"], y, u, F, [unit(0, n)], Hull([]), linear=linear)


def _read_affine(node: Node) -> Model:
    """A `state_affine` model: 0 = Σ_k G_k(w) ȳ(t-k) + p(w), ν = ȳ(t), E = [G_0 … G_n](w)."""
    table: Table = {
        "y": signals("outputs", 1),
        "u": signals("inputs", 1),
        "window": lambda entry: entry.wholes(None, 2),
        "G": each(None, 2),
        "p": None,
        **dict.fromkeys(("y_offset", "y_scale", "u_offset", "u_scale"), (None,)),
        "u_range": (None, 2),
        "on_out_of_range": one_of("clip", "refuse"),
    }
    given = _recorded(node, "state_affine", table)
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
    size = _sized(p * (len(given["G"]) - 1), node)
    _require_window(window, m, len(given["G"]), node)
    blocks = [_matrix(entry, len(window), p, p) for entry in given["G"]]
    _matrix(given["p"], len(window), p)
    E = [[[(e, G[i][j]) for e, G in block] for block in blocks for j in range(p)] for i in range(p)]
    scaled = [
        ((low - o) / s, (high - o) / s)
        for (low, high), o, s in zip(limits, offsets, scales, strict=True)
    ]
    box = [scaled[i] for i, _ in window]
    F = identity(p + size)[:size]  # x⁺ = [ν; all but the oldest of x]
    H = [[scale * entry for entry in unit(i, p + size)] for i, scale in enumerate(given["y_scale"])]
    shown = ranges(given["u"], list(map(text.PRINTED["inner_range"], limits)))
    where = f"for every input (the model clips its inputs: {shown})"
    if given["on_out_of_range"] == "refuse":
        where = f"for every input in the model's range ({shown}; it refuses others)"
    return Model(given["period"], given["y"], given["u"], F, H, Hull(E, box), where)


def _matrix(node: Node, variables: int, *shape: int) -> list[tuple[bytes, Any]]:
    """Monomials, each with a coefficient of this shape."""
    parts = node.members("exponents coefficients")
    rows = parts["exponents"].monomials(variables)
    fits = rows and all(power <= MAX_POWER for row in rows for power in row)
    node.require({f"monomials are missing, or a power is above {MAX_POWER}": fits})
    return list(zip(rows, parts["coefficients"].array(len(rows), *shape), strict=True))


def _read_monotone(node: Node) -> Model:
    """A `monotone_equation`: e(ȳ(t)) = affine in the past, E = [e', -a]."""
    table: Table = {
        "y": read_signal,
        "u": signals("inputs"),
        "window": lambda entry: entry.wholes(None, 2),
        "e": (3,),
        **dict.fromkeys(("a", "b", "u_offset"), (None,)),
        **dict.fromkeys(("c", "y_offset"), ()),
    }
    given = _recorded(node, "monotone_equation", table)
    e, u, n = given["e"], given["u"], _sized(len(given["a"]), node)
    _require_window(given["window"], len(u), None, node)
    fits = len(given["b"]) == len(given["window"]), len(given["u_offset"]) == len(u)
    node.require({"one b an entry of the window": fits[0], "one u_offset an input": fits[1]})
    node.require({"e should increase everywhere": e[2] > 0 or e[1] == e[2] == 0}, "not_valid")
    slope = [(bytes([k]), (k + 1) * c) for k, c in enumerate(e) if c]
    E = [[slope, *([(bytes(1), -entry)] for entry in given["a"])]]
    F, H = identity(n + 1)[:n], [unit(0, n + 1)]
    return Model(given["period"], (given["y"],), u, F, H, _pointed(E) or Hull(E))


def _read_recorded_implicit(node: Node, bounds: Node | None) -> Model:
    """An `implicit` model of recorded signals, y = v: ν = v - v̂.

    Where ∂h is constant, E is one matrix. Where h = e(v) - (affine in x), v one number and e a
    cubic that increases, e' is at least its least slope: a ray. Else both solutions are in a box
    of v, x and w. Their (v, x) may be in two leaves: for one h there is a point between them where
    E ζ = 0 (mean value theorem), whatever leaf it is in; for several there need be none, so only w
    is split.
    """
    model = read_implicit(node)
    recorded = all(model[name] for name in ("y", "u", "window"))
    node.require({"of recorded signals there should be y, u and window": recorded})
    y, u = signals("outputs")(model["y"]), signals("inputs")(model["u"])
    p, n, shift = len(model["h"]), len(model["states"]), model["shift"]
    window = model["window"].wholes(len(model["inputs"]), 2)
    node.require({"one output an equation, and past ones the states": len(y) == p and n % p == 0})
    _require_window(window, len(u), None, node)
    slopes = [[derivative(row, j) for j in range(n)] for row in shift]
    linear = not any(any(e) for row in slopes for entry in row for e, _ in entry)
    node.require({"the shift should be linear in the states": linear})
    rows = [[sum((c for _, c in entry), ZERO) for entry in row] for row in slopes]
    F = identity(p + n)[:p] + [[ZERO] * p + row for row in rows]

    E = [[derivative(row, j) for j in range(p + n)] for row in model["h"]]
    powers = [e for row in E for entry in row for e, _ in entry]
    refuse_if(not powers, "the model's equation does not depend on its output")
    hull = _pointed(E) or Hull(E)
    known = hull.ray or not any(map(any, powers))
    wanted = "it needs no box" if known else "its increments are known on a box only"
    node.require({wanted: known == (bounds is None)}, "not_valid")
    where = "for every input"
    if bounds is not None:
        states = [[(unit(i, n + len(window)), 1)] for i in range(n - p)]
        past = [[(list(e), c) for e, c in row] for row in shift] == states
        bounds.require({"on a box the states should be the past outputs": past})
        hull = Hull(E, _read_box(bounds, p, n, window, len(u)), whole=p + n if p > 1 else 0)
        where = "while signals stay in the box"
    return Model(model["period"], y, u, F, identity(p + n)[:p], hull, where)


def _read_box(bounds: Node, p: int, n: int, window: list[list[int]], inputs: int) -> Box:
    """The box of (v, x, w), from ranges of outputs and inputs; x stacks past outputs."""
    ends = bounds.read({"y": (p, 2), "u": (inputs, 2)})
    full = all(low < high for low, high in [*ends["y"], *ends["u"]])
    bounds.require({"no range should be empty": full}, "not_valid")
    rows = [*ends["y"], *ends["y"] * (n // p), *(ends["u"][i] for i, _ in window)]
    return [(low, high) for low, high in rows]


def _pointed(E: Entries) -> Hull | None:
    """[min e', -a] and all above, where E = [e'(v), -a] with an increasing cubic e; else None."""
    slope, *lags = E[0]
    a, b, c = (sum((c for e, c in slope if e[0] == power), ZERO) for power in range(3))
    other = any(e[0] > 2 or any(e[1:]) for e, _ in slope)
    if len(E) > 1 or c <= 0 or other or any(any(e) for lag in lags for e, _ in lag):
        return None
    return Hull([[[(bytes(len(slope[0][0])), a - b**2 / (4 * c))], *lags]], ray=True)


def _require_window(window: Any, inputs: int, delays: int | None, node: Node) -> None:
    """Refuse other rows than (input, delay), delays below `delays` if there is such a bound."""
    known = all(0 <= i < inputs and 0 <= d < (delays or d + 1) for i, d in window)
    node.require({"the window should name inputs and delays that are there": known})


def _read_cells(node: Node) -> Model:
    """A `cell_network`: maps that are linear between their knots, and on beyond them."""
    table: Table = {
        "y": signals("outputs", 1),
        "u": signals("inputs"),
        "maps": each(_slopes, 1, MAX_MAPS),
        **dict.fromkeys(("into", "next", "output", "start_samples")),
        "start": (None,),
    }
    given = _recorded(node, "cell_network", table)
    slopes, n, y, u = given["maps"], _sized(len(given["start"]), node), given["y"], given["u"]
    m, width = len(slopes), len(slopes) + n + len(u) + 1
    into, F, H = (
        [row[: m + n] for row in given[name].array(rows, width)]
        for name, rows in (("into", m), ("next", n), ("output", len(y)))
    )
    earlier = not any(any(row[j:m]) for j, row in enumerate(into))
    given["into"].require({"a map should depend on earlier maps only": earlier})
    return Model(given["period"], y, u, F, H, _between_slopes(slopes, into))


def _read_cascade(node: Node) -> Model:
    """A `block_cascade`, two linear filters around a spline: a network with one map a phase.

    v(t) = u(t) + Σ a1_k v(t-k), x_j = Σ_i b1_ji v(t-i), y(t) = Σ a2_k y(t-k) + Σ b2_ji f(x_j(t-i)).
    x stacks v(t-1) … v(t-n₁) of the first filter and the observer form of the second.
    """
    table: Table = {"y": read_signal, "u": read_signal, "a1": (None,), "a2": (None,)}
    table |= {"f": _spline_slopes, "b1": (None, None), "b2": (None, None)}
    given = _recorded(node, "block_cascade", table)
    b1, b2, M = given["b1"], given["b2"], len(given["b1"])
    even = all(row and len(row) == len(rows[0]) for rows in (b1, b2) for row in rows)
    node.require(
        {
            f"b1 and b2 should have as many rows, 1 to {MAX_MAPS}": 0 < M == len(b2) <= MAX_MAPS,
            "the rows of b1, and of b2, should have equal lengths": even,
        }
    )
    n1, n2 = max(len(given["a1"]), len(b1[0]) - 1), max(len(given["a2"]), len(b2[0]) - 1)
    n, a1, a2 = _sized(n1 + n2, node), _padded(given["a1"], n1), _padded(given["a2"], n2)

    # x_j = b1_j0 v(t) + … with v(t) = u + a1·past gives C_j; the same way behind f gives g_j.
    C = [[row[0] * a + b for a, b in zip(a1, _padded(row[1:], n1), strict=True)] for row in b1]
    g = [[row[0] * a + b for a, b in zip(a2, _padded(row[1:], n2), strict=True)] for row in b2]
    F = [[ZERO] * M + a1 + [ZERO] * n2, *(unit(M + k, M + n) for k in range(n1 - 1))][:n1]
    for i in range(n2):
        row = [g[j][i] for j in range(M)] + [ZERO] * n1 + unit(i + 1, n2 + 1)[:n2]
        row[M + n1] += a2[i]
        F.append(row)
    H = [row[0] for row in b2] + [ZERO] * n1 + unit(0, n2)
    hull = _between_slopes([given["f"]] * M, [[ZERO] * M + row + [ZERO] * n2 for row in C])
    where = text.say(SLOPES, given["f"])
    return Model(given["period"], (given["y"],), (given["u"],), F, [H], hull, where)


def _between_slopes(slopes: Box, into: Matrix) -> Hull:
    """[I, 0] - diag(σ) into, σ in the box of the slopes, which is not split."""
    m, E = len(into), identity(len(into[0]))
    one = [bytes(map(int, row)) for row in identity(m)]
    terms = [
        [[(bytes(m), a), (one[j], -b)] for a, b in zip(E[j], row, strict=True)]
        for j, row in enumerate(into)
    ]
    return Hull(terms, slopes, whole=m)


def _slopes(node: Node) -> tuple[Fraction, Fraction]:
    """The least and the largest slope of a piecewise-linear map."""
    given = node.read({"knots": (None,), "values": (None,)})
    knots, values = given["knots"], given["values"]
    ascending = len(knots) >= 2 and all(a < b for a, b in pairwise(knots))
    node.require({"2 knots or more, ascending": ascending, "values": len(knots) == len(values)})
    steps = zip(pairwise(knots), pairwise(values), strict=True)
    slopes = [(after - before) / (high - low) for (low, high), (before, after) in steps]
    return min(slopes), max(slopes)


def _spline_slopes(node: Node) -> tuple[Fraction, Fraction]:
    """The same of a spline: f' is a convex combination of (c_{k+1} - c_k)/spacing everywhere."""
    given = node.read({"low": (), "spacing": (), "coefficients": (None,)})
    spacing, c = given["spacing"], given["coefficients"]
    node.require({"a positive spacing, 4 coefficients or more": spacing > 0 and len(c) >= 4})
    slopes = [(after - before) / spacing for before, after in pairwise(c)]
    return min(slopes), max(slopes)


def _padded(values: list[Fraction], size: int) -> list[Fraction]:
    return values + [ZERO] * (size - len(values))


READERS: dict[str, Callable[[Node], Model]] = {
    "difference_equation": _read_linear,
    "state_affine": _read_affine,
    "monotone_equation": _read_monotone,
    "block_cascade": _read_cascade,
    "cell_network": _read_cells,
}
