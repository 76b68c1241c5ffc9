"""Claim: {x : |x - x₀(t)|²_{P(t)} <= ρ(t)} is a funnel of ẋ = f(t, x, u, w), for every t and w.

With x̄ = x - x₀, W = x̄'Px̄ and s in [0, 1] along an interval of length h between knots, on which P
and ρ are linear, every piece of time, vertex of w's box, and mode of clipped inputs has to show
    c(s, x̄) = dρ/ds - dW/ds - margin h ρ + μ (ρ - W) - Σ_l τ_l q_l > 0
for every x̄: then V = W/ρ falls by margin or more, in 1/s, where V = 1. A corner of the box of δ,
what a held input is off, is a case as a vertex is. docs/certificate_continuous_funnel.md, 1. to 8.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import product
from typing import Any

from . import text
from .closed_loop import (
    MAX_PIECES,
    Case,
    ClosedLoop,
    Motion,
    decide_pieces,
    decide_rates,
    pushed,
    read_hold,
    read_motion,
    read_multiplier,
)
from .exact import Rows, at_most, dot, identity, inverse_forms, scaled, semidefinite, unit
from .files import Node, Read, Table, bound_files, limit, refuse_if
from .polynomials import Polynomial

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


def decide_funnel(claim: Node, proof: Node, read: Read) -> tuple[text.Verdict, Motion]:
    """The verdict, and the funnel that it is about."""
    parts = claim.members("kind about goal? hold? error?")
    documents, digests = bound_files(parts["about"], read, "vector_field policy funnel")
    motion = read_motion(documents, digests)
    held = "hold" in parts
    names = "basis multiplier pieces" + " rates rate_pieces" * held
    names += " sides" * bool(held or motion.limits) + " kappa?" * bool(motion.box)
    ends: Table = {"margin": (), **({"goal_multiplier": ()} if "goal" in parts else {})}
    stated = proof.read({**ends, **dict.fromkeys(names.split())})
    proof.require({"the margin should be positive": stated["margin"] > 0}, "not_below")
    read_hold(claim, stated, motion)

    goal = _decide_goal(parts["goal"], stated["goal_multiplier"], motion) if "goal" in parts else ""
    _decide_valid(motion)
    count = _decide_decrease(motion, stated)
    if motion.period:
        count += decide_rates(motion, stated)
    said = text.say(
        SENTENCE,
        # A held input remembers: only of a solution that starts inside is it one from inside.
        whose="starts" if motion.period else "is",
        start=motion.t[0],
        end=motion.t[-1],
        point=", ".join(map(text.exact, motion.x[0][0])),
        goal=goal,
        kept=_kept(motion),
        count=count,
    )
    return text.Verdict(said, stated["margin"], _assumptions(motion), digests), motion


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
    semidefinite([*rows, [*(-e for e in Bd), 1 - multiplier - dot(d, Bd)]], what)


def _decide_goal(node: Node, multiplier: Fraction, motion: Motion) -> str:
    goal = node.read({"centre": (motion.n,), "P": (motion.n, motion.n)})
    last = scaled(motion.P[-1], 1 / motion.rho[-1])
    what = "that the funnel ends in the goal, by the S-lemma,"
    inside(motion.x[-1][-1], last, goal["centre"], goal["P"], multiplier, what)
    forms = inverse_forms(goal["P"], identity(motion.n), "the goal's matrix")
    reaches = zip(goal["centre"], map(text.root_above, forms), strict=True)
    box = _named("x", enumerate((c - reach, c + reach) for c, reach in reaches), "outer_range")
    return text.say(GOAL, box=box)


def _decide_valid(motion: Motion) -> None:
    """x and the input stay where the equations are valid.

    |g'x̄| <= d wherever W <= ρ if ρ g'P⁻¹g <= d², so if d²P - ρgg' ⪰ 0, which holds between knots if
    it does at them. A state stays away from its bounds; an input may reach them. A limit within the
    bounds keeps its side by itself; of another side the other limit has to be W away (page, 4.).
    """
    n = motion.n
    for k, entries in enumerate(motion.bounds):
        kept: list[tuple[int, list[Fraction], Fraction]] = []  # entry, g, room
        for j, (low, high) in entries.items():
            i = j - n
            middle = [point[j] for point in motion.x[k]] if i < 0 else [u[i] for u in motion.u[k]]
            rows = [unit(j, n)] if i < 0 else [gain[i] for gain in motion.K[k]]
            off = motion.widths[k][i] if i >= 0 else Fraction(0)
            room = [min(middle) - low - off, high - max(middle) - off]
            if i in motion.limits:
                least, most = motion.limits[i]
                beyond = (least < low and most < low + off) or (most > high and least > high - off)
                refuse_if(beyond, f"the limits of u{i} lie where f is not valid", "not_valid")
                if most <= high:
                    room.pop()
                if least >= low:
                    room.pop(0)
            kept += [(j, row, min(room)) for row in rows if room]
        for knot in (k, k + 1):
            forms = inverse_forms(motion.P[knot], [g for _, g, _ in kept], "P")
            for (j, _, room_left), form in zip(kept, forms, strict=True):
                reached, room2 = motion.rho[knot] * form, room_left**2
                leaves = room_left < 0 or reached > room2 or (reached == room2 and j < n)
                where = f"at {text.exact(motion.t[knot])} s entry {j} of (x, u)"
                can = f"{where} is not proved to stay where its dynamics are valid"
                refuse_if(leaves, can, "not_valid")


def _decide_decrease(motion: Motion, stated: dict[str, Any]) -> int:
    """Prove c > 0 on every piece, and that the pieces cover every time, vertex and mode."""
    first, count, box = 1 + motion.n + motion.m, len(motion.x), motion.box
    halves, middle = ([(high + sign * low) / 2 for low, high in box] for sign in (-1, 1))
    kappa = stated["kappa"].array(count, len(box)) if stated.get("kappa") else []
    if kappa:
        above = all(entry > 0 for row in kappa for entry in row)
        stated["kappa"].require({"should be positive": above}, "not_below")
        pushing = motion.pushing.issuperset(range(first, first + len(box)))
        stated["kappa"].require({"w does more than add constants": pushing}, "not_valid")
    most = len(motion.corners) * (1 if kappa else 2 ** len(box)) * len(motion.modes)
    limit(count * most, MAX_PIECES, "intervals, vertices and modes")
    values = [middle] if kappa else product(*box)
    multiplier = stated["multiplier"].monomials(motion.n)

    def parts(
        piece: dict[str, Any], _: Case, loop: ClosedLoop, f: list[Polynomial]
    ) -> list[Polynomial]:
        h, dot = loop.h, loop.ring.dot
        found = [loop.drift, -stated["margin"] * h * loop.rho, -2 * h * dot(f, loop.Px)]
        found.append(read_multiplier(piece["mu"], multiplier, loop.ring) * loop.gap)
        for j, half in enumerate(halves if kappa else []):  # -h r (κ(x̄'Pg)² + 1/κ)
            along = dot([pushed(p, first + j) for p in motion.equations[loop.k]], loop.Px)
            factor = kappa[loop.k][j]
            found.append(-h * half * (factor * (along * along) + 1 / factor))
        return found + (loop.taken(piece["tau"], loop.held, stated["sides"]) if loop.held else [])

    vertices = list(product(motion.corners, values))
    return decide_pieces(motion, stated, "pieces", vertices, motion.modes, parts)


def _kept(motion: Motion) -> str:
    """Where x and u are proved to stay, at all times."""
    bounds, n = motion.bounds, motion.n
    always = sorted(set.intersection(*map(set, bounds)))
    ends = {j: (min(b[j][0] for b in bounds), max(b[j][1] for b in bounds)) for j in always}
    shown = [
        _named("x", ((j, ends[j]) for j in always if j < n), "outer_range"),
        _named("u", ((j - n, ends[j]) for j in always if j >= n), "outer_range"),
        "the bounds of each time span" if any(b != bounds[0] for b in bounds) else "",
    ]
    return f", and keeps {', '.join(filter(None, shown))}" if any(shown) else ""


def _assumptions(motion: Motion) -> tuple[str, ...]:
    how = text.say(LATE, motion.period) if motion.period else AT_ONCE
    if any(motion.error):
        errors = ", ".join(f"x{i} by {text.exact(e)}" for i, e in enumerate(motion.error) if e)
        how += f", measured wrong by at most: {errors}"
    for i in range(motion.m):
        if i in motion.limits:
            how += f", u{i} clipped to {text.PRINTED['exact_range'](motion.limits[i])}"
        elif not all(motion.n + i in entries for entries in motion.bounds):
            how += f", u{i} without saturation"
    ranges = _named("w", enumerate(motion.box), "exact_range")
    found = [text.say(OBEYED, how=how)] + [f"at every time {ranges}"] * bool(ranges)
    return (*found, *[text.say(EXPANDED, motion.expansion)] * bool(motion.expansion))


def _named(letter: str, ends: Iterable[tuple[int, Sequence[Fraction]]], how: str) -> str:
    """`x0 in [LOW, HIGH], ...`."""
    return ", ".join(f"{letter}{i} in {text.PRINTED[how](pair)}" for i, pair in ends)
