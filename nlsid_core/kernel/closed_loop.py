"""A closed loop around its nominal, and what holding and mismeasuring an input changes in it.

`Motion` is what is read of a policy, a funnel and a vector field: between knots the nominal's
states and inputs and the gains are Bézier curves, P and ρ are linear. On a part of an interval the
loop is polynomials in x̄, and in s on it, with numbers in the place of w and of δ, what the input is
off: u = clip(ũ) + δ, |δ_i| <= W_i. Pieces of rates show |dũ_i/dt| < R_i in the funnel.
Why that is enough: "The hold between samples" in docs/theory-funnels.md.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cached_property, lru_cache, partial
from itertools import pairwise, product
from types import SimpleNamespace
from typing import Any

from .exact import definite, dot, unit
from .files import Node, Reader, Table, Terms, limit, refuse_if, whole
from .polynomials import Polynomial, Ring, at_width
from .positivity import positive, powers_of_two, read_squares

MAX_STATES, MAX_INPUTS, MAX_UNCERTAIN, MAX_LIMITED = 16, 16, 32, 3
MAX_DEGREE, MAX_TIME_DEGREE = 7, 3
MAX_BOUNDS, MAX_KNOTS, MAX_SPANS = 10_000, 10_000, 1000
MAX_LEVEL, MAX_PIECES = 16, 100_000

Bounds = dict[int, tuple[Fraction, Fraction]]
# A mode, -1 low, 0 free, 1 high, of each input with limits; of a rate after its input and sign.
Case = tuple[int, ...]
Corner = tuple[int, ...]  # -1 or 1 for each input that is off; 0 where it is not
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
    table: Table = {"t": (None,), "x": None, "u": None, "K": None, "limits": (None, 3)}
    policy = documents["policy"].document("policy", table, "continuous", made_for)
    made_for["policy"], node = digests["policy"], documents["funnel"]
    table = {"t": _times(2, MAX_KNOTS), "x": None, "P": None, "rho": (None,)}
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
        "pieces": None,
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
    others = dict.fromkeys(f"columns squares {names}".split())
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


class ClosedLoop:
    """What pieces of one part of time and one mode share.

    gap: ρ - W, W = x̄'Px̄. held: what is nonnegative in the mode. moved: dx₀/ds.
    """

    def __init__(self, motion: Motion, ring: Ring, part: Part, mode: Case) -> None:
        (k, level, index), x = part, ring.variables
        self.motion, self.ring, self.k, self.level = motion, ring, k, level
        self.h = motion.t[k + 1] - motion.t[k]
        self.in_time = partial(ring.bernstein, level=level, index=index)
        self.rho = self.in_time(motion.rho[k : k + 2])
        rows = zip(motion.P[k], motion.P[k + 1], strict=True)
        self.Px = [ring.dot(self._curve(pair), x) for pair in rows]
        self.gap = self.rho - ring.dot(x, self.Px)
        nominal = self._curve(motion.x[k])
        self.moved = list(map(self.slope, nominal))
        states = [p + e for p, e in zip(nominal, x, strict=True)]
        self.known = [self.in_time(motion.t[k : k + 2]), *states]

        planned = enumerate(self._curve(motion.u[k]))  # ũ = u₀ - Kx̄
        self.inputs = [u - ring.dot(self._curve(self._gains(i)), x) for i, u in planned]
        self.held = []
        for side, (i, (low, high)) in zip(mode, motion.limits.items(), strict=True):
            wanted = self.inputs[i]
            if side:
                self.held.append(low - wanted if side < 0 else wanted - high)
                self.inputs[i] = ring.made(low if side < 0 else high)
            else:
                self.held.append((high - wanted) * (wanted - low))

    @cached_property
    def drift(self) -> Polynomial:
        """dρ/ds + 2x̄'P dx₀/ds - x̄'(dP/ds)x̄: what neither f nor a multiplier is in."""
        return 2 * self.ring.dot(self.moved, self.Px) + self.slope(self.gap)

    def rates(self, corner: Corner, w: Sequence[Fraction]) -> list[Polynomial]:
        """f(t, x₀ + x̄, clip(ũ) + δ, w) at a corner of the box of δ."""
        pairs = zip(self.inputs, corner, self.motion.widths[self.k], strict=True)
        inputs = [u + side * most if side else u for u, side, most in pairs]
        values = [*self.known, *inputs, *map(self.ring.made, w)]
        return self.ring.substituted(self.motion.equations[self.k], values)

    def turning(self, i: int, f: Sequence[Polynomial]) -> Polynomial:
        """dũ_i/ds = du₀/ds - (dK/ds)x̄ - K(h f - dx₀/ds), where ẋ = f and u_i is at no limit."""
        moved = [m - self.h * rate for m, rate in zip(self.moved, f, strict=True)]
        return self.slope(self.inputs[i]) + self.ring.dot(self._curve(self._gains(i)), moved)

    def taken(self, taus: Node, held: list[Polynomial], sides: Node) -> list[Polynomial]:
        """-τ q for everything that is nonnegative here, τ sums of squares in `sides`."""
        pairs = zip(taus.items(len(held), len(held)), held, strict=True)
        read = ((node.members("columns squares") | {"basis": sides}, q) for node, q in pairs)
        return [-1 * (read_squares(tau, self.ring).form * q) for tau, q in read]

    def slope(self, p: Polynomial) -> Polynomial:
        """The derivative along the interval, of which this part is 2^-level."""
        return (1 << self.level) * self.ring.derivative(p)

    def _gains(self, i: int) -> list[list[Fraction]]:
        """Control points of row i of K."""
        return [gain[i] for gain in self.motion.K[self.k]]

    def _curve(self, points: Sequence[Sequence[Fraction]]) -> list[Polynomial]:
        """The curve with these control points."""
        return [self.in_time(entries) for entries in zip(*points, strict=True)]


def read_multiplier(node: Node, rows: list[bytes], ring: Ring) -> Polynomial:
    """μ, of any sign: `shifts`, `start` and `end` of each monomial's coefficient, linear in s."""
    size, stated = len(rows), node.members("shifts start end")
    shifts = powers_of_two(stated["shifts"], size)
    least, monomials, ends = min(shifts, default=0), list(map(ring.monomial, rows)), []
    for name in ("start", "end"):
        stated_ones = zip(stated[name].wholes(size), shifts, strict=True)
        ends.append(ring.dot([value << s - least for value, s in stated_ones], monomials))
    return Fraction(2) ** least * ring.dot([ring.bernstein(unit(j, 2)) for j in (0, 1)], ends)


def read_hold(claim: Node, stated: dict[str, Any], motion: Motion) -> None:
    """The hold and the measurement error that a claim is about, and what u is off by then.

    period: how old the applied input is at most, in s; error: bounds by state; both may be 0. By
    interval and input, rates: the bounds R of |dũ/dt| in 1/s; widths: W. corners: of the box of δ.
    At a time in interval k the input is of a time in it or in one that ends less than a period
    before it starts: W is period times the largest rate there, and what e does to the largest Ke.
    """
    count, n, m, held = len(motion.x), motion.n, motion.m, "hold" in claim.value
    motion.period, motion.error = Fraction(0), [Fraction(0)] * n
    motion.rates = [[Fraction(0)] * m for _ in range(count)]
    if held:
        motion.period = Node(claim.value["hold"], "hold").number()
        motion.rates = stated["rates"].array(count, m)
        steady = all(p[-1] == q[0] for curve in (motion.u, motion.K) for p, q in pairwise(curve))
        fits = motion.period > 0 and all(rate > 0 for row in motion.rates for rate in row)
        claim.require({"hold and rates should be positive": fits}, "not_below")
        claim.require({"the policy jumps at a knot: no rate bounds a hold": steady}, "not_valid")
    if "error" in claim.value:
        motion.error = Node(claim.value["error"], "error").array(n)
        claim.require({"error should be 0 or more": min(motion.error) >= 0}, "not_below")
    affine = motion.affine or not (held or "error" in claim.value)
    claim.require({"f is not affine in each input that is off": affine}, "not_valid")

    shaken = [
        [max(dot(list(map(abs, gain[i])), motion.error) for gain in points) for i in range(m)]
        for points in motion.K
    ]
    motion.widths, begun = [], 0
    for k in range(count):
        while motion.t[begun + 1] <= motion.t[k] - motion.period:
            begun += 1
        turned, moved = (
            [max(column) for column in zip(*rows[begun : k + 1], strict=True)]
            for rows in (motion.rates, shaken)
        )
        pairs = zip(turned, moved, strict=True)
        motion.widths.append([motion.period * rate + e for rate, e in pairs])
    off = motion.period or any(motion.error)
    motion.corners = list(product((-1, 1), repeat=m)) if off else [(0,) * m]


def decide_pieces(
    motion: Motion,
    stated: dict[str, Any],
    name: str,
    vertices: Sequence[tuple[Corner, Sequence[Fraction]]],
    cases: Sequence[Case],
    parts: Callable[[dict[str, Any], Case, ClosedLoop, list[Polynomial]], list[Polynomial]],
) -> int:
    """Prove the sum of its parts positive on every piece of a list; how many pieces it has.

    parts: of a piece's members, its case, its closed loop, and f at its vertex (δ, w).
    """
    limited, loops = len(motion.limits), lru_cache(maxsize=1)(partial(ClosedLoop, motion))
    needed = list(product(range(len(motion.x)), range(len(vertices)), cases))
    members = "mu" + " tau" * bool(limited) if name == "pieces" else "input sign tau"
    pieces = in_order(stated[name], members, needed, limited)

    def decide(ring: Ring, piece: Piece) -> None:
        (_, v, case), part, given, what = piece
        loop, (corner, w) = loops(ring, part, case[len(case) - limited :]), vertices[v]
        f = loop.rates(corner, w)
        squares = read_squares(given | {"basis": stated["basis"]}, ring)
        positive(ring.sum(parts(given, case, loop, f)), squares, ring, what)

    at_width(motion.n, pieces, decide)
    return len(pieces)


def decide_rates(motion: Motion, stated: dict[str, Any]) -> int:
    """Prove |dũ_i/dt| < R_i in the funnel, for every input where it is not at a limit.

    What entries of (δ, w) do that only push is taken off R; the others are at vertices.
    """
    n, m, limited, box = motion.n, motion.m, list(motion.limits), motion.box
    free = [j for j in range(m + len(box)) if 1 + n + j in motion.pushing]
    halves = [(high - low) / 2 for low, high in box]
    sides = [(0,) if j in free else (-1, 1) for j in range(m)]
    values = [
        ((low + high) / 2,) if m + j in free else (low, high) for j, (low, high) in enumerate(box)
    ]
    cases_of = 2 ** (m + len(box) - len(free)) * len(motion.modes) * 2 * m
    limit(len(motion.x) * cases_of, MAX_PIECES, "intervals, vertices and modes")
    cases = [
        (i, sign, *mode)
        for i, sign, mode in product(range(m), (-1, 1), motion.modes)
        if i not in limited or not mode[limited.index(i)]
    ]

    def parts(
        piece: dict[str, Any], case: Case, loop: ClosedLoop, f: list[Polynomial]
    ) -> list[Polynomial]:
        i, sign, *_ = case
        room = motion.rates[loop.k][i]
        for j in free:
            half = motion.widths[loop.k][j] if j < m else halves[j - m]
            column = [pushed(equation, 1 + n + j) for equation in motion.equations[loop.k]]
            room -= half * max(abs(dot(gain[i], column)) for gain in motion.K[loop.k])
        taken = loop.taken(piece["tau"], [loop.gap, *loop.held], stated["sides"])
        return [loop.ring.made(loop.h * room), -sign * loop.turning(i, f), *taken]

    vertices = list(product(product(*sides), product(*values)))
    return decide_pieces(motion, stated, "rate_pieces", vertices, cases, parts)
