"""What a sampled funnel's proof says, computed from its documents alone and in Fractions.

Written from docs/certificate_sampled_funnel.md; it shares no code with the kernel or the search.
Everything is evaluated at points: no polynomial is ever multiplied out.
"""

from fractions import Fraction
from math import prod
from typing import Any

Json = dict[str, Any]
Vector = list[Fraction]
Matrix = list[Vector]


def fractions(value: Any) -> Any:
    """Nested lists of numbers as Fractions."""
    return [fractions(entry) for entry in value] if isinstance(value, list) else Fraction(value)


def times(M: Matrix, v: Vector) -> Vector:
    """M v."""
    return [sum((a * b for a, b in zip(row, v, strict=True)), Fraction(0)) for row in M]


def plus(a: Vector, b: Vector, weight: int = 1) -> Vector:
    """a + weight b."""
    return [p + weight * q for p, q in zip(a, b, strict=True)]


def size2(v: Vector) -> Fraction:
    """|v|²."""
    return sum((entry**2 for entry in v), Fraction(0))


def map_at(model: Json, point: Vector) -> Vector:
    """The model's polynomials at [x; u]."""
    coefficients = fractions(model["coefficients"])
    values = [monomial(point, row) for row in model["exponents"]]
    return [
        sum((v * row[i] for v, row in zip(values, coefficients, strict=True)), Fraction(0))
        for i in range(len(coefficients[0]))
    ]


def policy_input(policy: Json, k: int, deviation: Vector) -> Vector:
    """u_k - K_k x̄."""
    return plus(fractions(policy["u"][k]), times(fractions(policy["K"][k]), deviation), -1)


def explicit_next(model: Json, policy: Json, k: int, deviation: Vector) -> Vector:
    """f(x_k + x̄, u_k - K_k x̄) - x_{k+1}."""
    x = plus(fractions(policy["x"][k]), deviation)
    after = map_at(model, x + policy_input(policy, k, deviation))
    return plus(after, fractions(policy["x"][k + 1]), -1)


def implicit_next(
    model: Json, policy: Json, k: int, deviation: Vector, rate: Vector
) -> tuple[Vector, Vector]:
    """x̄⁺ and the equation's value, where the next rate departs from the nominal's by `rate`."""
    d, half = len(rate), Fraction(model["period"]) / 2
    following = fractions(policy["x"][k + 1])
    x = plus(fractions(policy["x"][k]), deviation)
    q, v, u = x[:d], x[d:], policy_input(policy, k, deviation)
    v_next = plus(following[d:], rate)
    q_next = [a + half * (b + c) for a, b, c in zip(q, v, v_next, strict=True)]
    pull = plus(map_at(model, q + v + u), map_at(model, q_next + v_next + u))
    h = [c - b - half * p for b, c, p in zip(v, v_next, pull, strict=True)]
    return plus(q_next + v_next, following, -1), h


def monomial(point: Vector, exponents: list[int]) -> Fraction:
    """Π point^exponents."""
    return Fraction(prod(p**e for p, e in zip(point, exponents, strict=True)))


def squares_at(entry: Json, basis: list[list[int]], point: Vector) -> Fraction:
    """Σ (R V v)² / 4^unit of an entry {columns, squares}."""
    monomials = [
        Fraction(2) ** shift
        * prod((p**e for p, e in zip(point, row, strict=True)), start=Fraction(1))
        for shift, row in zip(entry["columns"], basis, strict=True)
    ]
    (factor,) = entry["squares"]["factors"]
    unit, total = int(entry["squares"]["unit"]), Fraction(0)
    for row in factor:
        used = monomials[len(monomials) - len(row) :]
        total += sum((int(a) * m for a, m in zip(row, used, strict=True)), Fraction(0)) ** 2
    return total * Fraction(1, 4) ** unit


def claimed_at(documents: dict[str, Json], proof: Json, chain: str, k: int, y: Vector) -> Fraction:
    """The polynomial that has to be nonnegative, at y = z or (z, w)."""
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    step = proof["steps"][k]
    entry, n = step[chain], len(model["x"])
    z, w = y[:n], y[n:]
    deviation = times(fractions(step["T"]), z)
    S_next = fractions(funnel["S"][k + 1])
    radius = Fraction(funnel[chain][k])
    size = size2(times(fractions(funnel["S"][k]), deviation))
    value = Fraction(entry["reach"]) ** 2
    value -= squares_at(entry["ball"], proof["ball_basis"], y) * (radius**2 - size)
    if not w:
        return value - size2(times(S_next, explicit_next(model, policy, k, deviation)))
    rate = times(fractions(step["T_next"]), w)
    after, h = implicit_next(model, policy, k, deviation, rate)
    far = Fraction(step["kappa_next"]) * Fraction(funnel["roots"][k + 1])
    if funnel["assumption"]["form"] == "response":
        bound = Fraction(funnel["assumption"]["bound"])
        far += Fraction(entry["spread"]) * Fraction(step["kappa"]) * bound
    value -= squares_at(entry["roots"], proof["roots_basis"], y) * (far**2 - size2(w))
    for row, equation in zip(entry["equations"]["rows"], h, strict=True):
        nu = sum(
            (
                a
                * Fraction(2) ** shift
                * prod((p**e for p, e in zip(y, m, strict=True)), start=Fraction(1))
                for a, shift, m in zip(
                    row, entry["equations"]["columns"], proof["equation_basis"], strict=True
                )
            ),
            Fraction(0),
        )
        value -= nu * equation
    return value - size2(times(S_next, after))


def refuted(documents: dict[str, Json]) -> str:
    """What a claim about one state says and a grid of states shows to be false; empty if nothing.

    Every obligation of the specification is tried at states and disturbances on a grid that
    includes the ends of the intervals, where a linear step is at its worst.
    """
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    a = funnel["assumption"]
    form, bound = a["form"], Fraction(a["bound"])
    widens = Fraction(0) if form == "peak" else bound
    rate, gain = Fraction(a["rate"]), Fraction(a["gain"])
    if Fraction(a["safety_factor"]) * Fraction(a["measured"]) > bound:
        return "bound"
    if not 0 <= rate <= 1 or gain < 1 or Fraction(a["safety_factor"]) < 1:
        return "rate, gain or factor"
    S = [Fraction(s[0][0]) for s in funnel["S"]]
    grid = [Fraction(i, 2) for i in range(-2, 3)]
    for k, size in enumerate(S):
        for chain in ("tube", "inlet"):
            radius = Fraction(funnel[chain][k])
            for part in grid:
                deviation = [part * (radius + widens) / abs(size)]
                if found := _outside(model, policy, k, deviation, last=k == len(S) - 1):
                    return found
                width = Fraction(funnel["half_widths"][k][0])
                if chain == "tube" and abs(deviation[0]) > width:
                    return "half-width"
            if k == len(S) - 1:
                continue
            following, A = Fraction(funnel[chain][k + 1]), Fraction(funnel["A"][k][0][0])
            for part in grid:
                xi = part * radius / abs(size)
                (start,) = explicit_next(model, policy, k, [xi])
                added = bound if form == "peak" else Fraction(0)
                if abs(S[k + 1] * start) + added > following:
                    return "reach"
                for push in grid:
                    w = push * bound / abs(size)
                    (after,) = explicit_next(model, policy, k, [xi + w])
                    if form == "response" and abs(S[k + 1] * (after - A * w)) > following:
                        return "response"
                    change = (S[k + 1] * (after - start)) ** 2
                    if (
                        form in ("energy", "fading")
                        and gain * change > (gain - 1) * rate * (size * w) ** 2
                    ):
                        return "stretch"
    return ""


def _outside(model: Json, policy: Json, k: int, deviation: Vector, *, last: bool) -> str:
    """Which signal leaves the box of the data."""
    x = plus(fractions(policy["x"][k]), deviation)
    values = [(x[0], model["x_range"][0])]
    if not last:
        values.append((policy_input(policy, k, deviation)[0], model["u_range"][0]))
    for value, (low, high) in values:
        if not Fraction(low) <= value <= Fraction(high):
            return "box"
    return ""
