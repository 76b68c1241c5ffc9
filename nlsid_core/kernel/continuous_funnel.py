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
from dataclasses import dataclass
from fractions import Fraction
from itertools import product

from . import text
from .closed_loop import Loops, Push, at, read_multiplier
from .decision import Decision
from .exact import at_most, dot, inverse_forms, semidefinite, unit
from .files import Node, Read, Rejected, bound_files, refuse_if
from .held import Hold, decide_rates, read_hold
from .pieces import Piece, in_order, modes_of, pushed, pushing, refuse_many
from .polynomials import Ring, at_width
from .positivity import positive, read_squares
from .trajectory import Bounds, Field, Funnel, Policy, read_field, read_funnel, read_policy

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


@dataclass(frozen=True)
class Stage:
    """What a claim is about, read: `spans` has the time span of the equations of every interval."""

    field: Field
    policy: Policy
    funnel: Funnel
    spans: list[int]
    hold: Hold

    @property
    def bounds(self) -> list[Bounds]:
        """By interval, where the equations are valid."""
        return [self.field.bounds[span] for span in self.spans]


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide that the bound funnel is one for its dynamics and policy, and ends in the goal."""
    return decide_funnel(claim, proof, read)[0]


def decide_funnel(claim: Node, proof: Node, read: Read) -> tuple[Decision, Funnel]:
    """The decision, and the funnel that it is about."""
    parts = claim.members("kind about", "goal hold error")
    documents, digests = bound_files(parts["about"], read, "vector_field policy funnel")
    field = read_field(documents["vector_field"])
    funnel = read_funnel(documents["funnel"], field.n, digests)
    policy = read_policy(documents["policy"], field, funnel, digests)
    required = "basis pieces margin multiplier" + " goal_multiplier" * ("goal" in parts)
    required += " sides" * bool(policy.limits or "hold" in parts)
    required += " rates rate_pieces" * ("hold" in parts)
    stated = proof.members(required, "kappa" if field.box else "")
    margin = stated["margin"].number()
    refuse_if(margin <= 0, "the margin should be positive", "not_below")
    for t in field.breaks:
        refuse_if(
            funnel.t[0] < t < funnel.t[-1] and t not in funnel.t,
            f"the dynamics change at {text.exact(t)} s, which is no knot",
        )
    spans = [sum(t <= start for t in field.breaks) for start in funnel.t[:-1]]
    hold = read_hold(parts, stated, field, policy, funnel)
    stage = Stage(field, policy, funnel, spans, hold)

    goal = _decide_goal(parts["goal"], stated, funnel) if "goal" in parts else ""
    _decide_valid(stage)
    count = _decide_pieces(stage, stated, margin)
    if hold.period:
        count += decide_rates(field, policy, funnel, spans, stated, hold)
    said = text.say(
        SENTENCE,
        # A held input remembers: only of a solution that starts inside is it one from inside.
        whose="starts" if hold.period else "is",
        start=funnel.t[0],
        end=funnel.t[-1],
        point=", ".join(map(text.exact, funnel.x[0][0])),
        goal=goal,
        kept=_kept(field, stage.bounds),
        count=count,
    )
    return Decision(said, margin, _assumptions(stage), digests), funnel


def inside(
    a: Sequence[Fraction],
    A: Sequence[Sequence[Fraction]],
    rho: Fraction,
    b: Sequence[Fraction],
    B: Sequence[Sequence[Fraction]],
    multiplier: Fraction,
    what: str,
) -> None:
    """Raise Rejected unless {|x-a|²_A <= rho} lies in {|x-b|²_B <= 1}, by the S-lemma."""
    at_most(0, multiplier, what)
    d = [p - q for p, q in zip(a, b, strict=True)]
    Bd = [dot(row, d) for row in B]
    rows = [
        [*(multiplier * p / rho - q for p, q in zip(left, right, strict=True)), -e]
        for left, right, e in zip(A, B, Bd, strict=True)
    ]
    corner = 1 - multiplier - dot(d, Bd)
    semidefinite([*rows, [*(-e for e in Bd), corner]], what)


def _decide_goal(node: Node, stated: dict[str, Node], funnel: Funnel) -> str:
    goal, n = node.members("centre P"), len(funnel.x[0][0])
    centre, P = goal["centre"].array(n), goal["P"].array(n, n)
    multiplier = stated["goal_multiplier"].number()
    what = "that the funnel ends in the goal, by the S-lemma,"
    inside(funnel.x[-1][-1], funnel.P[-1], funnel.rho[-1], centre, P, multiplier, what)
    forms = inverse_forms(P, [unit(i, n) for i in range(n)], "the goal's matrix")
    reaches = list(map(text.root_above, forms))
    ends = [(c - reach, c + reach) for c, reach in zip(centre, reaches, strict=True)]
    return text.say(GOAL, box=_named("x", enumerate(ends), "outer_range"))


def _decide_valid(stage: Stage) -> None:
    """x and the input stay where the equations are valid.

    |g'x̄| <= d wherever W <= ρ if ρ g'P⁻¹g <= d², so if d²P - ρgg' ⪰ 0, which holds between knots if
    it does at them. A state has to stay away from its bounds, so that the equations hold around it;
    an input may reach them. A held input is within W of clip(ũ), and within the limits.
    Centres and gains between knots are convex combinations of their control points. A limit within
    the bounds keeps its side by itself. Of another side the other limit has to be W away: it is the
    input where ũ is beyond it, and a held one may be from before these bounds began.
    """
    field, policy, funnel = stage.field, stage.policy, stage.funnel
    for k, entries in enumerate(stage.bounds):
        kept: list[tuple[int, list[Fraction], Fraction]] = []  # entry, g, room
        for j, (low, high) in entries.items():
            i = j - field.n
            middle = [point[j] for point in funnel.x[k]] if i < 0 else [u[i] for u in policy.u[k]]
            rows = [unit(j, field.n)] if i < 0 else [gain[i] for gain in policy.K[k]]
            off = stage.hold.widths[k][i] if i >= 0 else Fraction(0)
            room = [min(middle) - low - off, high - max(middle) - off]
            if i in policy.limits:
                least, most = policy.limits[i]
                refuse_if(
                    (least < low and most < low + off) or (most > high and least > high - off),
                    f"the limits of u{i} lie where its dynamics are not valid",
                    "not_valid",
                )
                room = room[least >= low : 2 - (most <= high)]
            kept += [(j, row, min(room)) for row in rows if room]
        for knot in (k, k + 1):
            forms = inverse_forms(funnel.P[knot], [g for _, g, _ in kept], "P")
            for (j, _, room_), form in zip(kept, forms, strict=True):
                reached = funnel.rho[knot] * form
                touches = reached == room_**2 and j < field.n
                if room_ < 0 or reached > room_**2 or touches:
                    where = f"at {text.exact(funnel.t[knot])} s entry {j} of (x, u)"
                    leaves = f"the funnel leaves where its dynamics are valid: {where}"
                    raise Rejected(f"{leaves} is not proved to keep its bounds", "not_valid")


def _decide_pieces(stage: Stage, stated: dict[str, Node], margin: Fraction) -> int:
    """Prove c > 0 on every piece, and that the pieces cover every time, vertex and mode."""
    field, policy, funnel, hold = stage.field, stage.policy, stage.funnel, stage.hold
    first, count, limited = 1 + field.n + field.m, len(stage.spans), len(policy.limits)
    kappa = None
    if "kappa" in stated:
        kappa = stated["kappa"].array(count, len(field.box))
        refuse_if(
            any(k <= 0 for row in kappa for k in row), "kappa should be positive", "not_below"
        )
        refuse_if(
            len(pushing(field, first, len(field.box))) < len(field.box),
            "w does more than add constants: kappa does not bound what it does",
            "not_valid",
        )
    refuse_many(count, 2 ** (0 if kappa else len(field.box)), len(hold.corners), 3**limited)
    middle = [tuple((low + high) / 2 for low, high in field.box)]
    vertices = list(product(hold.corners, middle if kappa else product(*field.box)))
    needed = list(product(range(count), range(len(vertices)), modes_of(policy)))
    names = "mu" + " tau mode" * bool(limited)
    pieces = in_order(stated["pieces"], names, needed, limited)
    multiplier, loops = stated["multiplier"].monomials(field.n), Loops(policy, funnel)

    def pushes(k: int) -> list[Push]:
        if kappa is None:
            return []
        equations = field.equations[stage.spans[k]]
        columns = ([pushed(p, first + j) for p in equations] for j in range(len(field.box)))
        halves = [(high - low) / 2 for low, high in field.box]
        return list(zip(halves, kappa[k], columns, strict=True))

    def decide_piece(ring: Ring, piece: Piece) -> None:
        (k, v, mode), members = piece.key, piece.members
        corner, w = vertices[v]
        loop = loops.loop(ring, piece.part, mode, hold.widths[k])
        f = loop.rates(at(field.equations[stage.spans[k]], w), corner)
        mu = read_multiplier(members["mu"], multiplier, ring)
        parts = [loop.rest(margin, pushes(k)), mu * loop.gap]
        parts.append(-2 * loop.h * ring.dot(f, loop.Px))
        if limited:
            parts += loop.taken(members["tau"], loop.held, stated["sides"])
        squares = read_squares(members | {"basis": stated["basis"]}, ring)
        what = f"piece {piece.place} (interval {k}, vertex {v}, mode {mode})"
        positive(ring.sum(parts), squares, ring, what)

    at_width(field.n, pieces, decide_piece)
    return len(pieces)


def _kept(field: Field, bounds: list[Bounds]) -> str:
    """Where x and u are proved to stay, at all times."""
    always = sorted(set.intersection(*map(set, bounds)))
    ends = {j: (min(b[j][0] for b in bounds), max(b[j][1] for b in bounds)) for j in always}
    shown = [
        _named("x", ((j, ends[j]) for j in always if j < field.n), "outer_range"),
        _named("u", ((j - field.n, ends[j]) for j in always if j >= field.n), "outer_range"),
        "the bounds of each time span" if any(b != bounds[0] for b in bounds) else "",
    ]
    return f", and keeps {', '.join(filter(None, shown))}" if any(shown) else ""


def _assumptions(stage: Stage) -> tuple[str, ...]:
    field, hold, limits = stage.field, stage.hold, stage.policy.limits
    how = text.say(LATE, hold.period) if hold.period else AT_ONCE
    if any(hold.error):
        errors = ", ".join(f"x{i} by {text.exact(e)}" for i, e in enumerate(hold.error) if e)
        how += f", measured wrong by at most: {errors}"
    for i in range(field.m):
        if i in limits:
            how += f", u{i} clipped to {text.PRINTED['exact_range'](limits[i])}"
        elif not all(field.n + i in entries for entries in stage.bounds):
            how += f", u{i} without saturation"
    ranges = _named("w", enumerate(field.box), "exact_range")
    found = [text.say(OBEYED, how=how)] + [f"at every time {ranges}"] * bool(ranges)
    if field.expansion:
        found.append(text.say(EXPANDED, field.expansion))
    return tuple(found)


def _named(letter: str, ends: Iterable[tuple[int, tuple[Fraction, Fraction]]], how: str) -> str:
    """`x0 in [LOW, HIGH], ...`."""
    return ", ".join(f"{letter}{i} in {text.PRINTED[how](pair)}" for i, pair in ends)
