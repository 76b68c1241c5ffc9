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
from .files import Node, each, itself
from .increments import Hull, Model, read_recorded, sized
from .signals import read_signal, signals

MAX_MAPS = 8  # a network has 2^maps matrices
ZERO = Fraction(0)


def read_cells(node: Node) -> Model:
    """A `cell_network`: maps that are linear between their knots, and on beyond them."""
    given = read_recorded(
        node,
        "cell_network",
        {
            "y": signals("outputs", 1),
            "u": signals("inputs"),
            "maps": each(_slopes, 1, MAX_MAPS),
            "into": itself,
            "next": itself,
            "output": itself,
            "start": (None,),
            "start_samples": itself,
        },
    )
    slopes, n = given["maps"], sized(len(given["start"]), node)
    m, columns = len(slopes), len(slopes) + n
    width = columns + len(given["u"]) + 1
    into = given["into"].array(m, width)
    F, H = given["next"].array(n, width), given["output"].array(len(given["y"]), width)
    earlier = not any(any(row[j:m]) for j, row in enumerate(into))
    given["into"].require({"a map should depend on earlier maps only": earlier})
    F, H, into = ([row[:columns] for row in rows] for rows in (F, H, into))
    hull = _corners(slopes, into)
    return Model(given["period"], given["y"], given["u"], F, H, hull, "for every input")


def read_cascade(node: Node) -> Model:
    """A `block_cascade`, two linear filters around a spline: a network with one map a phase.

    v(t) = u(t) + Σ a1_k v(t-k), x_j = Σ_i b1_ji v(t-i), y(t) = Σ a2_k y(t-k) + Σ b2_ji f(x_j(t-i)).
    x stacks v(t-1) … v(t-n₁) of the first filter and the observer form of the second.
    """
    given = read_recorded(
        node,
        "block_cascade",
        {
            "y": read_signal,
            "u": read_signal,
            "a1": (None,),
            "b1": (None, None),
            "f": _spline_slopes,
            "a2": (None,),
            "b2": (None, None),
        },
    )
    b1, b2, slopes = given["b1"], given["b2"], given["f"]
    M = len(b1)
    even = all(row and len(row) == len(rows[0]) for rows in (b1, b2) for row in rows)
    node.require(
        {
            f"b1 and b2 should have as many rows, 1 to {MAX_MAPS}": 0 < M == len(b2) <= MAX_MAPS,
            "the rows of b1, and of b2, should have equal lengths": even,
        }
    )
    n1, n2 = max(len(given["a1"]), len(b1[0]) - 1), max(len(given["a2"]), len(b2[0]) - 1)
    n = sized(n1 + n2, node)
    a1, a2 = _padded(given["a1"], n1), _padded(given["a2"], n2)

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

    where = text.say(
        "for every input (the slopes of its nonlinearity are in {0:outer_range} everywhere)",
        (slopes[0], slopes[-1]),
    )
    hull = _corners([slopes] * M, [[ZERO] * M + row + [ZERO] * n2 for row in C])
    return Model(given["period"], (given["y"],), (given["u"],), F, [H], hull, where)


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
    given = node.read({"knots": (None,), "values": (None,)})
    knots, values = given["knots"], given["values"]
    ascending = len(knots) >= 2 and all(a < b for a, b in pairwise(knots))
    node.require({"2 knots or more, ascending": ascending, "values": len(knots) == len(values)})
    steps = zip(pairwise(knots), pairwise(values), strict=True)
    return _ends([(after - before) / (high - low) for (low, high), (before, after) in steps])


def _spline_slopes(node: Node) -> list[Fraction]:
    """The same of a spline: f' is a convex combination of (c_{k+1} - c_k)/spacing everywhere."""
    given = node.read({"low": (), "spacing": (), "coefficients": (None,)})
    spacing, c = given["spacing"], given["coefficients"]
    node.require({"a positive spacing, 4 coefficients or more": spacing > 0 and len(c) >= 4})
    return _ends([(after - before) / spacing for before, after in pairwise(c)])


def _ends(slopes: list[Fraction]) -> list[Fraction]:
    return sorted({min(slopes), max(slopes)})


def _padded(values: list[Fraction], size: int) -> list[Fraction]:
    return values + [ZERO] * (size - len(values))
