"""A closed loop around its nominal, and what holding and mismeasuring an input changes in it.

On a part of an interval it is polynomials in x̄, and in s on it, with numbers in the place of w and
of δ, what the input is off: u = clip(ũ) + δ, |δ_i| <= W_i. Pieces of rates show |dũ_i/dt| < R_i in
the funnel. Why that is enough: "The hold between samples" in docs/theory-funnels.md.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cached_property, lru_cache, partial
from itertools import pairwise, product
from math import prod
from typing import Any

from .exact import dot
from .files import Node, Terms, limit
from .polynomials import Polynomial, Ring, at_width
from .positivity import expanded, positive, powers_of_two, read_squares
from .trajectory import MAX_PIECES, Case, Motion, Part, Piece, in_order, pushed

Corner = tuple[int, ...]  # -1 or 1 for each input that is off; 0 where it is not


class ClosedLoop:
    """What pieces of one part of time and one mode share.

    gap: ρ - W, W = x̄'Px̄. held: what is nonnegative in the mode. moved: dx₀/ds.
    """

    def __init__(self, motion: Motion, ring: Ring, part: Part, mode: Case) -> None:
        (k, level, index), x = part, ring.variables
        self.motion, self.ring, self.k = motion, ring, k
        self.h = motion.t[k + 1] - motion.t[k]
        self.in_time = partial(ring.bernstein, level=level, index=index)
        self.rho = self.in_time(motion.rho[k : k + 2])
        rows = zip(motion.P[k], motion.P[k + 1], strict=True)
        self.Px = [ring.dot(self._curve(pair), x) for pair in rows]
        self.gap = self.rho - ring.dot(x, self.Px)
        self.moved = self._curve(slopes(motion.x[k]))
        states = [p + e for p, e in zip(self._curve(motion.x[k]), x, strict=True)]
        self.known = [self.in_time(motion.t[k : k + 2]), *states]
        self._put: dict[Corner, Callable[[Terms], Polynomial]] = {}

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
        motion, ring, k = self.motion, self.ring, self.k
        bend = [slopes(rows)[0] for rows in zip(motion.P[k], motion.P[k + 1], strict=True)]
        rise: Fraction = motion.rho[k + 1] - motion.rho[k]
        return 2 * ring.dot(self.moved, self.Px) + rise - ring.form(bend, ring.variables)

    def rates(
        self, equations: list[Terms], corner: Corner, off: Sequence[Fraction]
    ) -> list[Polynomial]:
        """f(t, x₀ + x̄, clip(ũ) + δ) at a corner of the box |δ| <= off, one for a loop."""
        if corner not in self._put:
            pairs = zip(self.inputs, corner, off, strict=True)
            inputs = [u + side * most if side else u for u, side, most in pairs]
            self._put[corner] = self.ring.substitution([*self.known, *inputs])
        return list(map(self._put[corner], equations))

    def turning(self, i: int, f: Sequence[Polynomial]) -> Polynomial:
        """dũ_i/ds = du₀/ds - (dK/ds)x̄ - K(h f - dx₀/ds), where ẋ = f."""
        ring, gains = self.ring, self._gains(i)
        (planned,) = self._curve(slopes([[u[i]] for u in self.motion.u[self.k]]))
        turned = ring.dot(self._curve(slopes(gains)), ring.variables)
        moved = [m - self.h * rate for m, rate in zip(self.moved, f, strict=True)]
        return planned - turned + ring.dot(self._curve(gains), moved)

    def taken(self, taus: Node, held: list[Polynomial], sides: Node) -> list[Polynomial]:
        """-τ q for everything that is nonnegative here, τ sums of squares in `sides`."""
        pairs = zip(taus.items(len(held), len(held)), held, strict=True)
        read = ((node.members("columns squares") | {"basis": sides}, q) for node, q in pairs)
        return [-1 * (expanded(tau, self.ring) * q) for tau, q in read]

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
    ends = zip(stated["start"].wholes(size), stated["end"].wholes(size), strict=True)
    lines = [
        ring.bernstein(pair) * ring.monomial(row) for pair, row in zip(ends, rows, strict=True)
    ]
    return ring.dot([Fraction(2) ** shift for shift in shifts], lines)


def at(equations: list[Terms], values: Sequence[Fraction]) -> list[Terms]:
    """The equations with numbers in the place of their last variables."""
    found = []
    for equation in equations:
        terms: dict[bytes, Fraction] = {}
        for e, c in equation:
            first = len(e) - len(values)
            weight = prod((v for v, power in zip(values, e[first:], strict=True) if power), start=c)
            terms[e[:first]] = terms.get(e[:first], Fraction(0)) + weight
        found.append([(e, c) for e, c in terms.items() if c])
    return found


def slopes(points: Sequence[Sequence[Fraction]]) -> list[list[Fraction]]:
    """Control points of a curve's derivative in s."""
    degree = len(points) - 1
    found = [
        [degree * (b - a) for a, b in zip(before, after, strict=True)]
        for before, after in pairwise(points)
    ]
    return found or [[Fraction(0)] * len(points[0])]


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
        (k, v, case), part, given, what = piece
        loop, (corner, w) = loops(ring, part, case[len(case) - limited :]), vertices[v]
        f = loop.rates(at(motion.equations[k], w), corner, motion.widths[k])
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
