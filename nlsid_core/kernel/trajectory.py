"""What is read of a trajectory: a vector field, a policy around a nominal, and a funnel.

The nominal's states and inputs and the gains are Bézier curves in each interval between knots.
"""

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

from .exact import Matrix, definite
from .files import Mismatch, Node, Terms, refuse_if

MAX_STATES, MAX_INPUTS, MAX_UNCERTAIN, MAX_LIMITED = 16, 16, 32, 3
MAX_DEGREE, MAX_TIME_DEGREE = 7, 3
MAX_BOUNDS, MAX_KNOTS, MAX_SPANS = 10_000, 10_000, 1000
Bounds = dict[int, tuple[Fraction, Fraction]]
Curve = list[list[list[Fraction]]]  # by interval, control point, entry


@dataclass(frozen=True)
class Field:
    """By time span: bounds of entries of (x, u), and equations in t, x, u and w."""

    n: int
    m: int
    box: list[tuple[Fraction, Fraction]]
    breaks: list[Fraction]
    bounds: list[Bounds]
    expansion: str
    equations: list[list[Terms]]


@dataclass(frozen=True)
class Policy:
    """Control points of u₀ and K; limits: low and high by input."""

    u: Curve
    K: list[list[Matrix]]
    limits: Bounds


@dataclass(frozen=True)
class Funnel:
    """Knots, control points of x₀, and P and ρ at the knots."""

    t: list[Fraction]
    x: Curve
    P: list[Matrix]
    rho: list[Fraction]


def read_field(node: Node) -> Field:
    """The vector field: monomials distinct and increasing, each entry of w at most once in one."""
    names = "states inputs uncertain breaks valid expansion pieces"
    parts = node.document("vector_field", names)
    n, m = parts["states"].whole(1, MAX_STATES), parts["inputs"].whole(0, MAX_INPUTS)
    box = [(low, high) for low, high in parts["uncertain"].array(None, 2)]
    refuse_if(
        len(box) > MAX_UNCERTAIN or any(low > high for low, high in box),
        f"uncertain should hold at most {MAX_UNCERTAIN} pairs low <= high",
    )
    breaks = _increasing(parts["breaks"], 0, MAX_SPANS)
    count = len(breaks) + 1
    bounds: list[Bounds] = [{} for _ in range(count)]
    for row in parts["valid"].items(0, MAX_BOUNDS):
        j, low, high, *only = row.array(4 if type(row.value) is list and row.value[3:] else 3)
        refuse_if(
            j not in range(n + m) or not all(span in range(count) for span in only),
            f"{row.where} should be an entry of (x, u), low, high, and maybe a span",
        )
        for found in [bounds[int(span)] for span in only] or bounds:
            before = found.get(int(j), (low, high))
            found[int(j)] = max(low, before[0]), min(high, before[1])
    equations = [
        [row.polynomial(1 + n + m + len(box), MAX_DEGREE, bytes) for row in piece.items(n, n)]
        for piece in parts["pieces"].items(count, count)
    ]
    refuse_if(
        any(max(e[1 + n + m :], default=0) > 1 for span in equations for p in span for e, _ in p),
        f"{parts['pieces'].where}: a monomial has degree above 1 in an entry of w",
    )
    return Field(n, m, box, breaks, bounds, parts["expansion"].text(), equations)


def read_funnel(node: Node, n: int | None, digests: dict[str, str]) -> Funnel:
    """The funnel: x₀ continuous, P ≻ 0 and ρ > 0 at every knot, and so in between."""
    made_for = {role: digests[role] for role in ("vector_field", "policy")}
    parts = node.document("funnel", "t x P rho", "continuous", made_for=made_for)
    t = _increasing(parts["t"], 2, MAX_KNOTS)
    K = len(t)
    x = _curve(parts["x"], K - 1, n)
    refuse_if(
        any(before[-1] != after[0] for before, after in pairwise(x)),
        "the nominal states of the funnel jump at a knot",
    )
    size = len(x[0][0])
    P, rho = parts["P"].array(K, size, size), parts["rho"].array(K)
    for k in range(K):
        definite(P[k], f"P at knot {k}")
        refuse_if(rho[k] <= 0, f"rho is not positive at knot {k}", "not_below")
    return Funnel(t, x, P, rho)


def read_policy(node: Node, field: Field, funnel: Funnel, digests: dict[str, str]) -> Policy:
    """The policy: around the funnel's own nominal, each input clipped at most once."""
    made_for = {"vector_field": digests["vector_field"]}
    parts = node.document("policy", "t x u K limits", "continuous", made_for=made_for)
    count = len(funnel.x)
    if parts["t"].array(None) != funnel.t or _curve(parts["x"], count, field.n) != funnel.x:
        raise Mismatch("the funnel is around another nominal than the policy's")
    u, K = _curve(parts["u"], count, field.m), _curve(parts["K"], count, field.m, field.n)
    rows = parts["limits"].array(None, 3)
    limits = {int(row[0]): (row[1], row[2]) for row in rows if row[0] in range(field.m)}
    refuse_if(
        len(limits) != len(rows) or len(rows) > MAX_LIMITED,
        f"limits should be at most {MAX_LIMITED} rows, one each for some input",
    )
    refuse_if(
        any(low >= high for low, high in limits.values()),
        "limits should be rows (input, low, high) with low < high",
    )
    return Policy(u, K, limits)


def _increasing(node: Node, least: int, most: int) -> list[Fraction]:
    times: list[Fraction] = node.array(None)
    refuse_if(
        not least <= len(times) <= most or any(b <= a for a, b in pairwise(times)),
        f"{node.where} should be {least} to {most} times that increase",
    )
    return times


def _curve(node: Node, count: int, *shape: int | None) -> list:  # type: ignore[type-arg]
    curve = node.array(count, None, *shape)
    for control in curve:
        refuse_if(
            not 0 < len(control) <= MAX_TIME_DEGREE + 1 or len(control[0]) != len(curve[0][0]),
            f"{node.where} should have degree 0 to {MAX_TIME_DEGREE} in time",
        )
    return curve
