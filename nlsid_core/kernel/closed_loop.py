"""A closed loop around its nominal, and what holding and mismeasuring an input changes in it.

On a part of an interval it is polynomials in x̄, and in s on it, with numbers in the place of w and
of δ, what the input is off: u = clip(ũ) + δ, |δ_i| <= W_i. A held input is the policy's of some
time at most a period ago. Pieces of rates show that |dũ_i/dt| < R_i in the funnel, so it is off by
the period times R at most, and an error e of the state by |Ke| more. Why that is enough: "The hold
between samples" in docs/theory-funnels.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache, partial
from itertools import pairwise, product
from math import prod
from typing import Any

from .exact import Matrix, dot
from .files import Node, Terms, limit
from .polynomials import Polynomial, Ring, at_width
from .positivity import expanded, positive, powers_of_two, read_squares
from .trajectory import MAX_PIECES, Field, Funnel, Mode, Part, Piece, in_order, pushed

Corner = tuple[int, ...]  # -1 or 1 for each input that is off; 0 where it is not


class ClosedLoop:
    """What pieces of one part of time and one mode share.

    gap: ρ - W, W = x̄'Px̄. held: what is nonnegative in the mode. moved: dx₀/ds.
    """

    def __init__(self, funnel: Funnel, ring: Ring, part: Part, mode: Mode) -> None:
        (k, level, index), x = part, ring.variables
        self.funnel, self.ring, self.k = funnel, ring, k
        self.h = funnel.t[k + 1] - funnel.t[k]
        self.in_time = partial(ring.bernstein, level=level, index=index)
        self.rho = self.in_time(funnel.rho[k : k + 2])
        rows = zip(funnel.P[k], funnel.P[k + 1], strict=True)
        self.Px = [ring.dot(self._curve(pair), x) for pair in rows]
        self.gap = self.rho - ring.dot(x, self.Px)
        self.moved = self._curve(slopes(funnel.x[k]))
        states = [p + e for p, e in zip(self._curve(funnel.x[k]), x, strict=True)]
        self.known = [self.in_time(funnel.t[k : k + 2]), *states]
        self._put: dict[Corner, Callable[[Terms], Polynomial]] = {}

        planned = enumerate(self._curve(funnel.u[k]))  # ũ = u₀ - Kx̄
        self.inputs = [u - ring.dot(self._curve(self._gains(i)), x) for i, u in planned]
        self.held = []
        for side, (i, (low, high)) in zip(mode, funnel.limits.items(), strict=True):
            wanted = self.inputs[i]
            if side:
                self.held.append(low - wanted if side < 0 else wanted - high)
                self.inputs[i] = ring.made(low if side < 0 else high)
            else:
                self.held.append((high - wanted) * (wanted - low))

    @cached_property
    def drift(self) -> Polynomial:
        """dρ/ds + 2x̄'P dx₀/ds - x̄'(dP/ds)x̄: what neither f nor a multiplier is in."""
        funnel, ring, k = self.funnel, self.ring, self.k
        bend = [slopes(rows)[0] for rows in zip(funnel.P[k], funnel.P[k + 1], strict=True)]
        rise = funnel.rho[k + 1] - funnel.rho[k]
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
        (planned,) = self._curve(slopes([[u[i]] for u in self.funnel.u[self.k]]))
        turned = ring.dot(self._curve(slopes(gains)), ring.variables)
        moved = [m - self.h * rate for m, rate in zip(self.moved, f, strict=True)]
        return planned - turned + ring.dot(self._curve(gains), moved)

    def taken(self, taus: Node, held: list[Polynomial], sides: Node) -> list[Polynomial]:
        """-τ q for everything that is nonnegative here, τ sums of squares in `sides`."""
        found = []
        for node, q in zip(taus.items(len(held), len(held)), held, strict=True):
            tau = read_squares(node.members("columns squares") | {"basis": sides}, self.ring)
            found.append(-1 * (expanded(tau, self.ring) * q))
        return found

    def _gains(self, i: int) -> list[list[Fraction]]:
        """Control points of row i of K."""
        return [gain[i] for gain in self.funnel.K[self.k]]

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


@dataclass(frozen=True)
class Hold:
    """By interval and input: the bounds R of |dũ/dt| in 1/s, and W of what u is off.

    period: how old the applied input is at most, in s. error: bounds by state. Both may be 0.
    """

    period: Fraction
    error: list[Fraction]
    rates: Matrix
    widths: Matrix

    @property
    def corners(self) -> list[Corner]:
        """The corners of the box of δ; one where the input is not off."""
        inputs = len(self.widths[0])
        off = self.period or any(self.error)
        return list(product((-1, 1), repeat=inputs)) if off else [(0,) * inputs]


def read_hold(claim: Node, stated: dict[str, Any], field: Field, funnel: Funnel) -> Hold:
    """The hold and the measurement error that a claim is about, and what u is off by then.

    At a time in interval k the input is of a time in it or in one that ends less than a period
    before it starts: W is period times the largest rate there, and what e does to the largest Ke.
    """
    count, held = len(funnel.x), "hold" in claim.value
    period, error = Fraction(0), [Fraction(0)] * field.n
    rates: Matrix = [[Fraction(0)] * field.m for _ in range(count)]
    if held:
        period = Node(claim.value["hold"], "hold").number()
        rates = stated["rates"].array(count, field.m)
        curves: list[Any] = [funnel.u, funnel.K]
        steady = all(p[-1] == q[0] for curve in curves for p, q in pairwise(curve))
        fits = period > 0 and all(rate > 0 for row in rates for rate in row)
        claim.require({"hold and rates should be positive": fits}, "not_below")
        claim.require({"the policy jumps at a knot: no rate bounds a hold": steady}, "not_valid")
    if "error" in claim.value:
        error = Node(claim.value["error"], "error").array(field.n)
        claim.require({"error should be 0 or more": min(error) >= 0}, "not_below")
    if held or "error" in claim.value:
        claim.require({"f is not affine in each input that is off": field.affine}, "not_valid")

    shaken = [
        [max(dot(list(map(abs, gain[i])), error) for gain in points) for i in range(field.m)]
        for points in funnel.K
    ]
    widths, begun = [], 0
    for k in range(count):
        while funnel.t[begun + 1] <= funnel.t[k] - period:
            begun += 1
        turned, moved = (
            [max(column) for column in zip(*rows[begun : k + 1], strict=True)]
            for rows in (rates, shaken)
        )
        widths.append([period * rate + e for rate, e in zip(turned, moved, strict=True)])
    return Hold(period, error, rates, widths)


def decide_rates(field: Field, funnel: Funnel, hold: Hold, stated: dict[str, Any]) -> int:
    """Prove |dũ_i/dt| < R_i in the funnel, for every input where it is not at a limit.

    What entries of (δ, w) do that only push is taken off R; the others are at vertices.
    """
    m, count, limited = field.m, len(funnel.x), list(funnel.limits)
    free = [j for j in range(m + len(field.box)) if 1 + field.n + j in field.pushing]
    halves = [(high - low) / 2 for low, high in field.box]
    sides = [(0,) if j in free else (-1, 1) for j in range(m)]
    values = [
        ((low + high) / 2,) if m + j in free else (low, high)
        for j, (low, high) in enumerate(field.box)
    ]
    cases_of = 2 ** (m + len(field.box) - len(free)) * len(funnel.modes) * 2 * m
    limit(count * cases_of, MAX_PIECES, "intervals, vertices and modes")
    vertices = list(product(product(*sides), product(*values)))
    cases = [
        (i, sign, *mode)
        for i, sign, mode in product(range(m), (-1, 1), funnel.modes)
        if i not in limited or not mode[limited.index(i)]
    ]
    needed = list(product(range(count), range(len(vertices)), cases))
    pieces = in_order(stated["rate_pieces"], "input sign tau", needed, len(limited))
    loops = lru_cache(maxsize=1)(partial(ClosedLoop, funnel))

    def decide(ring: Ring, piece: Piece) -> None:
        (k, v, (i, sign, *mode)), part, members = piece
        loop, (corner, w) = loops(ring, part, tuple(mode)), vertices[v]
        room = hold.rates[k][i]
        for j in free:
            half = hold.widths[k][j] if j < m else halves[j - m]
            column = [pushed(equation, 1 + field.n + j) for equation in field.equations[k]]
            room -= half * max(abs(dot(gain[i], column)) for gain in funnel.K[k])
        f = loop.rates(at(field.equations[k], w), corner, hold.widths[k])
        parts = [ring.made(loop.h * room), -sign * loop.turning(i, f)]
        parts += loop.taken(members["tau"], [loop.gap, *loop.held], stated["sides"])
        squares = read_squares(members | {"basis": stated["basis"]}, ring)
        what = f"{members['index'].where}, of a rate (interval {k}, vertex {v}, input {i})"
        positive(ring.sum(parts), squares, ring, what)

    at_width(field.n, pieces, decide)
    return len(pieces)
