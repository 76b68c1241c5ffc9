"""The second family of models: networks of maps whose slopes are bounded.

ν_j = f_j(into_j·[ν, x, u, 1]), x⁺ = next·[ν, x, u, 1], y = output·[ν, x, u, 1], `into` strictly
lower triangular in ν, so that every output is determined. Of two solutions under one input,
ν̄_j = σ_j into_j·[ν̄, x̄] with σ_j a mean slope of f_j, between its least and its largest one: E(σ) =
[I, 0] - diag(σ) into is in the hull of its values at the corners. docs/certificate_stability.md.
"""

from fractions import Fraction
from itertools import pairwise, product

from . import text
from .exact import Matrix, unit
from .files import Node, refuse_if
from .increments import Hull, Model, read_recorded, sized
from .signals import read_signal, read_signals

MAX_MAPS = 8  # a network has 2^maps matrices
ZERO = Fraction(0)


def read_cells(node: Node) -> Model:
    """A `cell_network`: maps that are linear between their knots, and on beyond them."""
    parts, period = read_recorded(
        node, "cell_network", "y u maps into next output start start_samples"
    )
    y, u = read_signals(parts["y"], "outputs", 1), read_signals(parts["u"], "inputs")
    slopes = [_slopes(f) for f in parts["maps"].items(1, MAX_MAPS)]
    m, n = len(slopes), sized(len(parts["start"].array(None)), node)
    width = m + n + len(u) + 1
    into = parts["into"].array(m, width)
    F, H = parts["next"].array(n, width), parts["output"].array(len(y), width)
    refuse_if(
        any(any(row[j:m]) for j, row in enumerate(into)),
        f"{node.where} into: a map should depend on earlier maps only",
    )
    F, H, into = ([row[: m + n] for row in rows] for rows in (F, H, into))
    return Model(period, y, u, F, H, _corners(slopes, into), "for every input")


def read_cascade(node: Node) -> Model:
    """A `block_cascade`, two linear filters around a spline: a network with one map a phase.

    v(t) = u(t) + Σ a1_k v(t-k), x_j = Σ_i b1_ji v(t-i), y(t) = Σ a2_k y(t-k) + Σ b2_ji f(x_j(t-i)).
    x stacks v(t-1) … v(t-n₁) of the first filter and the observer form of the second.
    """
    parts, period = read_recorded(node, "block_cascade", "y u a1 b1 f a2 b2")
    a1, a2 = parts["a1"].array(None), parts["a2"].array(None)
    b1, b2 = parts["b1"].array(None, None), parts["b2"].array(None, None)
    M = len(b1)
    refuse_if(
        not 0 < M <= MAX_MAPS or len(b2) != M,
        f"{node.where}: b1 and b2 should have as many rows, 1 to {MAX_MAPS}",
    )
    refuse_if(
        any(len(row) != len(rows[0]) or not row for rows in (b1, b2) for row in rows),
        f"{node.where}: the rows of b1, and of b2, should have equal lengths",
    )
    n1, n2 = max(len(a1), len(b1[0]) - 1), max(len(a2), len(b2[0]) - 1)
    n = sized(n1 + n2, node)
    a1, a2 = _padded(a1, n1), _padded(a2, n2)

    # x_j = b1_j0 v(t) + … with v(t) = u + a1·past gives C_j; the same way behind f gives g_j.
    C = [[row[0] * a + b for a, b in zip(a1, _padded(row[1:], n1), strict=True)] for row in b1]
    g = [[row[0] * a + b for a, b in zip(a2, _padded(row[1:], n2), strict=True)] for row in b2]
    F = [[ZERO] * M + a1 + [ZERO] * n2] * (n1 > 0)
    F += [unit(M + k, M + n) for k in range(n1 - 1)]
    for i in range(n2):
        row = [g[j][i] for j in range(M)] + [ZERO] * n1 + unit(i + 1, n2 + 1)[:n2]
        row[M + n1] += a2[i]
        F.append(row)
    H = [row[0] for row in b2] + [ZERO] * n1 + unit(0, n2)

    slopes = _spline_slopes(parts["f"])
    where = text.say(
        "for every input (the slopes of its nonlinearity are in {0:outer_range} everywhere)",
        (slopes[0], slopes[-1]),
    )
    hull = _corners([slopes] * M, [[ZERO] * M + row + [ZERO] * n2 for row in C])
    y, u = (read_signal(parts["y"]),), (read_signal(parts["u"]),)
    return Model(period, y, u, F, [H], hull, where)


def _corners(slopes: list[list[Fraction]], into: Matrix) -> Hull:
    """[I, 0] - diag(σ) into at every corner of σ."""
    size = len(into[0])
    return Hull(
        lambda _, __: [
            [
                [one - slope * entry for one, entry in zip(unit(j, size), into[j], strict=True)]
                for j, slope in enumerate(corner)
            ]
            for corner in product(*slopes)
        ]
    )


def _slopes(node: Node) -> list[Fraction]:
    """The least and the largest slope of a piecewise-linear map, ascending, each once."""
    parts = node.members("knots values")
    knots = parts["knots"].array(None)
    values = parts["values"].array(len(knots))
    refuse_if(
        len(knots) < 2 or any(high <= low for low, high in pairwise(knots)),
        f"{node.where}: 2 knots or more, ascending",
    )
    steps = zip(pairwise(knots), pairwise(values), strict=True)
    return _ends([(after - before) / (high - low) for (low, high), (before, after) in steps])


def _spline_slopes(node: Node) -> list[Fraction]:
    """The same of a spline: f' is a convex combination of (c_{k+1} - c_k)/spacing everywhere."""
    parts = node.members("low spacing coefficients")
    parts["low"].number()
    spacing, c = parts["spacing"].number(), parts["coefficients"].array(None)
    refuse_if(
        spacing <= 0 or len(c) < 4, f"{node.where}: a positive spacing and 4 coefficients or more"
    )
    return _ends([(after - before) / spacing for before, after in pairwise(c)])


def _ends(slopes: list[Fraction]) -> list[Fraction]:
    least, most = min(slopes), max(slopes)
    return [least] if least == most else [least, most]


def _padded(values: list[Fraction], size: int) -> list[Fraction]:
    return values + [ZERO] * (size - len(values))
