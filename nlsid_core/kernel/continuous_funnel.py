"""Claim: {x : |x - x₀(t)|²_{P(t)} <= ρ(t)} is a funnel of ẋ = f(t, x, u, w), for every t and w.

With x̄ = x - x₀, W = x̄'Px̄ and s in [0, 1] along an interval of length h between knots, on which P
and ρ are linear, every piece [index, index + 1] / 2^level of every interval has to show
    c(s, x̄) = dρ/ds - dW/ds - margin h ρ + μ (ρ - W) - Σ_l τ_l q_l > 0,
    dW/ds = 2x̄'P(h f - dx₀/ds) + x̄'(dP/ds)x̄,
for every x̄: then V = W/ρ falls by margin or more, in 1/s, where V = 1 (thesis (5.5), Lemma 5.2).
f is affine in each entry of w, so a vertex of its box each is enough; or, where w only pushes, with
ẋ = ... + Gw, h |2x̄'Pg| r <= h r (κ(x̄'Pg)² + 1/κ) is added for each w instead, r half its range.
Where u = clip(ũ), ũ = u₀ - Kx̄, each clipped input is free, low or high; τ_l >= 0 multiplies
q_l >= 0 of that mode. Where the input is held, it is clip(ũ) + δ: every corner of δ's box is a case
as every vertex of w is. Why that is enough: docs/certificate_continuous_funnel.md.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import lru_cache, partial
from itertools import product
from typing import Any

from . import text
from .closed_loop import ClosedLoop, Hold, at, decide_rates, read_hold, read_multiplier
from .exact import Matrix, Rows, at_most, dot, identity, inverse_forms, scaled, semidefinite, unit
from .files import Node, Read, Table, bound_files, itself, limit, refuse_if
from .polynomials import Polynomial, Ring, at_width
from .positivity import positive, read_squares
from .trajectory import MAX_PIECES, Field, Funnel, Piece, in_order, pushed, read_field, read_funnel

SENTENCE = (
    "funnel: every solution that {whose} in it at a time from {start:exact} to {end:exact} s, such "
    "as x = ({point}) at {start:exact} s, stays in it until {end:exact} s{goal}{kept}; {count} "
    "pieces of time decided, on its boundary V falls by at least the margin, in 1/s"
)
GOAL = ", ends in the goal, an ellipsoid within {box}"
OBEYED = "the state obeys the stored equations and the stored policy is applied {how}"
AT_ONCE = "continuously, with no hold and no delay"
LATE = (
    "every {0:exact} s or more often: at every time, the input is the policy's of some time at "
    "most {0:exact} s before, and not before the solution's start, for the state then"
)
EXPANDED = (
    "the equations expand others, and that the ranges of w cover what they leave out is an "
    "assumption of the vector field, computed by: {0:quoted}"
)


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Decide that the bound funnel is one for its dynamics and policy, and ends in the goal."""
    return decide_funnel(claim, proof, read)[0]


def decide_funnel(claim: Node, proof: Node, read: Read) -> tuple[text.Verdict, Funnel]:
    """The verdict, and the funnel that it is about."""
    parts = claim.members("kind about", "goal hold error")
    documents, digests = bound_files(parts["about"], read, "vector_field policy funnel")
    funnel = read_funnel(documents, digests)
    field = read_field(documents["vector_field"], funnel)
    table: Table = {"basis": itself, "multiplier": itself, "pieces": itself, "margin": ()}
    if "goal" in parts:
        table |= {"goal_multiplier": ()}
    if "hold" in parts:
        table |= {"rates": itself, "rate_pieces": itself}
    if "hold" in parts or funnel.limits:
        table |= {"sides": itself}
    if field.box:
        table |= {"kappa?": itself}
    stated = proof.read(table)
    proof.require({"the margin should be positive": stated["margin"] > 0}, "not_below")
    hold = read_hold(claim, stated, field, funnel)

    goal = _decide_goal(parts["goal"], stated["goal_multiplier"], funnel) if "goal" in parts else ""
    _decide_valid(field, funnel, hold)
    count = _decide_pieces(field, funnel, hold, stated)
    if hold.period:
        count += decide_rates(field, funnel, hold, stated)
    said = text.say(
        SENTENCE,
        # A held input remembers: only of a solution that starts inside is it one from inside.
        whose="starts" if hold.period else "is",
        start=funnel.t[0],
        end=funnel.t[-1],
        point=", ".join(map(text.exact, funnel.x[0][0])),
        goal=goal,
        kept=_kept(field),
        count=count,
    )
    assumptions = _assumptions(field, funnel, hold)
    return text.Verdict(said, stated["margin"], assumptions, digests), funnel


def inside(
    a: Sequence[Fraction], A: Rows, b: Sequence[Fraction], B: Rows, multiplier: Fraction, what: str
) -> None:
    """Raise Rejected unless {|x-a|²_A <= 1} lies in {|x-b|²_B <= 1}, by the S-lemma."""
    at_most(0, multiplier, what)
    d = [p - q for p, q in zip(a, b, strict=True)]
    Bd = [dot(row, d) for row in B]
    rows = [
        [*(multiplier * p - q for p, q in zip(left, right, strict=True)), -e]
        for left, right, e in zip(A, B, Bd, strict=True)
    ]
    corner = 1 - multiplier - dot(d, Bd)
    semidefinite([*rows, [*(-e for e in Bd), corner]], what)


def _decide_goal(node: Node, multiplier: Fraction, funnel: Funnel) -> str:
    n = len(funnel.x[0][0])
    goal = node.read({"centre": (n,), "P": (n, n)})
    what = "that the funnel ends in the goal, by the S-lemma,"
    last = scaled(funnel.P[-1], 1 / funnel.rho[-1])
    inside(funnel.x[-1][-1], last, goal["centre"], goal["P"], multiplier, what)
    forms = inverse_forms(goal["P"], identity(n), "the goal's matrix")
    reaches = zip(goal["centre"], map(text.root_above, forms), strict=True)
    box = _named("x", enumerate((c - reach, c + reach) for c, reach in reaches), "outer_range")
    return text.say(GOAL, box=box)


def _decide_valid(field: Field, funnel: Funnel, hold: Hold) -> None:
    """x and the input stay where the equations are valid.

    |g'x̄| <= d wherever W <= ρ if ρ g'P⁻¹g <= d², so if d²P - ρgg' ⪰ 0, which holds between knots if
    it does at them. A state has to stay away from its bounds, so that the equations hold around it;
    an input may reach them. A held input is within W of clip(ũ), and within the limits.
    Centres and gains between knots are convex combinations of their control points. A limit within
    the bounds keeps its side by itself. Of another side the other limit has to be W away: it is the
    input where ũ is beyond it, and a held one may be from before these bounds began.
    """
    for k, entries in enumerate(field.bounds):
        kept: list[tuple[int, list[Fraction], Fraction]] = []  # entry, g, room
        for j, (low, high) in entries.items():
            i = j - field.n
            middle = [point[j] for point in funnel.x[k]] if i < 0 else [u[i] for u in funnel.u[k]]
            rows = [unit(j, field.n)] if i < 0 else [gain[i] for gain in funnel.K[k]]
            off = hold.widths[k][i] if i >= 0 else Fraction(0)
            room = [min(middle) - low - off, high - max(middle) - off]
            if i in funnel.limits:
                least, most = funnel.limits[i]
                beyond = (least < low and most < low + off) or (most > high and least > high - off)
                refuse_if(beyond, f"the limits of u{i} lie where f is not valid", "not_valid")
                room = room[least >= low : 2 - (most <= high)]
            kept += [(j, row, min(room)) for row in rows if room]
        for knot in (k, k + 1):
            forms = inverse_forms(funnel.P[knot], [g for _, g, _ in kept], "P")
            for (j, _, margin), form in zip(kept, forms, strict=True):
                reached = funnel.rho[knot] * form
                within = reached < margin**2 or (reached == margin**2 and j >= field.n)
                where = f"at {text.exact(funnel.t[knot])} s entry {j} of (x, u)"
                leaves = f"{where} is not proved to stay where its dynamics are valid"
                refuse_if(margin < 0 or not within, leaves, "not_valid")


def _decide_pieces(field: Field, funnel: Funnel, hold: Hold, stated: dict[str, Any]) -> int:
    """Prove c > 0 on every piece, and that the pieces cover every time, vertex and mode."""
    first, count, limited = 1 + field.n + field.m, len(funnel.x), len(funnel.limits)
    columns = range(first, first + len(field.box))
    halves = [(high - low) / 2 for low, high in field.box]
    values: Iterable[tuple[Fraction, ...]] = product(*field.box)
    kappa: Matrix = []
    if stated.get("kappa"):
        kappa = stated["kappa"].array(count, len(field.box))
        above = all(entry > 0 for row in kappa for entry in row)
        stated["kappa"].require({"should be positive": above}, "not_below")
        pushing = {"w does more than add constants": field.pushing.issuperset(columns)}
        stated["kappa"].require(pushing, "not_valid")
        values = [tuple((low + high) / 2 for low, high in field.box)]
    most = count * 2 ** (0 if kappa else len(field.box)) * len(hold.corners) * 3**limited
    limit(most, MAX_PIECES, "intervals, vertices and modes")
    vertices = list(product(hold.corners, values))
    needed = list(product(range(count), range(len(vertices)), funnel.modes))
    pieces = in_order(stated["pieces"], "mu" + " tau" * bool(limited), needed, limited)
    multiplier = stated["multiplier"].monomials(field.n)
    loops = lru_cache(maxsize=1)(partial(ClosedLoop, funnel))

    def pushes(loop: ClosedLoop) -> list[Polynomial]:
        """-h r (κ(x̄'Pg)² + 1/κ) for each entry of w."""
        found = []
        for j, half, factor in zip(columns, halves, kappa[loop.k], strict=True):
            along = loop.ring.dot([pushed(p, j) for p in field.equations[loop.k]], loop.Px)
            found.append(-loop.h * half * (factor * (along * along) + 1 / factor))
        return found

    def decide_piece(ring: Ring, piece: Piece) -> None:
        (k, v, mode), part, members = piece
        loop, (corner, w) = loops(ring, part, mode), vertices[v]
        f = loop.rates(at(field.equations[k], w), corner, hold.widths[k])
        mu = read_multiplier(members["mu"], multiplier, ring)
        parts = [loop.drift, -stated["margin"] * loop.h * loop.rho, mu * loop.gap]
        parts += [-2 * loop.h * ring.dot(f, loop.Px), *(pushes(loop) if kappa else [])]
        if limited:
            parts += loop.taken(members["tau"], loop.held, stated["sides"])
        squares = read_squares(members | {"basis": stated["basis"]}, ring)
        what = f"{members['mu'].where} (interval {k}, vertex {v}, mode {mode})"
        positive(ring.sum(parts), squares, ring, what)

    at_width(field.n, pieces, decide_piece)
    return len(pieces)


def _kept(field: Field) -> str:
    """Where x and u are proved to stay, at all times."""
    bounds, n = field.bounds, field.n
    always = sorted(set.intersection(*map(set, bounds)))
    ends = {j: (min(b[j][0] for b in bounds), max(b[j][1] for b in bounds)) for j in always}
    shown = [
        _named("x", ((j, ends[j]) for j in always if j < n), "outer_range"),
        _named("u", ((j - n, ends[j]) for j in always if j >= n), "outer_range"),
        "the bounds of each time span" if any(b != bounds[0] for b in bounds) else "",
    ]
    return f", and keeps {', '.join(filter(None, shown))}" if any(shown) else ""


def _assumptions(field: Field, funnel: Funnel, hold: Hold) -> tuple[str, ...]:
    how = text.say(LATE, hold.period) if hold.period else AT_ONCE
    if any(hold.error):
        errors = ", ".join(f"x{i} by {text.exact(e)}" for i, e in enumerate(hold.error) if e)
        how += f", measured wrong by at most: {errors}"
    for i in range(field.m):
        if i in funnel.limits:
            how += f", u{i} clipped to {text.PRINTED['exact_range'](funnel.limits[i])}"
        elif not all(field.n + i in entries for entries in field.bounds):
            how += f", u{i} without saturation"
    ranges = _named("w", enumerate(field.box), "exact_range")
    found = [text.say(OBEYED, how=how)] + [f"at every time {ranges}"] * bool(ranges)
    if field.expansion:
        found.append(text.say(EXPANDED, field.expansion))
    return tuple(found)


def _named(letter: str, ends: Iterable[tuple[int, Sequence[Fraction]]], how: str) -> str:
    """`x0 in [LOW, HIGH], ...`."""
    return ", ".join(f"{letter}{i} in {text.PRINTED[how](pair)}" for i, pair in ends)
