"""A closed loop around its nominal, on a part of an interval: polynomials in x̄, and in s on it.

Numbers are put in for what is off the policy's input, δ, and for w. What is decided of these
polynomials: `continuous_funnel` and `held`.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from itertools import pairwise
from math import prod

from .files import Node, Terms
from .polynomials import Polynomial, Ring
from .positivity import expanded, powers_of_two, read_squares
from .trajectory import Funnel, Policy

Part = tuple[int, int, int]  # interval k, level, index: [index, index + 1] / 2^level of it
Corner = tuple[int, ...]  # -1 or 1 for each input that is off; 0 where it is not
Mode = tuple[int, ...]  # -1 low, 0 free, 1 high, of each input with limits
Push = tuple[Fraction, Fraction, list[Fraction]]  # r, κ and g of an entry of w that adds g to ẋ


class ClosedLoop:
    """What pieces of one part of time and one mode share.

    gap: ρ - W, W = x̄'Px̄. held: what is nonnegative in the mode. off: the largest |δ| by input.
    """

    def __init__(
        self,
        ring: Ring,
        policy: Policy,
        funnel: Funnel,
        part: Part,
        mode: Mode,
        off: Sequence[Fraction],
    ) -> None:
        (k, level, index), x = part, ring.variables
        self.ring, self.policy, self.funnel, self.part, self.mode = ring, policy, funnel, part, mode
        self.k, self.h, self.off = k, funnel.t[k + 1] - funnel.t[k], off
        self.in_time = in_time = partial(ring.bernstein, level=level, index=index)

        self.rho = in_time(funnel.rho[k : k + 2])
        ends = zip(funnel.P[k], funnel.P[k + 1], strict=True)
        self.Px = [
            ring.dot([in_time(pair) for pair in zip(*rows, strict=True)], x) for rows in ends
        ]
        self.gap = self.rho - ring.dot(x, self.Px)
        centres = zip(*funnel.x[k], strict=True)
        states = [in_time(points) + e for points, e in zip(centres, x, strict=True)]

        self.inputs, self.held = [], []
        for i, points in enumerate(zip(*policy.u[k], strict=True)):  # ũ = u₀ - Kx̄
            self.inputs.append(in_time(points) - ring.dot(self._gains(i), x))
        for side, (i, (low, high)) in zip(mode, policy.limits.items(), strict=True):
            wanted = self.inputs[i]
            if side:
                self.held.append(low - wanted if side < 0 else wanted - high)
                self.inputs[i] = ring.made(low if side < 0 else high)
            else:
                self.held.append((high - wanted) * (wanted - low))
        self.known = [in_time(funnel.t[k : k + 2]), *states]
        self._put: dict[Corner, Callable[[Terms], Polynomial]] = {}
        self._rest: Polynomial | None = None

    def rates(self, equations: list[Terms], corner: Corner) -> list[Polynomial]:
        """f(t, x₀ + x̄, clip(ũ) + δ) at a corner of the box of δ."""
        if corner not in self._put:
            pairs = zip(self.inputs, corner, self.off, strict=True)
            inputs = [u + side * most if side else u for u, side, most in pairs]
            self._put[corner] = self.ring.substitution([*self.known, *inputs])
        return list(map(self._put[corner], equations))

    def rest(self, margin: Fraction, pushes: Sequence[Push]) -> Polynomial:
        """dρ/ds - margin h ρ + 2x̄'P dx₀/ds - x̄'(dP/ds)x̄, less what w pushes: all but f."""
        if self._rest is not None:
            return self._rest
        ring, k, h = self.ring, self.k, self.h
        bend = [
            [b - a for a, b in zip(*rows, strict=True)]
            for rows in zip(self.funnel.P[k], self.funnel.P[k + 1], strict=True)
        ]
        parts = [
            ring.made(self.funnel.rho[k + 1] - self.funnel.rho[k]),
            -margin * h * self.rho,
            2 * ring.dot(self._motion(), self.Px),
            -1 * ring.form(bend, ring.variables),
        ]
        for half, kappa, g in pushes:
            along = ring.dot(g, self.Px)
            parts += [-h * half * kappa * (along * along), ring.made(-h * half / kappa)]
        self._rest = ring.sum(parts)
        return self._rest

    def turning(self, i: int, f: Sequence[Polynomial]) -> Polynomial:
        """dũ_i/ds = du₀/ds - (dK/ds)x̄ - K(h f - dx₀/ds), where ẋ = f."""
        ring, gains = self.ring, self._gains(i)
        rows = zip(*(K[i] for K in self.policy.K[self.k]), strict=True)
        turned = ring.dot([self.in_time(slope(points)) for points in rows], ring.variables)
        own = self.in_time(slope([u[i] for u in self.policy.u[self.k]]))
        moved = [m - self.h * rate for m, rate in zip(self._motion(), f, strict=True)]
        return own - turned + ring.dot(gains, moved)

    def taken(self, taus: Node, held: list[Polynomial], sides: Node) -> list[Polynomial]:
        """-τ q for everything that is nonnegative here, τ sums of squares in `sides`."""
        ring, found = self.ring, []
        for node, q in zip(taus.items(len(held), len(held)), held, strict=True):
            tau = node.members("columns squares") | {"basis": sides}
            found.append(-1 * (expanded(read_squares(tau, ring), ring) * q))
        return found

    def _gains(self, i: int) -> list[Polynomial]:
        """Row i of K."""
        rows = zip(*(K[i] for K in self.policy.K[self.k]), strict=True)
        return [self.in_time(points) for points in rows]

    def _motion(self) -> list[Polynomial]:
        """dx₀/ds."""
        return [self.in_time(slope(p)) for p in zip(*self.funnel.x[self.k], strict=True)]


class Loops:
    """The closed loops of pieces; those that share one should follow each other."""

    def __init__(self, policy: Policy, funnel: Funnel) -> None:
        self.policy, self.funnel = policy, funnel
        self.last: ClosedLoop | None = None

    def loop(self, ring: Ring, part: Part, mode: Mode, off: Sequence[Fraction]) -> ClosedLoop:
        """The last one, or a new one if that was another."""
        last = self.last
        if last is None or last.ring is not ring or (last.part, last.mode) != (part, mode):
            self.last = last = ClosedLoop(ring, self.policy, self.funnel, part, mode, off)
        return last


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


def slope(points: Sequence[Fraction]) -> list[Fraction]:
    """Control points of the derivative in s."""
    return [(len(points) - 1) * (b - a) for a, b in pairwise(points)] or [Fraction(0)]
