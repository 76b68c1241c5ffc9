"""Claim `sampled_funnel` decided a second time, in Fractions.

Written from docs/certificate_sampled_funnel.md alone; it shares no code with the kernel or the
search. What is claimed is evaluated at points, or at the variables themselves (`P`), which leaves
the polynomial: `agrees` decides all that the page asks, with nothing left out.
"""

import json
from collections.abc import Mapping
from fractions import Fraction
from functools import lru_cache
from itertools import product
from math import factorial, prod
from typing import Any

from nlsid_core import files
from tests.core.kernel.oracle_continuous import bound, determinant, dot, numbers
from tests.core.kernel.oracle_polynomial import P, left_over
from tests.core.kernel.oracle_stability import is_definite, solved

Json = dict[str, Any]
CHAINS = ("tube", "inlet")
Vector = list[Fraction]
Matrix = list[Vector]


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
    coefficients = numbers(model["coefficients"])
    values = [monomial(point, row) for row in model["exponents"]]
    return [
        sum((v * row[i] for v, row in zip(values, coefficients, strict=True)), Fraction(0))
        for i in range(len(coefficients[0]))
    ]


def policy_input(policy: Json, k: int, deviation: Vector) -> Vector:
    """u_k - K_k x̄."""
    return plus(numbers(policy["u"][k]), times(numbers(policy["K"][k]), deviation), -1)


def explicit_next(model: Json, policy: Json, k: int, deviation: Vector) -> Vector:
    """f(x_k + x̄, u_k - K_k x̄) - x_{k+1}."""
    x = plus(numbers(policy["x"][k]), deviation)
    after = map_at(model, x + policy_input(policy, k, deviation))
    return plus(after, numbers(policy["x"][k + 1]), -1)


def monomial(point: Vector, exponents: list[int]) -> Fraction:
    """Π point^exponents."""
    result = Fraction(1)
    for p, e in zip(point, exponents, strict=True):
        result = result * p**e if e else result
    return result


def squares_at(entry: Json, basis: list[list[int]], point: Vector) -> Fraction:
    """Σ (R V v)² / 4^unit of an entry {columns, squares}."""
    monomials = [
        Fraction(2) ** shift * monomial(point, row)
        for shift, row in zip(entry["columns"], basis, strict=True)
    ]
    part = entry["squares"]
    (factor,) = part["factors"]
    assert set(part) == {"unit", "factors"}
    total = Fraction(0)
    for row in factor:
        used = monomials[len(monomials) - len(row) :]
        total = total + dot([Fraction(a) for a in row], used) ** 2
    below: Fraction = Fraction(4) ** part["unit"]
    return total / below


def claimed_at(documents: dict[str, Json], proof: Json, chain: str, k: int, y: Vector) -> Fraction:
    """The polynomial that has to be nonnegative, at y = z."""
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    step = proof["steps"][k]
    entry = step[chain]
    deviation = times(numbers(step["T"]), y)
    S_next = numbers(funnel["S"][k + 1])
    radius = Fraction(funnel[chain][k])
    size = size2(times(numbers(funnel["S"][k]), deviation))
    value = Fraction(entry["reach"]) ** 2
    value -= squares_at(entry["ball"], proof["ball_basis"], y) * (radius**2 - size)
    return value - size2(times(S_next, explicit_next(model, policy, k, deviation)))


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether a proof document about these files proves its claim."""
    try:
        named = document["claim"]["about"]
        assert document["claim"]["kind"] == "sampled_funnel"
        assert set(named) == {"model", "policy", "funnel"}
        documents = {role: bound(named[role], about) for role in named}
        model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
        if {policy["model"], funnel["model"]} != {files.digest(model)}:
            return False
        if funnel["policy"] != files.digest(policy):
            return False
        proof, steps = document["proof"], len(policy["u"])
        assert len(proof["steps"]) == steps
        return (
            makes_sense(model, policy, funnel)
            and is_a_response(funnel["assumption"])
            and all(stays(model, policy, funnel, k) for k in range(steps + 1))
            and all(follows(documents, proof, k) for k in range(steps))
        )
    except (ArithmeticError, AssertionError, LookupError, TypeError, ValueError):
        return False


def makes_sense(model: Json, policy: Json, funnel: Json) -> bool:
    """Obligations 1 and 2: kinds, shapes, radii and sizes."""
    n, p, N = len(model["x"]), len(model["u"]), len(policy["u"])
    rows = model["exponents"]
    arrays = [
        (model["coefficients"], (len(rows), n)),
        (model["x_range"], (n, 2)),
        (model["u_range"], (p, 2)),
        (policy["L"], (n, n)),
        (policy["u"], (N, p)),
        (policy["x"], (N + 1, n)),
        (policy["K"], (N, p, n)),
        (funnel["S"], (N + 1, n, n)),
        (funnel["A"], (N, n, n)),
        (funnel["half_widths"], (N + 1, n)),
        *((funnel[chain], (N + 1,)) for chain in CHAINS),
    ]
    radii = [*funnel["tube"], *funnel["inlet"]]
    return (
        (model["kind"], policy["kind"], funnel["kind"]) == ("state_map", "sampled", "sampled")
        and all(has_shape(value, shape) for value, shape in arrays)
        and 1 <= n <= 16
        and 1 <= p <= 16
        and N >= 1
        and N * n**3 <= 10**6
        and len({tuple(row) for row in rows}) == len(rows) >= 1
        and all(len(row) == n + p for row in rows)
        and all(type(e) is int and e >= 0 for row in rows for e in row)
        and 0 < Fraction(model["period"]) == Fraction(policy["period"])
        and min(radii) > 0
        and funnel["tube"][0] <= funnel["inlet"][0]
        and all(is_triangular(S) for S in funnel["S"])
    )


def has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether nested lists of numbers have it."""
    if not shape:
        return type(value) in (int, float)
    return len(value) == shape[0] and all(has_shape(entry, shape[1:]) for entry in value)


def is_triangular(M: list[list[float]]) -> bool:
    """Upper, with a diagonal without zeros."""
    size = range(len(M))
    return all(M[i][i] != 0 and not any(M[i][:i]) for i in size)


def is_a_response(assumption: Json) -> bool:
    """Obligation 3."""
    bound, rate, gain = (Fraction(assumption[name]) for name in ("bound", "rate", "gain"))
    return bool(assumption["form"] == "response") and bound >= 0 and rate == gain == 1


def stays(model: Json, policy: Json, funnel: Json, k: int) -> bool:
    """Obligation 4 at sample k."""
    n, S = len(model["x"]), numbers(funnel["S"][k])
    SS = [[dot([r[i] for r in S], [r[j] for r in S]) for j in range(n)] for i in range(n)]
    units = [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]
    tube, inlet = (Fraction(funnel[chain][k]) for chain in CHAINS)
    tube += Fraction(funnel["assumption"]["bound"])
    both = max(tube, inlet + Fraction(funnel["assumption"]["bound"]))
    wanted = [(g, Fraction(w), tube) for g, w in zip(units, funnel["half_widths"][k], strict=True)]
    signals = [
        (g, c, box) for g, c, box in zip(units, policy["x"][k], model["x_range"], strict=True)
    ]
    if k < len(policy["u"]):
        signals += zip(numbers(policy["K"][k]), policy["u"][k], model["u_range"], strict=True)
    for g, c, (low, high) in signals:
        room = min(Fraction(high) - Fraction(c), Fraction(c) - Fraction(low))
        wanted.append((g, room, both))
    return is_definite(SS) and all(
        w >= 0 and R**2 * dot(g, [row[0] for row in solved(SS, [[e] for e in g])]) <= w**2
        for g, w, R in wanted
    )


def follows(documents: dict[str, Json], proof: Json, k: int) -> bool:
    """Obligations 5 to 9 at step k, once for the same step of the same proof."""
    bases = {key: part for key, part in proof.items() if key != "steps"}
    names = {
        "model": "kind period x exponents coefficients",
        "policy": "u x K",
        "funnel": "assumption tube inlet S A",
    }
    used = {
        role: {key: documents[role].get(key) for key in keys.split()}
        for role, keys in names.items()
    }
    return _follows(json.dumps(used), json.dumps(bases), json.dumps(proof["steps"][k]), k)


@lru_cache(maxsize=20_000)
def _follows(files_of: str, bases: str, step_of: str, k: int) -> bool:
    documents, step = json.loads(files_of), json.loads(step_of)
    proof = json.loads(bases) | {"steps": {k: step}}
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    n = len(model["x"])
    y: Any = [P.variable(n, i) for i in range(n)]
    S, S_next = (numbers(funnel["S"][i]) for i in (k, k + 1))
    T, A = numbers(step["T"]), numbers(funnel["A"][k])
    bound = Fraction(funnel["assumption"]["bound"])
    kappa, gammas = Fraction(step["kappa"]), numbers(step["curvature"])
    if not (is_triangular(step["T"]) and min([kappa, *gammas]) >= 0):
        return False
    if not stretches_less(multiplied(S, T), kappa):
        return False
    deviation = times(T, y)
    free = times(S_next, times(A, deviation))
    g = times(S_next, explicit_next(model, policy, k, deviation))
    if not is_curved(plus(g, free, -1), gammas):
        return False
    for chain in CHAINS:
        entry, radius = step[chain], Fraction(funnel[chain][k])
        reach, following = Fraction(entry["reach"]), Fraction(funnel[chain][k + 1])
        if reach < 0:
            return False
        added = kappa * stretch(gammas, kappa * radius, kappa * bound) * bound
        claimed: Any = claimed_at(documents, proof, chain, k, y)
        witness = {"basis": proof["basis"], "columns": entry["columns"]}
        if left_over([claimed], witness | {"squares": entry["squares"]}) is None:
            return False
        if reach + added > following:
            return False
    return True


def multiplied(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    return [[dot(row, [r[j] for r in B]) for j in range(len(B[0]))] for row in A]


def is_semidefinite(M: Matrix) -> bool:
    """Every principal minor is 0 or more."""
    size = range(len(M))
    chosen = [[i for i in size if mask >> i & 1] for mask in range(1, 2 ** len(M))]
    return all(determinant([[M[i][j] for j in part] for i in part]) >= 0 for part in chosen)


def stretches_less(M: Matrix, kappa: Fraction) -> bool:
    """κ² M'M - I ⪰ 0, so |z| <= κ|M z|."""
    size = range(len(M))
    columns = [[row[i] for row in M] for i in size]
    return is_semidefinite(
        [[kappa**2 * dot(columns[i], columns[j]) - int(i == j) for j in size] for i in size]
    )


def is_curved(p: list[Any], gammas: Vector) -> bool:
    """Obligation 6: γ_m bounds the part of degree m."""
    for m in range(1, max([sum(e) for q in p for e in q.terms], default=0) + 1):
        keys = {e for q in p for e in q.terms if sum(e) == m}
        if m > len(gammas):
            return not keys
        size = range(len(p))
        M = [[gammas[m - 1] ** 2 * int(i == j) for j in size] for i in size]
        for e in keys:
            share = Fraction(prod(factorial(k) for k in e), factorial(m))
            c = [q.terms.get(e, Fraction(0)) for q in p]
            for i, j in product(size, size):
                M[i][j] -= share * c[i] * c[j]
        if not is_semidefinite(M):
            return False
    return True


def stretch(gammas: Vector, s: Fraction, t: Fraction) -> Fraction:
    """μ(s, t)."""
    return sum(
        (
            gamma * (s + t) ** i * s ** (m - 1 - i)
            for m, gamma in enumerate(gammas, start=1)
            for i in range(m)
        ),
        Fraction(0),
    )
