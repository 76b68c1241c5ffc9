"""Claim `funnel_composition` decided a second time, written from its page alone, in Fractions.

A stage's own proof is decided by the oracle of docs/certificate_continuous_funnel.md.
"""

from collections.abc import Mapping
from fractions import Fraction
from itertools import pairwise
from typing import Any

from tests.core.kernel.oracle_continuous import add, bound, ellipsoid, is_inside
from tests.core.kernel.oracle_continuous import agrees as agrees_alone

Json = dict[str, Any]


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether the composition is one, and every stage a funnel."""
    try:
        return is_one(document, about)
    except (ArithmeticError, AssertionError, LookupError, TypeError, ValueError):
        return False


def is_one(document: Json, about: Mapping[str, Json]) -> bool:
    """What the page asks, of documents that are what they should be."""
    bindings, multipliers = document["claim"]["about"], document["proof"]["multipliers"]
    roles = [f"stage{i}" for i in range(1, len(multipliers) + 2)]
    if not 2 <= len(roles) <= 100 or set(bindings) != set(roles):
        return False
    stages = [bound(bindings[role], about) for role in roles]
    if any("hold" in stage["claim"] or not agrees_alone(stage, about) for stage in stages):
        return False
    funnels = [bound(stage["claim"]["about"]["funnel"], about) for stage in stages]
    for (before, after), multiplier in zip(pairwise(funnels), multipliers, strict=True):
        if Fraction(before["t"][-1]) != Fraction(after["t"][0]):
            return False
        (a, P, rho), (b, Q, sigma) = ellipsoid(before, -1), ellipsoid(after, 0)
        shape = [[entry / sigma for entry in row] for row in Q]
        if len(a) != len(b) or not is_inside(a, P, rho, b, shape, Fraction(multiplier)):
            return False
    return True


def worst_step(before: Json, after: Json, points: int = 64) -> Fraction:
    """The largest |x - b|²_Q/σ at points of the ellipsoid before: above 1 it leaves the next one.

    One state: its two ends, from inside, and points between.
    """
    (a, P, rho), (b, Q, sigma) = ellipsoid(before, -1), ellipsoid(after, 0)
    reach = Fraction(float(rho / P[0][0]) ** 0.5 * (1 - 1e-15))
    found = Fraction(0)
    for k in range(-points, points + 1):
        x = add(a, [reach * k / points])
        found = max(found, Q[0][0] * (x[0] - b[0]) ** 2 / sigma)
    return found
