"""What holding and mismeasuring an input changes: it is clip(ũ) + δ, and |δ_i| <= W_i.

A held input is the policy's of some time at most a period ago. Pieces of rates show that
|dũ_i/dt| < R_i in the funnel, so it is off by the period times R at most, and an error e of the
state by |Ke| more. Why that is enough: "The hold between samples" in docs/theory-funnels.md.
"""

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

from .closed_loop import Corner, Loops, at
from .exact import Matrix, dot
from .files import Node, refuse_if
from .pieces import Piece, in_order, modes_of, pushed, pushing, refuse_many
from .polynomials import Ring, at_width
from .positivity import positive, read_squares
from .trajectory import Field, Funnel, Policy


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
    def moves(self) -> bool:
        """Whether the input is off at all."""
        return bool(self.period or any(self.error))

    @property
    def corners(self) -> list[Corner]:
        """The corners of the box of δ."""
        inputs = len(self.widths[0])
        return list(product((-1, 1), repeat=inputs)) if self.moves else [(0,) * inputs]


def read_hold(
    parts: dict[str, Node], stated: dict[str, Node], field: Field, policy: Policy, funnel: Funnel
) -> Hold:
    """The hold and the measurement error that a claim is about, and what u is off by then.

    At a time in interval k the input is of a time in it or in one that ends less than a period
    before it starts: W is period times the largest rate there, and what e does to the largest Ke.
    """
    period, error = Fraction(0), [Fraction(0)] * field.n
    rates: Matrix = [[Fraction(0)] * field.m for _ in funnel.x]
    if "hold" in parts:
        period = parts["hold"].number()
        rates = stated["rates"].array(len(funnel.x), field.m)
        curves: tuple[list[Any], ...] = policy.u, policy.K
        refuse_if(
            period <= 0 or any(rate <= 0 for row in rates for rate in row),
            "hold and rates should be positive",
            "not_below",
        )
        refuse_if(
            any(p[-1] != q[0] for curve in curves for p, q in pairwise(curve)),
            "the policy jumps at a knot: no rate bounds what holding it changes",
            "not_valid",
        )
    if "error" in parts:
        error = parts["error"].array(field.n)
        refuse_if(
            any(e < 0 for e in error), "error should be 0 or more for every state", "not_below"
        )
    exponents = [e for span in field.equations for equation in span for e, _ in equation]
    first = 1 + field.n
    curved = any(power > 1 for e in exponents for power in e[first : first + field.m])
    refuse_if(
        curved and parts.keys() & {"hold", "error"},
        "the dynamics are not affine in each input: corners do not bound its hold",
        "not_valid",
    )

    shaken = [
        [max(dot(list(map(abs, gain[i])), error) for gain in points) for i in range(field.m)]
        for points in policy.K
    ]
    widths: list[list[Fraction]] = []
    begun = 0
    for k in range(len(funnel.x)):
        while funnel.t[begun + 1] <= funnel.t[k] - period:
            begun += 1
        turned, moved = (
            [max(column) for column in zip(*rows[begun : k + 1], strict=True)]
            for rows in (rates, shaken)
        )
        widths.append([period * rate + e for rate, e in zip(turned, moved, strict=True)])
    return Hold(period, error, rates, widths)


def decide_rates(
    field: Field,
    policy: Policy,
    funnel: Funnel,
    spans: list[int],
    stated: dict[str, Node],
    hold: Hold,
) -> int:
    """Prove |dũ_i/dt| < R_i in the funnel, for every input where it is not at a limit.

    What entries of (δ, w) do that only push is taken off R; the others are at vertices.
    """
    m, ranges = field.m, [*[(Fraction(-1), Fraction(1))] * field.m, *field.box]
    free = pushing(field, 1 + field.n, m + len(field.box))
    sides = [(Fraction(0),) if j in free else ends for j, ends in enumerate(ranges[:m])]
    values = [
        ((low + high) / 2,) if m + j in free else (low, high)
        for j, (low, high) in enumerate(field.box)
    ]
    limited = list(policy.limits)
    refuse_many(len(spans), 2 ** (m + len(field.box) - len(free)), 3 ** len(limited), 2 * m)
    vertices = list(product(product(*sides), product(*values)))
    cases = [
        (i, sign, *mode)
        for i, sign, mode in product(range(m), (-1, 1), modes_of(policy))
        if i not in limited or not mode[limited.index(i)]
    ]
    needed = list(product(range(len(spans)), range(len(vertices)), cases))
    names = "input sign tau" + " mode" * bool(limited)
    pieces = in_order(stated["rate_pieces"], names, needed, len(limited))
    halves = [(high - low) / 2 for low, high in field.box]
    loops = Loops(policy, funnel)

    def decide(ring: Ring, piece: Piece) -> None:
        (k, v, (i, sign, *mode)), part = piece.key, piece.part
        corner, w = vertices[v]
        loop = loops.loop(ring, part, tuple(mode), hold.widths[k])
        equations = field.equations[spans[k]]

        room = hold.rates[k][i]
        for j in free:
            half = hold.widths[k][j] if j < m else halves[j - m]
            column = [pushed(equation, 1 + field.n + j) for equation in equations]
            room -= half * max(abs(dot(gain[i], column)) for gain in policy.K[k])
        f = loop.rates(at(equations, w), tuple(map(int, corner)))
        parts = [ring.made(loop.h * room), -sign * loop.turning(i, f)]
        parts += loop.taken(piece.members["tau"], [loop.gap, *loop.held], stated["sides"])
        squares = read_squares(piece.members | {"basis": stated["basis"]}, ring)
        what = f"rate piece {piece.place} (interval {k}, vertex {v}, input {i})"
        positive(ring.sum(parts), squares, ring, what)

    at_width(field.n, pieces, decide)
    return len(pieces)
