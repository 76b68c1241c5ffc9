"""Claim: {x : |x - x₀(t)|²_{P(t)} <= ρ(t)} is a funnel of ẋ = f(t, x, u, w), for every t and w.

With x̄ = x - x₀, W = x̄'Px̄ and s in [0, 1] along an interval of length h between knots, on which P
and ρ are linear, every piece [index, index + 1] / 2^level of every interval has to show
    c(s, x̄) = dρ/ds - dW/ds - margin h ρ + μ (ρ - W) - Σ_l τ_l q_l > 0,
    dW/ds = 2x̄'P(h f - dx₀/ds) + x̄'(dP/ds)x̄,
for every x̄: then V = W/ρ falls by margin or more, in 1/s, where V = 1 (thesis (5.5), Lemma 5.2).
f is affine in each entry of w, so a vertex of its box each is enough; or, where w only pushes, with
ẋ = ... + Gw, h |2x̄'Pg| r <= h r (κ(x̄'Pg)² + 1/κ) is added for each w instead, r half its range.
Where u = clip(ũ), ũ = u₀ - Kx̄, each clipped input is free, low or high; τ_l >= 0 multiplies
q_l >= 0 of that mode. Where V is claimed to decay, dV/dt <= λ(σ - V) wherever σ <= V <= 1, so
    c(s, x̄) = W dρ/ds - ρ dW/ds + hλρ (σρ - W) - τ (ρ - W) - τ' (W - σρ) - Σ_l τ_l q_l > 0
instead (Lemma 5.3). Where the input is held, it is clip(ũ) + δ with |δ_i| <= W_i: every corner of
that box is a case as every vertex of w is, and pieces of rates show that |dũ_i/dt| < R_i.
Why that is enough: docs/certificate_continuous_funnel.md.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import pairwise, product
from math import prod

from . import text
from .closed_loop import ClosedLoop, Decay
from .decision import Decision
from .exact import at_most, inverse_forms, semidefinite
from .files import Node, Read, Rejected, Terms, bound_files
from .polynomials import Ring, Work, at_width
from .positivity import positive, read_squares
from .trajectory import Bounds, Field, Funnel, Policy, read_field, read_funnel, read_policy

HOLD_COST = 4  # of comparing one rate with another, in products
MAX_LEVEL, MAX_PIECES = 16, 100_000
PIECE = 10_000  # of the work that a claim may take: what a piece costs at the least


@dataclass(frozen=True)
class Hold:
    """By interval and input: the bounds R of |dũ/dt| in 1/s, and W of what u is off.

    period: how old the applied input is at most, in s. error: bounds by state. Both may be 0.
    """

    period: Fraction
    error: list[Fraction]
    rates: list[list[Fraction]]
    widths: list[list[Fraction]]

    @property
    def moved(self) -> int:
        """How many inputs are off."""
        return len(self.widths[0]) if self.period or any(self.error) else 0

    @property
    def corners(self) -> list[tuple[int, ...]]:
        """The corners of the box of δ / W."""
        return list(product((-1, 1), repeat=self.moved))

    def push(self, k: int, corner: tuple[int, ...]) -> list[Fraction]:
        """δ at a corner, in interval k."""
        return [side * width for side, width in zip(corner, self.widths[k], strict=False)]


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide that the bound funnel is one for its dynamics and policy, and ends in the goal."""
    return decide_funnel(claim, proof, read)[0]


def decide_funnel(
    claim: Node, proof: Node, read: Read, work: Work | None = None
) -> tuple[Decision, Funnel]:
    """The decision, and the funnel that it is about; `work` is shared by several."""
    parts = claim.members("kind about", "goal hold error decay")
    documents, digests = bound_files(parts["about"], read, "vector_field policy funnel")
    field = read_field(documents["vector_field"])
    funnel = read_funnel(documents["funnel"], field.n, digests)
    policy = read_policy(documents["policy"], field, funnel, digests)
    required = "basis pieces" + " goal_multiplier" * ("goal" in parts)
    required += " margin multiplier" * ("decay" not in parts)
    required += " sides" * bool(policy.limits or "hold" in parts or "decay" in parts)
    required += " rates rate_pieces" * ("hold" in parts)
    stated = proof.members(required, "kappa" if field.box else "")
    falls = _read_decay(parts["decay"]) if "decay" in parts else stated["margin"].number()
    margin = falls.rate * (1 - falls.floor) if isinstance(falls, Decay) else falls
    if margin <= 0:
        raise Rejected("the margin should be positive")
    goal = _decide_goal(parts["goal"], stated, funnel) if "goal" in parts else ""
    for t in field.breaks:
        if funnel.t[0] < t < funnel.t[-1] and t not in funnel.t:
            raise Rejected(f"the dynamics change at {text.exact(t)} s, which is no knot")
    work = work or Work()
    hold = _read_hold(parts, stated, field, policy, funnel, work)
    spans = [sum(t <= start for t in field.breaks) for start in funnel.t[:-1]]
    bounds = [field.bounds[span] for span in spans]
    _decide_valid(field, policy, funnel, bounds, hold, work)
    count = _decide_pieces(field, policy, funnel, spans, stated, falls, hold, work)
    if hold.period:
        count += _decide_rates(field, policy, funnel, spans, stated, hold, work)
    end = text.exact(funnel.t[-1])
    # A held input remembers: only of a solution that starts inside is it always one from inside.
    whose = "that starts in it" if hold.period else "that is in it"
    decision = Decision(
        f"funnel: every solution {whose} at a time from {text.exact(funnel.t[0])} to {end} s "
        f"stays in it until {end} s{goal}{_kept(field, bounds)}{_falls(falls, end)}; {count} "
        "pieces of time decided, on its boundary V falls by at least the margin, in 1/s",
        margin,
        _assumptions(field, policy, bounds, hold),
        digests,
    )
    return decision, funnel


def _read_hold(
    parts: dict[str, Node], stated: dict[str, Node], field: Field, policy: Policy, funnel: Funnel,
    work: Work,
) -> Hold:  # fmt: skip
    """The hold and the measurement error that the claim is about, and what u is off by then.

    At a time in interval k the input is of a time in it or in one that ends less than a period
    before it starts: W is period times the largest rate there, and what e does to the largest Ke.
    """
    period, error = Fraction(0), [Fraction(0)] * field.n
    rates = [[Fraction(0)] * field.m for _ in funnel.x]
    if "hold" in parts:
        period = parts["hold"].number()
        rates = stated["rates"].array(len(funnel.x), field.m)
        if period <= 0 or any(rate <= 0 for row in rates for rate in row):
            raise Rejected("hold and rates should be positive")
        jumps = [p[-1] != q[0] for p, q in pairwise(policy.u)]
        if any(jumps) or any(p[-1] != q[0] for p, q in pairwise(policy.K)):
            raise Rejected("the policy jumps at a knot: no rate bounds what holding it changes")
    if "error" in parts:
        error = parts["error"].array(field.n)
        if any(e < 0 for e in error):
            raise Rejected("error should be 0 or more for every state")
    exponents = [e for span in field.equations for equation in span for e, _ in equation]
    if len(parts.keys() & {"hold", "error"}) and any(
        e > 1 for row in exponents for e in row[1 + field.n : 1 + field.n + field.m]
    ):
        raise Rejected("the dynamics are not affine in each input: corners do not bound its hold")
    shaken = [
        [max(_product(map(abs, gain[i]), error) for gain in points) for i in range(field.m)]
        for points in policy.K
    ]
    widths: list[list[Fraction]] = []
    first = 0
    for k in range(len(funnel.x)):
        while funnel.t[first + 1] <= funnel.t[k] - period:
            first += 1
        seen = range(first, k + 1)
        work.spend(HOLD_COST * len(seen) * field.m)
        widths.append(
            [
                period * max(rates[j][i] for j in seen) + max(shaken[j][i] for j in seen)
                for i in range(field.m)
            ]
        )
    return Hold(period, error, rates, widths)


def _read_decay(node: Node) -> Decay:
    parts = node.members("rate floor")
    decay = Decay(parts["rate"].number(), parts["floor"].number())
    if decay.rate <= 0 or not 0 <= decay.floor < 1:
        raise Rejected("decay should have a rate above 0 and a floor from 0 to below 1")
    return decay


def _falls(falls: Decay | Fraction, end: str) -> str:
    if not isinstance(falls, Decay):
        return ""
    rate, floor = text.exact(falls.rate), text.exact(falls.floor)
    return (
        f", and for any times t1 <= t2 from then until {end} s V(t2) <= {floor} or V(t2) <= "
        f"{floor} + exp(-{rate} (t2 - t1)) (V(t1) - {floor}), V = |x - x0|^2_P / rho"
    )


def inside(
    a: Sequence[Fraction], A: Sequence[Sequence[Fraction]], rho: Fraction,
    b: Sequence[Fraction], B: Sequence[Sequence[Fraction]], multiplier: Fraction, what: str,
) -> None:  # fmt: skip
    """Raise Rejected unless {|x-a|²_A <= rho} lies in {|x-b|²_B <= 1}, by the S-lemma."""
    at_most(0, multiplier, what)
    d = [p - q for p, q in zip(a, b, strict=True)]
    Bd = [_product(row, d) for row in B]
    rows = [
        [*(multiplier * p / rho - q for p, q in zip(left, right, strict=True)), -e]
        for left, right, e in zip(A, B, Bd, strict=True)
    ]
    corner = 1 - multiplier - _product(d, Bd)
    semidefinite([*rows, [*(-e for e in Bd), corner]], what)


def _decide_goal(node: Node, stated: dict[str, Node], funnel: Funnel) -> str:
    goal, n = node.members("centre P"), len(funnel.x[0][0])
    centre, P = goal["centre"].array(n), goal["P"].array(n, n)
    multiplier = stated["goal_multiplier"].number()
    what = "that the funnel ends in the goal, by the S-lemma,"
    inside(funnel.x[-1][-1], funnel.P[-1], funnel.rho[-1], centre, P, multiplier, what)
    forms = inverse_forms(P, [_unit(i, n) for i in range(n)], "the goal's matrix")
    ends = [(c, text.root_above(q)) for c, q in zip(centre, forms, strict=True)]
    box = (f"x{i} in [{text.below(c - r)}, {text.above(c + r)}]" for i, (c, r) in enumerate(ends))
    return f", ends in the goal, an ellipsoid within {', '.join(box)}"


def _unit(i: int, n: int) -> list[Fraction]:
    return [Fraction(i == j) for j in range(n)]


def _decide_valid(
    field: Field, policy: Policy, funnel: Funnel, bounds: list[Bounds], hold: Hold, work: Work
) -> None:
    """x and the input stay where the equations are valid.

    |g'x̄| <= d wherever W <= ρ if ρ g'P⁻¹g <= d², so if d²P - ρgg' ⪰ 0, which holds between knots if
    it does at them. A held input is within W of clip(ũ), and within the limits.
    Centres and gains between knots are convex combinations of their control points. A limit within
    the bounds keeps its side by itself. Of another side the other limit has to be W away: it is the
    input where ũ is beyond it, and a held one may be from before these bounds began.
    """
    rooms: list[dict[tuple[int, tuple[Fraction, ...]], Fraction]] = [{} for _ in funnel.t]
    for k, entries in enumerate(bounds):
        for j, (low, high) in entries.items():
            i = j - field.n
            middle = [point[j] for point in funnel.x[k]] if i < 0 else [u[i] for u in policy.u[k]]
            rows = [_unit(j, field.n)] if i < 0 else [gain[i] for gain in policy.K[k]]
            off = 0 if i < 0 else hold.widths[k][i]
            room = [min(middle) - low - off, high - max(middle) - off]
            if i in policy.limits:
                least, most = policy.limits[i]
                if (least < low and most < low + off) or (most > high and least > high - off):
                    raise Rejected(f"the limits of u{i} lie where its dynamics are not valid")
                room = room[least >= low : 2 - (most <= high)]
            for row, knot in product(rows, (k, k + 1)):
                if room:
                    key = j, tuple(row)
                    rooms[knot][key] = min(*room, rooms[knot].get(key, room[0]))
    for knot, found in enumerate(rooms):
        work.spend(10 * field.n**2 * (field.n + len(found)))
        forms = inverse_forms(funnel.P[knot], [g for _, g in found], "P")
        for ((j, _), d), form in zip(found.items(), forms, strict=True):
            if d < 0 or funnel.rho[knot] * form > d * d:
                at = text.exact(funnel.t[knot])
                raise Rejected(
                    f"the funnel leaves where its dynamics are valid: at {at} s entry {j} of (x, u)"
                    " is not proved to keep its bounds"
                )


def _kept(field: Field, bounds: list[Bounds]) -> str:
    """Where x and u are proved to stay, at all times."""
    shown = []
    for j in sorted(set.intersection(*map(set, bounds))):
        low, high = min(b[j][0] for b in bounds), max(b[j][1] for b in bounds)
        name = f"x{j}" if j < field.n else f"u{j - field.n}"
        shown.append(f"{name} in [{text.below(low)}, {text.above(high)}]")
    if any(b != bounds[0] for b in bounds):
        shown.append("the bounds of each time span")
    return f", and keeps {', '.join(shown)}" if shown else ""


def _assumptions(field: Field, policy: Policy, bounds: list[Bounds], hold: Hold) -> tuple[str, ...]:
    obeyed = "the state obeys the stored equations and the stored policy is applied "
    if hold.period:
        longest = text.exact(hold.period)
        obeyed += (
            f"every {longest} s or more often: at every time, the input is the policy's of some "
            f"time at most {longest} s before, and not before the solution's start, for the state "
            "then"
        )
    else:
        obeyed += "continuously, with no hold and no delay"
    if any(hold.error):
        errors = ", ".join(f"x{i} by {text.exact(e)}" for i, e in enumerate(hold.error) if e)
        obeyed += f", measured wrong by at most: {errors}"
    for i in range(field.m):
        if i in policy.limits:
            obeyed += f", u{i} clipped to {_range(policy.limits[i])}"
        elif not all(field.n + i in entries for entries in bounds):
            obeyed += f", u{i} without saturation"
    ranges = ", ".join(f"w{j} in {_range(ends)}" for j, ends in enumerate(field.box))
    result = [obeyed] + [f"at every time {ranges}"] * bool(ranges)
    if field.expansion:
        result.append(
            "the equations expand others, and that the ranges of w cover what they leave out is an "
            f"assumption of the vector field, computed by: {json.dumps(field.expansion)}"
        )
    return tuple(result)


def _range(ends: tuple[Fraction, Fraction]) -> str:
    return f"[{text.exact(ends[0])}, {text.exact(ends[1])}]"


Key = tuple[int, int, tuple[int, ...]]  # interval, vertex; mode, or input, sign and mode


def _decide_pieces(
    field: Field, policy: Policy, funnel: Funnel, spans: list[int], stated: dict[str, Node],
    falls: Decay | Fraction, hold: Hold, work: Work,
) -> int:  # fmt: skip
    """Prove c > 0 on every piece, and that the pieces cover every time, vertex and mode."""
    kappa = None
    if "kappa" in stated:
        kappa = stated["kappa"].array(len(spans), len(field.box))
        if any(k <= 0 for row in kappa for k in row):
            raise Rejected("kappa should be positive")
        if len(_pushing(field, field.equations, len(field.box))) < len(field.box):
            raise Rejected("w does more than add constants: kappa does not bound what it does")
    corners = hold.moved + (0 if kappa else len(field.box))
    _refuse_many(len(spans), 2**corners, 3 ** len(policy.limits))
    values = [tuple((a + b) / 2 for a, b in field.box)] if kappa else list(product(*field.box))
    vertices, modes = list(product(hold.corners, values)), _modes(policy)
    equations = [[_moved(e, field, hold.moved) for e in span] for span in field.equations]
    decays = isinstance(falls, Decay)
    names = "tau" if decays else "mu" + " tau" * bool(policy.limits)
    names += " mode" * bool(policy.limits)
    needed = list(product(range(len(spans)), range(len(vertices)), modes))
    order, pieces = in_order(stated["pieces"], names, needed, len(modes[0]), work)
    multiplier = [] if decays else stated["multiplier"].monomials(field.n)
    # Of the last piece: those that share a closed loop follow each other.
    loops: dict[tuple[object, ...], ClosedLoop] = {}

    def decide_piece(ring: Ring, number: int) -> None:
        (k, v, mode), level, index, i = order[number]
        corner, w = vertices[v]
        key = ring.width, k, level, index, mode
        if key not in loops:
            loops.clear()
            loops[key] = ClosedLoop(ring, equations[spans[k]], policy, funnel, key[1:4], mode)
            loops[key].grow(field.box, kappa[k] if kappa else [], falls)
        loop, piece = loops[key], pieces[i]
        c = loop.condition(multiplier, piece, stated, (*hold.push(k, corner), *w))
        squares = read_squares(piece | {"basis": stated["basis"]}, loop.ring)
        positive(c, squares, loop.ring, f"piece {i} (interval {k}, vertex {v}, mode {mode})")

    for number in range(len(order)):
        at_width(field.n, work, partial(decide_piece, number=number))
    return len(order)


def _decide_rates(
    field: Field, policy: Policy, funnel: Funnel, spans: list[int], stated: dict[str, Node],
    hold: Hold, work: Work,
) -> int:  # fmt: skip
    """Prove |dũ_i/dt| < R_i in the funnel, for every input where it is not at a limit.

    What entries of (δ, w) do that only push is taken off R; the others are at vertices.
    """
    equations = [[_moved(e, field, hold.moved) for e in span] for span in field.equations]
    every = hold.moved + len(field.box)
    pushing = _pushing(field, equations, every)
    corners = every - len(pushing)
    _refuse_many(len(spans), 2**corners, 3 ** len(policy.limits), 2 * field.m)
    sides = [(0,) if j in pushing else (-1, 1) for j in range(hold.moved)]
    values = [
        ((a + b) / 2,) if hold.moved + j in pushing else (a, b)
        for j, (a, b) in enumerate(field.box)
    ]
    vertices, limited = list(product(product(*sides), product(*values))), list(policy.limits)
    cases = [
        (i, sign, *mode)
        for i, sign, mode in product(range(field.m), (-1, 1), _modes(policy))
        if i not in limited or not mode[limited.index(i)]
    ]
    needed = list(product(range(len(spans)), range(len(vertices)), cases))
    names = "input sign tau" + " mode" * bool(limited)
    order, pieces = in_order(stated["rate_pieces"], names, needed, len(limited), work)
    halves = [(b - a) / 2 for a, b in field.box]
    loops: dict[tuple[object, ...], ClosedLoop] = {}  # as above

    def decide_piece(ring: Ring, number: int) -> None:
        (k, v, (i, sign, *mode)), level, index, place = order[number]
        (corner, w), what = vertices[v], f"rate piece {place} (interval {k}, vertex {v}, input {i})"
        key = ring.width, k, level, index, tuple(mode)
        if key not in loops:
            loops.clear()
            loops[key] = ClosedLoop(ring, equations[spans[k]], policy, funnel, key[1:4], key[4])
        loop, room, ranges = loops[key], hold.rates[k][i], [*hold.widths[k][: hold.moved], *halves]
        for j in pushing:
            column = [_pushed(equation, j, field) for equation in equations[spans[k]]]
            room -= ranges[j] * max(abs(_product(gain[i], column)) for gain in policy.K[k])
        off = (*hold.push(k, corner), *w)
        c = loop.rate_condition(room, i, sign, pieces[place], stated, off)
        squares = read_squares(pieces[place] | {"basis": stated["basis"]}, loop.ring)
        positive(c, squares, loop.ring, what)

    for number in range(len(order)):
        at_width(field.n, work, partial(decide_piece, number=number))
    return len(order)


def _refuse_many(*counts: int) -> None:
    combinations = prod(counts)
    if combinations > MAX_PIECES:
        raise Rejected(f"{combinations} intervals, vertices and modes; at most {MAX_PIECES}")


def _modes(policy: Policy) -> list[tuple[int, ...]]:
    return list(product((0, -1, 1), repeat=len(policy.limits)))


def _pushing(field: Field, equations: list[list[Terms]], count: int) -> list[int]:
    """Which of the last `count` variables, w or (δ, w), only add constants to ẋ in all spans."""
    first = 1 + field.n + field.m
    rows = [e for span in equations for equation in span for e, _ in equation]
    return [j for j in range(count) if all(sum(row) == 1 for row in rows if row[first + j])]


def _moved(equation: Terms, field: Field, moved: int) -> Terms:
    """The equation with u + δ for u, if inputs are off: δ has its exponents before those of w.

    It has degree at most 1 in each input.
    """
    first, last = 1 + field.n, 1 + field.n + field.m
    if not moved:
        return equation
    return [
        (
            e[:first]
            + tuple(a - b for a, b in zip(e[first:last], off, strict=True))
            + off
            + e[last:],
            c,
        )
        for e, c in equation
        for off in product(*(range(d + 1) for d in e[first:last]))
    ]


def _pushed(equation: Terms, j: int, field: Field) -> Fraction:
    """What a unit of entry j adds to one rate, for an entry that only pushes."""
    return sum((c for e, c in equation if e[1 + field.n + field.m + j]), Fraction(0))


def _product(a: Iterable[Fraction], b: Iterable[Fraction]) -> Fraction:
    return sum((p * q for p, q in zip(a, b, strict=True)), Fraction(0))


def in_order(
    node: Node, names: str, needed: Sequence[Key], limited: int, work: Work
) -> tuple[list[tuple[Key, int, int, int]], list[dict[str, Node]]]:
    """(key, level, index, place) of every piece, and their members, in the order of the file.

    Raises Rejected unless their parts of time cover [0, 1] for everything that is needed.
    """
    covered = {key: Fraction(0) for key in needed}
    names = "interval vertex level index columns squares " + names
    pieces = [piece.members(names) for piece in node.items(1, MAX_PIECES)]
    order = []
    for i, piece in enumerate(pieces):
        level = piece["level"].whole(0, MAX_LEVEL)
        index = piece["index"].whole(0, 2**level - 1)
        mode = tuple(piece["mode"].wholes(limited)) if limited else ()
        if "input" in piece:
            mode = piece["input"].whole(0), piece["sign"].whole(-1, 1), *mode
        key = piece["interval"].whole(0), piece["vertex"].whole(0), mode
        if key not in covered:
            k, v, mode = key
            raise Rejected(f"piece {i} is about interval {k}, vertex {v}, mode {mode}: none")
        order.append((key, Fraction(index, 2**level), level, index, i))
    for key, start, level, *_ in sorted(order):
        if start <= covered[key]:
            covered[key] = max(covered[key], start + Fraction(1, 2**level))
    for (k, v, mode), until in covered.items():
        if until < 1:
            raise Rejected(f"a piece of interval {k} is missing (vertex {v}, mode {mode})")
    work.spend(PIECE * len(pieces))
    return [(key, level, index, i) for key, _, level, index, i in order], pieces
