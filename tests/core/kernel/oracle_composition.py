"""Claim `funnel_composition` decided a second time, written from its page alone, in Fractions.

What the composition adds is decided exactly. Of a stage's own proof, docs/certificate_continuous_
funnel.md, its files, knots, goal and coverage are; that its pieces are positive is tried at points
by the oracle of that claim: a stage found negative somewhere is false, whatever was proved.
"""

from collections.abc import Mapping
from fractions import Fraction
from itertools import pairwise, product
from typing import Any

from nlsid_core import files
from tests.core.kernel.oracle_continuous import Oracle, add, dot, numbers

Json = dict[str, Any]
Rows = list[list[Fraction]]
TIMES = [Fraction(k, 2) for k in range(3)]  # along a piece
SIZES = [Fraction(k, 2) for k in range(-3, 4)]  # of a deviation, in parts of the funnel's size


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether the composition is one, its stages true at every point that is tried."""
    bindings, multipliers = document["claim"]["about"], document["proof"]["multipliers"]
    roles = [f"stage{i}" for i in range(1, len(multipliers) + 2)]
    if not 2 <= len(roles) <= 100 or set(bindings) != set(roles):
        return False
    stages = [bound(bindings[role], about) for role in roles]
    if not all(stage_holds(stage, about) for stage in stages):
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


def bound(binding: Json, about: Mapping[str, Json]) -> Json:
    """The document of a binding, whose digest has to be its own."""
    document = about[binding["file"]]
    assert files.digest(document) == binding["digest"]
    return document


def ellipsoid(funnel: Json, end: int) -> tuple[list[Fraction], Rows, Fraction]:
    """Centre, P and ρ of a funnel at its start (0) or its end (-1)."""
    return numbers(funnel["x"][end][end]), numbers(funnel["P"][end]), Fraction(funnel["rho"][end])


def is_inside(
    a: list[Fraction], P: Rows, rho: Fraction, b: list[Fraction], B: Rows, multiplier: Fraction
) -> bool:
    """λ >= 0 and [λP/ρ - B, -Bd; -(Bd)', 1 - λ - d'Bd] ⪰ 0, d = a - b."""
    d = [p - q for p, q in zip(a, b, strict=True)]
    Bd = [dot(row, d) for row in B]
    M = [
        [*(multiplier * p / rho - q for p, q in zip(left, right, strict=True)), -e]
        for left, right, e in zip(P, B, Bd, strict=True)
    ]
    M.append([*(-e for e in Bd), 1 - multiplier - dot(d, Bd)])
    size = range(len(M))
    chosen = [[i for i in size if mask >> i & 1] for mask in range(1, 2 ** len(M))]
    return multiplier >= 0 and all(
        determinant([[M[i][j] for j in part] for i in part]) >= 0 for part in chosen
    )


def determinant(M: Rows) -> Fraction:
    """By cofactors of the first row."""
    if not M:
        return Fraction(1)
    return sum(
        (
            (-1) ** j * entry * determinant([row[:j] + row[j + 1 :] for row in M[1:]])
            for j, entry in enumerate(M[0])
        ),
        Fraction(0),
    )


def stage_holds(stage: Json, about: Mapping[str, Json]) -> bool:
    """Whether a stage without limits, bounds and w, in one state, is a funnel at the points."""
    claim, proof = stage["claim"], stage["proof"]
    field, policy, funnel = (
        bound(claim["about"][role], about) for role in ("vector_field", "policy", "funnel")
    )
    assert claim["kind"] == "continuous_funnel"
    assert field["valid"] == field["uncertain"] == policy["limits"] == []
    digests = {role: claim["about"][role]["digest"] for role in ("vector_field", "policy")}
    named = (policy["vector_field"], funnel["vector_field"], funnel["policy"])
    if named != (digests["vector_field"], digests["vector_field"], digests["policy"]):
        return False
    t, rho, x = numbers(funnel["t"]), numbers(funnel["rho"]), numbers(funnel["x"])
    P = numbers(funnel["P"])
    if numbers(policy["t"]) != t or numbers(policy["x"]) != x or Fraction(proof["margin"]) <= 0:
        return False
    if any(b <= a for a, b in pairwise(t)) or min(rho) <= 0:
        return False
    if any(before[-1] != after[0] for before, after in pairwise(x)):
        return False
    if any(shape[0][0] <= 0 for shape in P) or any(len(shape) != 1 for shape in P):
        return False
    if "goal" in claim:
        centre, goal = numbers(claim["goal"]["centre"]), numbers(claim["goal"]["P"])
        multiplier = Fraction(proof["goal_multiplier"])
        if not is_inside(*ellipsoid(funnel, -1), centre, goal, multiplier):
            return False
    oracle = Oracle(field, policy, funnel, proof)
    for k in range(len(t) - 1):
        parts = sorted(
            (Fraction(piece["index"], 2 ** piece["level"]), Fraction(1, 2 ** piece["level"]))
            for piece in proof["pieces"]
            if piece["interval"] == k
        )
        until = Fraction(0)
        for start, length in parts:
            until = max(until, start + length) if start <= until else until
        if until < 1:
            return False
    size = Fraction(max(float(r / p[0][0]) for r, p in zip(rho, P, strict=True)) ** 0.5)
    return all(
        oracle.c(piece, s, [size * part]) > 0
        for piece, s, part in product(proof["pieces"], TIMES, SIZES)
    )


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
