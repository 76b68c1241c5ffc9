"""A closed loop around its nominal, on a part of an interval: polynomials in x̄, and in s on it.

What is decided of them: `continuous_funnel`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import pairwise
from math import prod

from .files import Node, Terms
from .polynomials import Polynomial, Ring
from .positivity import expanded, powers_of_two, read_squares
from .trajectory import Funnel, Policy

Change = dict[tuple[int, ...], Polynomial]  # by monomials in (δ, w); () is 1


@dataclass(frozen=True)
class Decay:
    """dV/dt <= rate (floor - V) wherever floor <= V <= 1; rate in 1/s."""

    rate: Fraction
    floor: Fraction


class FunnelPart:
    """A funnel on part `index` of 2^level of interval k: ρ, Px̄, gap = ρ - W, states x₀ + x̄."""

    def __init__(self, ring: Ring, funnel: Funnel, place: tuple[int, int, int]) -> None:
        (k, level, index), x = place, ring.variables
        self.in_time = in_time = partial(ring.bernstein, level=level, index=index)
        self.rho = in_time(funnel.rho[k : k + 2])
        ends = zip(funnel.P[k], funnel.P[k + 1], strict=True)
        self.Px = [
            ring.dot([in_time(pair) for pair in zip(*rows, strict=True)], x) for rows in ends
        ]
        self.gap = self.rho - ring.dot(x, self.Px)
        centres = zip(*funnel.x[k], strict=True)
        self.states = [in_time(points) + e for points, e in zip(centres, x, strict=True)]


class ClosedLoop:
    """What pieces of one part of time and one mode share: polynomials in x̄, and in s on it.

    equations: with δ. held: what is nonnegative in the mode. gap: ρ - W. field: f by monomials in
    (δ, w), of clip(ũ).
    """

    def __init__(
        self, ring: Ring, equations: list[Terms], policy: Policy, funnel: Funnel,
        place: tuple[int, int, int], mode: tuple[int, ...],
    ) -> None:  # fmt: skip
        self.k, self.ring, x = place[0], ring, ring.variables
        self.funnel, self.policy = funnel, policy
        k, self.h = self.k, funnel.t[self.k + 1] - funnel.t[self.k]
        part = FunnelPart(ring, funnel, place)
        self.in_time, self.rho, self.Px, self.gap = part.in_time, part.rho, part.Px, part.gap
        inputs, self.held = [], []
        for i, points in enumerate(zip(*policy.u[k], strict=True)):  # ũ = u₀ - Kx̄
            inputs.append(self.in_time(points) - ring.dot(self._gains(i), x))
        for side, (i, (low, high)) in zip(mode, policy.limits.items(), strict=True):
            wanted = inputs[i]
            if side:
                self.held.append(low - wanted if side < 0 else wanted - high)
                inputs[i] = ring.made(low if side < 0 else high)
            else:
                self.held.append((high - wanted) * (wanted - low))
        known = [self.in_time(funnel.t[k : k + 2]), *part.states, *inputs]
        self.field = apart(ring, equations, known)
        self.changes: dict[int, Change] = {}

    def _gains(self, i: int) -> list[Polynomial]:
        """Row i of K."""
        rows = zip(*(K[i] for K in self.policy.K[self.k]), strict=True)
        return [self.in_time(points) for points in rows]

    def _motion(self) -> list[Polynomial]:
        """dx₀/ds."""
        return [self.in_time(_slope(p)) for p in zip(*self.funnel.x[self.k], strict=True)]

    def _along(self, direction: list[Polynomial], scale: Fraction) -> Change:
        """scale direction'f."""
        return {off: scale * self.ring.dot(rates, direction) for off, rates in self.field.items()}

    def grow(
        self,
        box: list[tuple[Fraction, Fraction]],
        kappa: Sequence[Fraction],
        falls: Decay | Fraction,
    ) -> None:
        """`rest` and, by monomials in (δ, w), `growth`: all of c(s, x̄) but its multipliers.

        falls: the decay, or the margin on the boundary. `shell`: what is nonnegative for a decay.
        """
        ring, k, h, x = self.ring, self.k, self.h, self.ring.variables
        bend = [
            [b - a for a, b in zip(*rows, strict=True)]
            for rows in zip(self.funnel.P[k], self.funnel.P[k + 1], strict=True)
        ]
        # 2x̄'P dx₀/ds - x̄'(dP/ds)x̄: what of -dW/ds does not come from f
        rest = 2 * ring.dot(self._motion(), self.Px) - ring.form(bend, x)
        self.growth = self._along(self.Px, 2 * h)
        moved = len(next(iter(self.field), ())) - len(box)
        for j, (bound, (low, high)) in enumerate(zip(kappa, box, strict=False)):
            unit = tuple(int(i == j) for i in range(-moved, len(box)))
            along = self.growth.get(unit, ring.made(0))  # 2h x̄'Pg
            half = (high - low) / 2
            rest -= half * bound / (4 * h) * (along * along) + half * h / bound
        rise, rho, W = self.funnel.rho[k + 1] - self.funnel.rho[k], self.rho, self.rho - self.gap
        if isinstance(falls, Decay):
            floor = falls.floor * rho
            self.rest = rho * rest + rise * W + falls.rate * h * (rho * (floor - W))
            self.growth = {used: rho * part for used, part in self.growth.items()}
            self.shell = [self.gap, W - floor]
        else:
            self.rest, self.shell = rise - falls * h * rho + rest, []

    def condition(
        self, multiplier: list[tuple[int, ...]], piece: dict[str, Node], stated: dict[str, Node],
        off: Sequence[Fraction],
    ) -> Polynomial:  # fmt: skip
        """c(s, x̄) of a piece at a vertex of (δ, w)."""
        parts: list[tuple[Fraction | int, Polynomial]] = [(1, self.rest)]
        if "mu" in piece:
            parts.append((1, read_multiplier(piece["mu"], multiplier, self.ring) * self.gap))
        parts += [(-weight, growth) for weight, growth in at_vertex(off, self.growth)]
        if "tau" in piece:
            parts += self._taken(piece["tau"], self.shell + self.held, stated)
        return self.ring.weighted(parts)

    def rate_condition(
        self, room: Fraction, i: int, sign: int, piece: dict[str, Node], stated: dict[str, Node],
        off: Sequence[Fraction],
    ) -> Polynomial:  # fmt: skip
        """h room - sign dũ_i/ds - τ_0 (ρ - W) - Σ_l τ_l q_l, of ũ = u₀ - Kx̄, at a vertex."""
        if i not in self.changes:
            self.changes[i] = self._change(i)
        parts: list[tuple[Fraction | int, Polynomial]] = [(1, self.ring.made(self.h * room))]
        parts += [(-sign * weight, change) for weight, change in at_vertex(off, self.changes[i])]
        parts += self._taken(piece["tau"], [self.gap, *self.held], stated)
        return self.ring.weighted(parts)

    def _change(self, i: int) -> Change:
        """dũ_i/ds."""
        ring, k, gains = self.ring, self.k, self._gains(i)
        rows = zip(*(K[i] for K in self.policy.K[k]), strict=True)
        turning = [self.in_time(_slope(points)) for points in rows]
        own = self.in_time(_slope([u[i] for u in self.policy.u[k]]))
        own += ring.dot(gains, self._motion()) - ring.dot(turning, ring.variables)
        return {(): own} | self._along(gains, -self.h)

    def _taken(
        self, taus: Node, held: list[Polynomial], stated: dict[str, Node]
    ) -> list[tuple[Fraction | int, Polynomial]]:
        """-τ q for everything that is nonnegative here."""
        parts: list[tuple[Fraction | int, Polynomial]] = []
        for node, q in zip(taus.items(len(held), len(held)), held, strict=True):
            tau = node.members("columns squares") | {"basis": stated["sides"]}
            parts.append((-1, expanded(read_squares(tau, self.ring), self.ring) * q))
        return parts


def read_multiplier(node: Node, rows: list[tuple[int, ...]], ring: Ring) -> Polynomial:
    """μ, of any sign: `shifts`, `start` and `end` of each monomial's coefficient, linear in s."""
    size, stated = len(rows), node.members("shifts start end")
    shifts = powers_of_two(stated["shifts"], size)
    ends = zip(stated["start"].wholes(size), stated["end"].wholes(size), strict=True)
    lines = [
        ring.bernstein(pair) * ring.monomial(row) for pair, row in zip(ends, rows, strict=True)
    ]
    return ring.dot([Fraction(2) ** shift for shift in shifts], lines)


def _slope(points: Sequence[Fraction]) -> list[Fraction]:
    """Control points of the derivative in s."""
    return [(len(points) - 1) * (b - a) for a, b in pairwise(points)] or [Fraction(0)]


def at_vertex(off: Sequence[Fraction], parts: Change) -> list[tuple[Fraction, Polynomial]]:
    """What multiplies each polynomial at a vertex of (δ, w)."""
    return [
        (prod((value for value, e in zip(off, used, strict=False) if e), start=Fraction(1)), part)
        for used, part in parts.items()
    ]


def apart(
    ring: Ring, equations: list[Terms], forms: list[Polynomial]
) -> dict[tuple[int, ...], list[Polynomial]]:
    """`equations` by their monomials in what comes after the variables that are `forms`."""
    rates: dict[tuple[int, ...], list[Terms]] = {}
    n, known = len(equations), len(forms)
    for i, equation in enumerate(equations):
        for e, c in equation:
            rates.setdefault(e[known:], [[] for _ in range(n)])[i].append((e[:known], c))
    found = ring.substituted([p for parts in rates.values() for p in parts], forms)
    return {used: found[n * i : n * i + n] for i, used in enumerate(rates)}
