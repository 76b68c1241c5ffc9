"""A matrix polynomial E(w) on a box: finitely many matrices whose convex hull holds its values."""

from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from math import comb, prod

from .exact import MAX_ORDER, Matrix, combined, definite
from .files import MAX_STATED, Node, Rejected

Box = list[tuple[Fraction, Fraction]]
Terms = list[tuple[list[int], list[list[Fraction]]]]  # of a matrix polynomial: powers, coefficients


def side_by_side(G: Sequence[Terms], rows: int) -> Terms:
    """[G_0 … G_n] as one matrix polynomial."""
    zeros = [[[Fraction(0)] * len(g[0][1][0])] * rows for g in G]
    found = [{tuple(powers): block for powers, block in g} for g in G]
    used = sorted({powers for g in found for powers in g})
    if len(used) > MAX_STATED:
        raise Rejected(f"the model has {len(used)} monomials; at most {MAX_STATED} are taken")
    return [
        (
            list(powers),
            [
                [
                    entry
                    for g, none in zip(found, zeros, strict=True)
                    for entry in g.get(powers, none)[i]
                ]
                for i in range(rows)
            ],
        )
        for powers in used
    ]


def effort(E: Terms, box: Box) -> int:
    """How many products the Bernstein form of E takes."""
    degrees, entries = _degrees(E, len(box)), sum(map(len, E[0][1]))
    longest = [max(end.numerator.bit_length() + end.denominator.bit_length() for end in ends)
               for ends in box]  # fmt: skip
    bits = sum(d * long for d, long in zip(degrees, longest, strict=True))
    size = len(E) * (entries + len(box))
    return prod(d + 1 for d in degrees) * size * (1 + (bits >> 11) ** 2)


def bernstein(E: Terms, box: Box) -> list[Matrix]:
    """The Bernstein coefficients of E(w) on a box: their convex hull holds its values.

    On [lo, hi], w^e has the coefficient Σ_j C(e, j) lo^(e-j) (hi - lo)^j C(k, j)/C(d, j) at index k
    of degree d.
    """
    degrees = _degrees(E, len(box))
    tables = [
        [
            [
                sum(
                    (
                        comb(e, j)
                        * low ** (e - j)
                        * (high - low) ** j
                        * Fraction(comb(k, j), comb(d, j))
                        for j in range(min(e, k) + 1)
                    ),
                    Fraction(0),
                )
                for k in range(d + 1)
            ]
            for e in range(d + 1)
        ]
        for d, (low, high) in zip(degrees, box, strict=True)
    ]
    found: set[tuple[tuple[Fraction, ...], ...]] = set()
    for k in product(*(range(d + 1) for d in degrees)):
        value = [[Fraction(0)] * len(row) for row in E[0][1]]
        for powers, coefficients in E:
            factors = (tables[i][e][k[i]] for i, e in enumerate(powers) if e)
            weight = prod(factors, start=Fraction(1))
            if weight:
                value = combined(value, coefficients, weight)
        found.add(tuple(map(tuple, value)))
    return _extreme([[list(row) for row in value] for value in sorted(found)])


def _degrees(E: Terms, variables: int) -> list[int]:
    return [max(powers[i] for powers, _ in E) for i in range(variables)]


def between(G: list[Terms], box: Box, node: Node) -> list[Matrix]:
    """[G_0 … G_n] at the stated ends of one quadratic G_0 = q, the others being constant.

    low <= q(w) <= high on the box by the S-procedure: with weights a, b >= 0, as forms in [1; w],
        q - low - Σ a_i (w_i - lo_i)(hi_i - w_i) ≻ 0,
        high - q - Σ b_i (w_i - lo_i)(hi_i - w_i) ≻ 0.
    """
    q, *lagged = G
    if len(q[0][1]) != 1 or any(any(e) for g in lagged for e, _ in g):
        raise Rejected(f"{node.where}: ends are for one output whose lags have constant factors")
    if any(sum(e) > 2 for e, _ in q):
        raise Rejected(f"{node.where}: ends are for a leading coefficient of degree 2 at most")
    if len(box) >= MAX_ORDER:
        raise Rejected(f"{node.where}: ends are for at most {MAX_ORDER - 1} entries of the box")
    parts = node.members("low high low_weights high_weights")
    ends = parts["low"].number(), parts["high"].number()
    for name, sign, end in (("low", 1, ends[0]), ("high", -1, ends[1])):
        weights = parts[f"{name}_weights"].array(len(box))
        if min(weights) < 0:
            raise Rejected(f"{node.where}: weights should be 0 or more")
        M = [[Fraction(0)] * (len(box) + 1) for _ in range(len(box) + 1)]
        M[0][0] = -sign * end
        for e, ((c,),) in q:
            used = [i + 1 for i, power in enumerate(e) for _ in range(power)]
            i, j = [0] * (2 - len(used)) + used
            M[i][j] += sign * c / 2
            M[j][i] += sign * c / 2
        for i, (weight, (low, high)) in enumerate(zip(weights, box, strict=True), 1):
            M[0][0] += weight * low * high
            M[i][i] += weight
            M[0][i] -= weight * (low + high) / 2
            M[i][0] -= weight * (low + high) / 2
        definite(M, f"the {name} end of the leading coefficient")
    rest = [sum((c[0][0] for _, c in g), Fraction(0)) for g in lagged]
    return [[[end, *rest]] for end in ends]


def _extreme(E: list[Matrix]) -> list[Matrix]:
    """Matrices with the same convex hull: the two ends where only one entry differs."""
    varying = [
        (i, j)
        for i, row in enumerate(E[0])
        for j, entry in enumerate(row)
        if any(other[i][j] != entry for other in E)
    ]
    if len(varying) != 1:
        return E
    ((i, j),) = varying
    return [min(E, key=lambda e: e[i][j]), max(E, key=lambda e: e[i][j])]
