"""What is read of a trajectory: a policy and a funnel around a nominal, a vector field, and pieces.

Between knots the nominal's states and inputs and the gains are Bézier curves, P and ρ are linear.
"""

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise, product
from types import SimpleNamespace
from typing import Any

from .exact import definite
from .files import Node, Reader, Table, Terms, itself, refuse_if, whole

MAX_STATES, MAX_INPUTS, MAX_UNCERTAIN, MAX_LIMITED = 16, 16, 32, 3
MAX_DEGREE, MAX_TIME_DEGREE = 7, 3
MAX_BOUNDS, MAX_KNOTS, MAX_SPANS = 10_000, 10_000, 1000
MAX_LEVEL, MAX_PIECES = 16, 100_000

Bounds = dict[int, tuple[Fraction, Fraction]]
# A mode, -1 low, 0 free, 1 high, of each input with limits; of a rate after its input and sign.
Case = tuple[int, ...]
Key = tuple[int, int, Case]  # interval, vertex, case
Part = tuple[int, int, int]  # interval k, level, index: [index, index + 1] / 2^level of it
Piece = tuple[Key, Part, dict[str, Any], str]  # what it is about, its members, and where it stands

# t, P, rho: knots, and what holds at them. x, u, K: control points by interval. limits: low and
# high by input; modes. n states, m inputs, the box of w. By interval, equations in t, x, u, w and
# bounds of (x, u). pushing: the variables that only add constants to ẋ. affine: f is so in each u.
Motion = SimpleNamespace


def read_motion(documents: dict[str, Node], digests: dict[str, str]) -> Motion:
    """The policy and the funnel: around one nominal, x₀ continuous, P ≻ 0, ρ > 0 at every knot."""
    made_for = {"vector_field": digests["vector_field"]}
    table: Table = {"t": (None,), "x": itself, "u": itself, "K": itself, "limits": (None, 3)}
    policy = documents["policy"].document("policy", table, "continuous", made_for)
    made_for["policy"], node = digests["policy"], documents["funnel"]
    table = {"t": _times(2, MAX_KNOTS), "x": itself, "P": itself, "rho": (None,)}
    given = node.document("funnel", table, "continuous", made_for)

    t, rho, x = given["t"], given["rho"], _curve(given["x"], len(given["t"]) - 1, None)
    n, count = len(x[0][0]), len(x)
    other = policy["t"] != t or _curve(policy["x"], count, n) != x
    refuse_if(other, "the funnel is around another nominal than the policy's", "mismatch")
    smooth = all(a[-1] == b[0] for a, b in pairwise(x))
    node.require({"one rho a knot": len(rho) == len(t), "x should not jump": smooth})
    node.require({"rho should be positive": min(rho) > 0}, "not_below")
    P = given["P"].array(len(t), n, n)
    for k, shape in enumerate(P):
        definite(shape, f"P at knot {k}")

    u = _curve(policy["u"], count, None)
    m, rows = len(u[0][0]), policy["limits"]
    limits = {int(i): (low, high) for i, low, high in rows if i in range(m)}
    single = len(limits) == len(rows) <= MAX_LIMITED
    documents["policy"].require(
        {
            f"at most {MAX_LIMITED} limits, each of another input": single,
            "limits should have low < high": all(low < high for low, high in limits.values()),
        }
    )
    K, modes = _curve(policy["K"], count, m, n), list(product((0, -1, 1), repeat=len(limits)))
    motion = Motion(t=t, x=x, u=u, K=K, limits=limits, P=P, rho=rho, n=n, m=m, modes=modes)
    _read_field(documents["vector_field"], motion)
    return motion


def _read_field(node: Node, motion: Motion) -> None:
    """The vector field: monomials distinct and increasing, each entry of w at most once in one."""
    table: Table = {
        "states": whole(1, MAX_STATES),
        "inputs": whole(0, MAX_INPUTS),
        "uncertain": (None, 2),
        "breaks": _times(0, MAX_SPANS),
        "valid": (None, None),
        "expansion": Node.text,
        "pieces": itself,
    }
    given = node.document("vector_field", table)
    n, m, box, breaks = motion.n, motion.m, given["uncertain"], given["breaks"]
    count, first, sizes = len(breaks) + 1, 1 + n + m, (given["states"], given["inputs"])
    knots = all(t in motion.t for t in breaks if motion.t[0] < t < motion.t[-1])
    node.require(
        {
            "other states and inputs than the policy's": sizes == (n, m),
            "uncertain should have low <= high": all(low <= high for low, high in box),
            f"uncertain should have at most {MAX_UNCERTAIN} rows": len(box) <= MAX_UNCERTAIN,
            f"valid should have at most {MAX_BOUNDS} rows": len(given["valid"]) <= MAX_BOUNDS,
            "the dynamics change at a time that is no knot": knots,
        }
    )
    bounds: list[Bounds] = [{} for _ in range(count)]
    for row in given["valid"]:
        known = len(row) in (3, 4) and row[0] in range(n + m) and {*row[3:]} <= {*range(count)}
        node.require({"valid: rows (entry of (x, u), low, high), perhaps a span": known})
        j, low, high, *only = row
        for found in [bounds[int(span)] for span in only] or bounds:
            before = found.get(int(j), (low, high))
            found[int(j)] = max(low, before[0]), min(high, before[1])
    equations = [
        [row.polynomial(first + len(box), MAX_DEGREE, bytes) for row in piece.items(n, n)]
        for piece in given["pieces"].items(count, count)
    ]
    rows = [e for span in equations for equation in span for e, _ in equation]
    single = all(max(e[first:], default=0) <= 1 for e in rows)
    node.require({"a monomial should have degree 1 at most in an entry of w": single})
    spans = [sum(t <= start for t in breaks) for start in motion.t[:-1]]
    motion.equations, motion.bounds = [equations[i] for i in spans], [bounds[i] for i in spans]
    motion.pushing = {
        j for j in range(1 + n, first + len(box)) if all(sum(e) == 1 for e in rows if e[j])
    }
    motion.affine = all(max(e[1 + n : first], default=0) <= 1 for e in rows)
    motion.box, motion.expansion = box, given["expansion"]


def pushed(equation: Terms, j: int) -> Fraction:
    """What a unit of variable j adds to one rate, for a variable that only pushes."""
    return sum((c for e, c in equation if e[j]), Fraction(0))


def in_order(node: Node, names: str, needed: Sequence[Key], limited: int) -> list[Piece]:
    """Every piece, in the order of the file.

    Raises Rejected unless their parts of time cover [0, 1] for everything that is needed.
    """
    rate = {"input": whole(0), "sign": whole(-1, 1)} if "input" in names else {}
    place = {"interval": whole(0), "vertex": whole(0), "level": whole(0, MAX_LEVEL)}
    others = dict.fromkeys(f"columns squares {names}".split(), itself)
    table: Table = {**place, "index": whole(0), **others, **rate}
    if limited:
        table["mode"] = lambda entry: entry.wholes(limited)
    pieces: list[Piece] = []
    covered = dict.fromkeys(needed, Fraction(0))
    for entry in node.items(1, MAX_PIECES):
        piece = entry.read(table)
        k, v, level, index = (piece[name] for name in ("interval", "vertex", "level", "index"))
        entry.require({f"index should be below 2^{level}": index < 2**level})
        case = (*(piece[name] for name in rate), *piece.get("mode", ()))
        where = f"interval {k}, vertex {v}, case {case}"
        entry.require({f"no {where}": (k, v, case) in covered}, "not_covered")
        pieces.append(((k, v, case), (k, level, index), piece, f"{entry.where} ({where})"))
    starts = sorted((key, Fraction(i, 2**level), level) for key, (_, level, i), *_ in pieces)
    for key, start, level in starts:
        if start <= covered[key]:
            covered[key] = max(covered[key], start + Fraction(1, 2**level))
    for (k, v, case), until in covered.items():
        wanted = f"a piece of interval {k}, vertex {v}, case {case} is missing"
        node.require({wanted: until >= 1}, "not_covered")
    return pieces


def _times(least: int, most: int) -> Reader:
    """A reader of so many times that increase."""

    def read(node: Node) -> list[Fraction]:
        times: list[Fraction] = node.array(None)
        fits = least <= len(times) <= most and all(a < b for a, b in pairwise(times))
        node.require({f"should be {least} to {most} times that increase": fits})
        return times

    return read


def _curve(node: Node, count: int, *shape: int | None) -> Any:
    curve = node.array(count, None, *shape)
    for control in curve:
        even = all(len(point) == len(curve[0][0]) for point in control)
        fits = 0 < len(control) <= MAX_TIME_DEGREE + 1 and even
        node.require({f"should have curves of degree 0 to {MAX_TIME_DEGREE} in time": fits})
    return curve
