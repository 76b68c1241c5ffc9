"""Claim: funnels that pass into each other where a guard is met, by a reset of the state.

F_a and F_b are funnels of their own dynamics and policies, each with its own clock. A jump from a
to b has a guard g(x), watched from a knot t_w of F_a on, and a reset R(x, w), affine in each entry
of w, which is in a box. It has to show
    g > 0 on F_a(t_w),    g < 0 at the end of F_a, and on every piece of time between them
    c(s, x̄) = ρ_b - |R(x, w) - b|²_{P_b} - τ (ρ - W) - μ g(x) > 0,    x = x₀ + x̄,
for every x̄ and every vertex of w; b, P_b and ρ_b are those of the start of F_b, W = x̄'Px̄ and ρ
those of F_a, τ is a sum of squares, μ any polynomial. |R - b|² is convex in each entry of w. So g
is first 0 in between, in F_a, and R(x, w) is then in F_b at its start.
Why that is enough: docs/certificate_hybrid_funnel.md.
"""

import json
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import chain, product
from math import prod

from . import text
from .closed_loop import FunnelPart, apart, read_multiplier
from .continuous_funnel import MAX_PIECES, decide_funnel, in_order
from .decision import Decision
from .exact import inverse_forms
from .files import Node, Read, Rejected, Terms, bound_files
from .polynomials import Polynomial, Ring, Work, at_width
from .positivity import Squares, expanded, positive, read_squares, read_witness
from .trajectory import MAX_BOUNDS, MAX_DEGREE, MAX_STATES, MAX_UNCERTAIN, Bounds, Funnel

MAX_STAGES = 50  # with as many jumps
MAX_PRODUCTS = 64  # of entries of w, in all of a reset


@dataclass(frozen=True)
class Jump:
    """Guard and reset, polynomials in x and in (x, w); bounds of x where they are valid.

    start: s, from when on the guard is watched. n: how many states there are before it.
    """

    n: int
    start: Fraction
    box: list[tuple[Fraction, Fraction]]
    bounds: Bounds
    expansion: str
    guard: Terms
    reset: list[Terms]


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide every stage, and that each jump leads from one into the next."""
    stated = proof.members("jumps")["jumps"].items(1, MAX_STAGES)
    about = claim.members("kind about")["about"]
    another = f"stage{len(stated) + 1}"  # into which the last jump leads, if not into the first
    count = len(stated) + (type(about.value) is dict and another in about.value)
    stages = [f"stage{i}" for i in range(1, count + 1)]
    jumps = [f"jump{i}" for i in range(1, len(stated) + 1)]
    documents, digests = bound_files(about, read, " ".join(stages + jumps))
    decisions, funnels, work = [], [], Work()
    for role in stages:
        try:
            decision, funnel = _decide_stage(documents[role], read, work)
        except Rejected as refusal:
            raise type(refusal)(f"{role}: {refusal}") from refusal
        decisions.append(decision)
        funnels.append(funnel)
        digests |= {f"{role}.{part}": digest for part, digest in decision.digests.items()}
    assumed = [
        [f"{role}: {assumption}" for assumption in decision.assumptions]
        for role, decision in zip(stages, decisions, strict=True)
    ]
    spans = []
    for i, (role, witness) in enumerate(zip(jumps, stated, strict=True)):
        after = (i + 1) % count
        try:
            jump = read_jump(documents[role])
            _decide_jump(jump, witness, funnels[i], funnels[after], work)
        except Rejected as refusal:
            raise type(refusal)(f"{role}: {refusal}") from refusal
        start, end = text.exact(jump.start), text.exact(funnels[i].t[-1])
        spans.append(f"{stages[i]} between {start} and {end} s")
        assumed.append(_assumptions(jump, role, stages[i], stages[after], funnels[after].t[0]))
    last = (
        f"{stages[-1]} jumps into {stages[0]}, so for ever"
        if len(jumps) == count
        else f"the last is a {decisions[-1].statement}"
    )
    return Decision(
        f"hybrid funnel of {count} stage{'s' * (count > 1)}, each with a clock of its own: every "
        "solution that is in the funnel of a stage at a time at which its guard is not watched "
        "yet, or is above 0, stays in it until the guard is first 0, and is in the funnel of the "
        f"next at its start after the jump; the guard is first 0 in {', in '.join(spans)}; {last}",
        min(decision.margin for decision in decisions),
        tuple(chain.from_iterable(assumed)),
        digests,
    )


def _decide_stage(node: Node, read: Read, work: Work) -> tuple[Decision, Funnel]:
    stage = node.document("proof", "claim proof")
    if stage["claim"].kind() != "continuous_funnel":
        raise Rejected("a stage should claim a continuous_funnel")
    if "hold" in stage["claim"].members("kind about", "goal hold error decay"):
        raise Rejected("an input that is held into the next stage is not covered")
    return decide_funnel(stage["claim"], stage["proof"], read, work)


def read_jump(node: Node) -> Jump:
    """The jump: monomials as in a vector field, each entry of w at most once in one."""
    parts = node.document("jump", "states start uncertain valid expansion guard reset")
    n = parts["states"].whole(1, MAX_STATES)
    box = [(low, high) for low, high in parts["uncertain"].array(None, 2)]
    if len(box) > MAX_UNCERTAIN or any(low > high for low, high in box):
        raise Rejected(f"uncertain should hold at most {MAX_UNCERTAIN} pairs low <= high")
    bounds: Bounds = {}
    for row in parts["valid"].items(0, MAX_BOUNDS):
        j, low, high = row.array(3)
        if j not in range(n):
            raise Rejected(f"{row.where} should be a state, low, high")
        before = bounds.get(int(j), (low, high))
        bounds[int(j)] = max(low, before[0]), min(high, before[1])
    guard = parts["guard"].polynomial(n, MAX_DEGREE, tuple)
    reset = [
        row.polynomial(n + len(box), MAX_DEGREE, tuple)
        for row in parts["reset"].items(1, MAX_STATES)
    ]
    if any(max(e[n:], default=0) > 1 for row in reset for e, _ in row):
        raise Rejected("the reset has degree above 1 in an entry of w")
    if len({e[n:] for row in reset for e, _ in row}) > MAX_PRODUCTS:
        raise Rejected(f"the reset has more than {MAX_PRODUCTS} products of entries of w")
    start, expansion = parts["start"].number(), parts["expansion"].text()
    return Jump(n, start, box, bounds, expansion, guard, reset)


def _decide_jump(jump: Jump, stated: Node, before: Funnel, after: Funnel, work: Work) -> None:
    """The guard falls through 0 in the funnel before, and the reset leads into the one after."""
    states = len(before.x[0][0]), len(after.x[0][0])
    if states != (jump.n, len(jump.reset)):
        raise Rejected(
            f"it leads from {jump.n} states to {len(jump.reset)}, its stages have "
            f"{states[0]} and {states[1]}"
        )
    if jump.start not in before.t[:-1]:
        raise Rejected(f"its guard is watched from {text.exact(jump.start)} s on, which is no knot")
    first, last = before.t.index(jump.start), len(before.t) - 1
    parts = stated.members("start end basis sides multiplier pieces")
    _decide_valid(jump, before, range(first, last), work)
    for name, k, index, sign in (("start", first, 0, 1), ("end", last - 1, 1, -1)):
        decide_side = partial(_decide_side, jump, before, (k, index), sign, parts[name])
        at_width(jump.n, work, decide_side)
    if (last - first) << len(jump.box) > MAX_PIECES:
        raise Rejected(f"more than {MAX_PIECES} intervals times vertices")
    vertices = list(product(*jump.box))
    needed = [(k, v, ()) for k, v in product(range(first, last), range(len(vertices)))]
    order, pieces = in_order(parts["pieces"], "tau mu", needed, 0, work)
    multiplier = parts["multiplier"].monomials(jump.n)

    crossings: dict[tuple[object, ...], Crossing] = {}  # of the last piece: others share it

    def decide_piece(ring: Ring, number: int) -> None:
        (k, v, _), level, index, i = order[number]
        key = ring.width, k, level, index
        if key not in crossings:
            crossings.clear()
            crossings[key] = Crossing(ring, jump, before, after, key[1:])
        crossing, piece = crossings[key], pieces[i]
        tau = piece["tau"].members("columns squares") | {"basis": parts["sides"]}
        mu = read_multiplier(piece["mu"], multiplier, crossing.ring)
        c = crossing.condition(read_squares(tau, crossing.ring), mu, vertices[v])
        squares = read_squares(piece | {"basis": parts["basis"]}, crossing.ring)
        positive(c, squares, crossing.ring, f"piece {i} (interval {k}, vertex {v})")

    for number in range(len(order)):
        at_width(jump.n, work, partial(decide_piece, number=number))


class Crossing:
    """What pieces of one part of time share: polynomials in x̄, and in s on it.

    rooms: ρ_b - |R - b|²_{P_b} by monomials in w, each a product of two that R has.
    """

    def __init__(
        self, ring: Ring, jump: Jump, before: Funnel, after: Funnel, place: tuple[int, int, int]
    ) -> None:
        self.ring, part = ring, FunnelPart(ring, before, place)
        self.gap = part.gap
        (self.guard,) = ring.substituted([jump.guard], part.states)
        reached = apart(ring, jump.reset, part.states)
        none = (0,) * len(jump.box)
        centre = reached.setdefault(none, [ring.made(0) for _ in jump.reset])
        reached[none] = [r - b for r, b in zip(centre, after.x[0][0], strict=True)]
        self.rooms = [((none, none), ring.made(after.rho[0]))]
        for i, (used, left) in enumerate(reached.items()):
            weighed = ring.product(after.P[0], left)
            for other, right in list(reached.items())[i:]:
                twice = 1 if other == used else 2
                self.rooms.append(((used, other), -twice * ring.dot(right, weighed)))

    def condition(self, tau: Squares, mu: Polynomial, w: tuple[Fraction, ...]) -> Polynomial:
        """c(s, x̄) of a piece at a vertex of w."""
        parts: list[tuple[Fraction | int, Polynomial]] = [
            (prod((value for used in pair for value, e in zip(w, used, strict=True) if e),
                  start=Fraction(1)), room)
            for pair, room in self.rooms
        ]  # fmt: skip
        taken = expanded(tau, self.ring) * self.gap
        return self.ring.weighted([*parts, (-1, taken), (-1, mu * self.guard)])


def _decide_valid(jump: Jump, funnel: Funnel, intervals: range, work: Work) -> None:
    """x stays where the guard and the reset are valid: ρ (P⁻¹)_jj <= room² at both knots."""
    unit = {j: [Fraction(i == j) for i in range(jump.n)] for j in jump.bounds}
    for k, knot in product(intervals, (0, 1)):
        work.spend(10 * jump.n**2 * (jump.n + len(unit)))
        forms = inverse_forms(funnel.P[k + knot], list(unit.values()), "P")
        for (j, (low, high)), form in zip(jump.bounds.items(), forms, strict=True):
            middle = [point[j] for point in funnel.x[k]]
            room = min(min(middle) - low, high - max(middle))
            if room < 0 or funnel.rho[k + knot] * form > room * room:
                raise Rejected(
                    f"at {text.exact(funnel.t[k + knot])} s x{j} is not proved to be where the "
                    "guard and the reset are valid"
                )


def _decide_side(
    jump: Jump, funnel: Funnel, at: tuple[int, int], sign: int, stated: Node, ring: Ring
) -> None:
    """sign g - τ (ρ - W) > 0 in the funnel at one end of an interval."""
    k, end = at
    parts = stated.members("basis columns squares tau")
    x = [e + a for a, e in zip(funnel.x[k][-end], ring.variables, strict=True)]
    (guard,) = ring.substituted([jump.guard], x)
    gap = funnel.rho[k + end] - ring.form(funnel.P[k + end], ring.variables)
    tau = expanded(read_witness(parts["tau"], ring), ring)
    when, where = text.exact(funnel.t[k + end]), "above" if sign > 0 else "below"
    what = f"that the guard is {where} 0 at {when} s"
    positive(sign * guard - tau * gap, read_squares(parts, ring), ring, what)


def _assumptions(jump: Jump, role: str, before: str, after: str, clock: Fraction) -> list[str]:
    """What the jump assumes of the system."""
    start = text.exact(jump.start)
    found = [
        f"{role}: when its guard is first 0 at or after {start} s of the clock of {before}, and "
        f"never else, the state becomes the stored reset of it; from then on {after} is what is "
        f"assumed, its clock at {text.exact(clock)} s"
    ]
    if jump.box:
        ranges = (
            f"w{j} in [{text.exact(a)}, {text.exact(b)}]" for j, (a, b) in enumerate(jump.box)
        )
        found.append(f"{role}: {', '.join(ranges)}")
    if jump.expansion:
        found.append(
            f"{role}: its guard and reset expand others, and that the ranges of w cover what they "
            f"leave out is an assumption, computed by: {json.dumps(jump.expansion)}"
        )
    return found
