"""Claim `stability` decided a second time, written from docs/certificate_stability.md alone.

Fractions, plain lists; matrices are decided by LDL' with fractions, Bernstein coefficients come
from interpolation, and nothing is shared with the kernel or the prover.
"""

from collections.abc import Callable, Mapping
from fractions import Fraction
from itertools import product
from math import comb
from typing import Any

Rows = list[list[Fraction]]
Json = dict[str, Any]


def zeros(rows: int, columns: int) -> Rows:
    return [[Fraction(0)] * columns for _ in range(rows)]


def is_definite(M: Rows) -> bool:
    """Symmetric, and every pivot of LDL' positive."""
    n = len(M)
    if any(M[i][j] != M[j][i] for i in range(n) for j in range(n)):
        return False
    L, D = zeros(n, n), [Fraction(0)] * n
    for j in range(n):
        D[j] = M[j][j] - sum((L[j][k] ** 2 * D[k] for k in range(j)), Fraction(0))
        if D[j] <= 0:
            return False
        for i in range(j + 1, n):
            below = sum((L[i][k] * L[j][k] * D[k] for k in range(j)), Fraction(0))
            L[i][j] = (M[i][j] - below) / D[j]
    return True


def solved(A: Rows, B: Rows) -> Rows:
    """A⁻¹B by Gauss-Jordan elimination."""
    n = len(A)
    rows = [left[:] + right[:] for left, right in zip(A, B, strict=True)]
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k] != 0)
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i in range(n):
            if i != k:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows]


def increments(model: Json) -> tuple[Rows, int, list[tuple[Fraction, Fraction]]]:
    """F, m, and the box."""
    kind = model["kind"]
    if kind == "difference_equation":
        a = [Fraction(entry) for entry in model["a"]]
        n = len(a)
        F = zeros(n, n)
        for i in range(n):
            F[i][0] = a[i]
            if i + 1 < n:
                F[i][i + 1] += 1
        return F, 0, []
    if kind == "monotone_equation":
        n = len(model["a"])
        F = zeros(n, n + 1)
        for i in range(n):
            F[i][i] = Fraction(1)
        return F, 1, []
    if kind == "state_affine":
        p, n = len(model["y"]), len(model["G"]) - 1
        F = zeros(n * p, n * p + p)
        for i in range(n * p):
            F[i][i] = Fraction(1)
        box = []
        for i, _ in model["window"]:
            offset, scale = Fraction(model["u_offset"][i]), Fraction(model["u_scale"][i])
            low, high = (Fraction(end) for end in model["u_range"][i])
            box.append(((low - offset) / scale, (high - offset) / scale))
        return F, p, box
    if kind == "cell_network":
        m, n = len(model["maps"]), len(model["start"])
        return [[Fraction(model["next"][i][k]) for k in range(m + n)] for i in range(n)], m, []
    M, n1, n2, _, g = cascade(model)
    F = zeros(n1 + n2, M + n1 + n2)
    a1, a2 = padded(model["a1"], n1), padded(model["a2"], n2)
    for k in range(n1):
        F[0][M + k] = a1[k]
        if k:
            F[k][M + k - 1] = Fraction(1)
    for i in range(n2):
        F[n1 + i][M + n1] += a2[i]
        if i + 1 < n2:
            F[n1 + i][M + n1 + i + 1] += 1
        for j in range(M):
            F[n1 + i][j] = g[j][i]
    return F, M, []


def padded(values: list[float], size: int) -> list[Fraction]:
    return [Fraction(values[i]) if i < len(values) else Fraction(0) for i in range(size)]


def cascade(model: Json) -> tuple[int, int, int, Rows, Rows]:
    """Phases, n₁, n₂, C_j and g_j."""
    b1, b2 = model["b1"], model["b2"]
    n1 = max(len(model["a1"]), len(b1[0]) - 1)
    n2 = max(len(model["a2"]), len(b2[0]) - 1)
    C: Rows = []
    g: Rows = []
    for rows, a, n, found in ((b1, model["a1"], n1, C), (b2, model["a2"], n2, g)):
        own = padded(a, n)
        for row in rows:
            rest = padded(row[1:], n)
            found.append([Fraction(row[0]) * own[k] + rest[k] for k in range(n)])
    return len(b1), n1, n2, C, g


def slopes(model: Json) -> tuple[Fraction, Fraction]:
    c = [Fraction(entry) for entry in model["f"]["coefficients"]]
    found = [(c[k + 1] - c[k]) / Fraction(model["f"]["spacing"]) for k in range(len(c) - 1)]
    return min(found), max(found)


def value_at(model: Json, w: list[Fraction]) -> Rows:
    """[G_0 … G_n](w) of a state-affine model, term by term."""
    p = len(model["y"])
    E = zeros(p, p * len(model["G"]))
    for k, G in enumerate(model["G"]):
        for powers, block in zip(G["exponents"], G["coefficients"], strict=True):
            weight = Fraction(1)
            for power, entry in zip(powers, w, strict=True):
                weight *= entry**power
            for a, b in product(range(p), range(p)):
                E[a][k * p + b] += weight * Fraction(block[a][b])
    return E


def bernstein(model: Json, box: list[tuple[Fraction, Fraction]]) -> list[Rows]:
    """The Bernstein coefficients of [G_0 … G_n] on the box."""
    degrees = [
        max(powers[j] for G in model["G"] for powers in G["exponents"]) for j in range(len(box))
    ]
    return interpolated(lambda w: value_at(model, w), degrees, box)


def interpolated(
    function: Callable[[list[Fraction]], Rows],
    degrees: list[int],
    box: list[tuple[Fraction, Fraction]],
) -> list[Rows]:
    """Bernstein coefficients of a matrix polynomial, from its values at equally spaced points."""
    values = {}
    for index in product(*(range(d + 1) for d in degrees)):
        w = [
            low + (high - low) * Fraction(k, d) if d else low
            for k, d, (low, high) in zip(index, degrees, box, strict=True)
        ]
        values[index] = function(w)
    for axis, d in enumerate(degrees):
        matrix = [
            [
                Fraction(comb(d, k)) * Fraction(i, d or 1) ** k * Fraction(d - i, d or 1) ** (d - k)
                for k in range(d + 1)
            ]
            for i in range(d + 1)
        ]  # values at the points = matrix times coefficients
        identity = [[Fraction(int(i == j)) for j in range(d + 1)] for i in range(d + 1)]
        inverse = solved(matrix, identity)
        moved = {}
        for index in values:
            total = None
            for i in range(d + 1):
                other = values[(*index[:axis], i, *index[axis + 1 :])]
                part = [[inverse[index[axis]][i] * entry for entry in row] for row in other]
                total = part if total is None else added(total, part)
            assert total is not None
            moved[index] = total
        values = moved
    return list(values.values())


def added(A: Rows, B: Rows) -> Rows:
    return [[a + b for a, b in zip(x, y, strict=True)] for x, y in zip(A, B, strict=True)]


def vertices(model: Json, box: list[tuple[Fraction, Fraction]]) -> list[Rows] | None:
    """The E_i, or None where the model is refused."""
    kind = model["kind"]
    if kind == "state_affine":
        return bernstein(model, box)
    if kind == "monotone_equation":
        e1, e2, e3 = (Fraction(entry) for entry in model["e"])
        if e3 < 0 or (e3 == 0 and e2 != 0):
            return None
        least = e1 - e2 * e2 / (3 * e3) if e3 else e1
        return [[[least] + [-Fraction(entry) for entry in model["a"]]]]
    if kind == "cell_network":
        return network_vertices(model)
    M, n1, n2, C, _ = cascade(model)
    found = []
    for s in product(slopes(model), repeat=M):
        E = zeros(M, M + n1 + n2)
        for j in range(M):
            E[j][j] = Fraction(1)
            for k in range(n1):
                E[j][M + k] = -s[j] * C[j][k]
        found.append(E)
    return found


def network_vertices(model: Json) -> list[Rows] | None:
    """[I 0] - diag(σ) into at every corner of the slopes; None where a map uses a later one."""
    m, n = len(model["maps"]), len(model["start"])
    ends = []
    for f in model["maps"]:
        knots, values = ([Fraction(v) for v in f[key]] for key in ("knots", "values"))
        if len(knots) < 2 or any(knots[k] >= knots[k + 1] for k in range(len(knots) - 1)):
            return None
        found = [
            (values[k + 1] - values[k]) / (knots[k + 1] - knots[k]) for k in range(len(knots) - 1)
        ]
        ends.append((min(found), max(found)))
    if any(model["into"][j][k] != 0 for j in range(m) for k in range(j, m)):
        return None
    matrices = []
    for s in product(*ends):
        E = zeros(m, m + n)
        for j in range(m):
            E[j][j] = Fraction(1)
            for k in range(m + n):
                E[j][k] -= s[j] * Fraction(model["into"][j][k])
        matrices.append(E)
    return matrices


def gap(F: Rows, m: int, P: Rows, rate: Fraction, N: Rows | None, E: Rows | None) -> Rows:
    """diag(0, rate² P) - F'PF + N E + E'N'."""
    n = len(F)
    M = zeros(m + n, m + n)
    for i in range(m + n):
        for j in range(m + n):
            total = sum(
                (F[a][i] * P[a][b] * F[b][j] for a in range(n) for b in range(n)), Fraction(0)
            )
            M[i][j] = -total
            if i >= m and j >= m:
                M[i][j] += rate**2 * P[i - m][j - m]
            if N is not None and E is not None:
                for k in range(m):
                    M[i][j] += N[i][k] * E[k][j] + E[k][i] * N[j][k]
    return M


def is_proved(model: Json, claim: Json, proof: Json) -> bool:
    """Whether (D) and its conditions hold."""
    F, m, box = increments(model)
    rate = Fraction(claim["rate"])
    P = [[Fraction(entry) for entry in row] for row in proof["P"]]
    if not 0 < rate < 1 or not is_definite(P):
        return False
    if m == 0:
        return "multipliers" not in proof and is_definite(gap(F, 0, P, rate, None, None))

    def holds(tree: Json, box: list[tuple[Fraction, Fraction]]) -> bool:
        if "split" in tree:
            i = tree["split"]
            low, high = box[i]
            middle = (low + high) / 2
            halves = [(low, middle), (middle, high)]
            return all(
                holds(part, [*box[:i], half, *box[i + 1 :]])
                for part, half in zip(tree["parts"], halves, strict=True)
            )
        N = [[Fraction(entry) for entry in row] for row in tree["N"]]
        has_ray = model["kind"] == "monotone_equation" and Fraction(model["e"][2]) > 0
        if has_ray and (N[0][0] < 0 or any(row[0] != 0 for row in N[1:])):
            return False
        assert set(tree) == {"N"}
        found = vertices(model, box)
        return found is not None and all(is_definite(gap(F, m, P, rate, N, E)) for E in found)

    return holds(proof["multipliers"], box)


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether a proof document about these files proves its claim."""
    try:
        claim = document["claim"]
        model = about[claim["about"]["model"]["file"]]
        return is_proved(model, claim, document["proof"])
    except (ArithmeticError, AssertionError, LookupError, StopIteration, TypeError, ValueError):
        return False
