"""Claim `tube` decided a second time, written from docs/certificate_tube.md alone, in Fractions.

Of the increment form, what docs/certificate_stability.md states comes from that page's oracle.
"""

import random
from collections.abc import Iterator, Mapping
from fractions import Fraction
from itertools import product
from typing import Any

from nlsid_core import files
from tests.core.kernel.oracle_stability import (
    Json,
    Rows,
    cascade,
    increments,
    interpolated,
    is_definite,
    vertices,
    zeros,
)

Box = list[tuple[Fraction, Fraction]]


def matrix(values: list[list[float]], rows: int, columns: int) -> Rows:
    found = [[Fraction(entry) for entry in row] for row in values]
    if len(found) != rows or any(len(row) != columns for row in found):
        raise ValueError("shape")
    return found


def outputs(model: Json, m: int, n: int) -> Rows:
    """H."""
    kind = model["kind"]
    if kind == "difference_equation":
        return [[Fraction(int(j == 0)) for j in range(n)]]
    if kind == "block_cascade":
        M, n1, n2, _, _ = cascade(model)
        row = [Fraction(b[0]) for b in model["b2"]] + [Fraction(0)] * n
        if n2:
            row[M + n1] = Fraction(1)
        return [row]
    if kind == "cell_network":
        return [[Fraction(entry) for entry in row[: m + n]] for row in model["output"]]
    scales = model.get("y_scale", [1.0] * m)
    if kind == "monotone_equation" or kind == "implicit":
        scales = [1.0] * m
    return [
        [Fraction(scales[j]) if i == j else Fraction(0) for i in range(m + n)] for j in range(m)
    ]


class Implicit:
    """The increment form of an implicit model."""

    def __init__(self, model: Json) -> None:
        self.p = len(model["h"]["coefficients"][0])
        self.n, self.q = len(model["states"]), len(model["inputs"])
        assert len(model["y"]) == self.p
        assert self.n % self.p == 0
        assert len(model["window"]) == self.q
        self.terms = [
            (tuple(e), [Fraction(c) for c in row])
            for e, row in zip(model["h"]["exponents"], model["h"]["coefficients"], strict=True)
        ]
        self.model = model

    def F(self) -> Rows:
        p, n = self.p, self.n
        F = zeros(n, p + n)
        for i in range(p):
            F[i][i] = Fraction(1)
        if "shift" in self.model:
            shift = self.model["shift"]
            for e, row in zip(shift["exponents"], shift["coefficients"], strict=True):
                for k, c in enumerate(row):
                    if c and any(e[:n]):
                        assert sum(e) == 1
                        F[p + k][p + e.index(1)] += Fraction(c)
        return F

    def slope(self, z: list[Fraction]) -> Rows:
        """∂h/∂(v, x) at z = (v, x, w)."""
        size = self.p + self.n
        E = zeros(self.p, size)
        for e, row in self.terms:
            for j in range(size):
                if e[j]:
                    value = Fraction(e[j])
                    for k, power in enumerate(e):
                        value *= z[k] ** (power - int(k == j))
                    for i in range(self.p):
                        E[i][j] += value * row[i]
        return E

    @property
    def known(self) -> list[tuple[tuple[int, ...], list[Fraction]]]:
        """The terms that depend on v or x."""
        return [(e, row) for e, row in self.terms if any(e[: self.p + self.n]) and any(row)]

    def everywhere(self) -> tuple[Rows, bool] | None:
        """E and whether there is a ray, of a model that needs no box."""
        size = self.p + self.n
        if all(sum(e) == 1 for e, _ in self.known):
            return self.slope([Fraction(0)] * (size + self.q)), False
        if self.p != 1:
            return None
        cubic = [Fraction(0)] * 4
        for e, (c,) in self.known:
            pure = sum(e) == e[0]
            if not (sum(e) == 1 or (pure and e[0] <= 3)):
                return None
            if pure:
                cubic[e[0]] += c
        if cubic[3] <= 0:
            return None
        E = self.slope([Fraction(0)] * (size + self.q))
        E[0][0] = cubic[1] - cubic[2] ** 2 / (3 * cubic[3])
        return E, True

    def box(self, given: Json) -> Box:
        y = [(Fraction(low), Fraction(high)) for low, high in given["y"]]
        u = [(Fraction(low), Fraction(high)) for low, high in given["u"]]
        assert len(y) == self.p
        assert len(u) == len(self.model["u"])
        assert all(low < high for low, high in [*y, *u])
        return [*y, *y * (self.n // self.p), *(u[i] for i, _ in self.model["window"])]

    def hull(self, box: Box) -> list[Rows]:
        size = self.p + self.n
        degrees = [0] * (size + self.q)
        for e, row in self.terms:
            for j in range(size):
                if e[j] and any(row):
                    for k, power in enumerate(e):
                        degrees[k] = max(degrees[k], power - int(k == j))
        return interpolated(self.slope, degrees, box)


def form(model: Json, given: Json | None) -> tuple[Rows, int, Box, bool, Any]:
    """F, m, the box, whether there is a ray, and the E_i of a part of the box."""
    if model["kind"] != "implicit":
        assert given is None
        F, m, box = increments(model)

        def hull(part: Box) -> list[Rows]:
            found = vertices(model, part)
            assert found is not None
            return found

        ray = model["kind"] == "monotone_equation" and Fraction(model["e"][2]) > 0
        return F, m, box, ray, hull
    implicit = Implicit(model)
    found = implicit.everywhere()
    if found is not None:
        assert given is None
        E, ray = found
        return implicit.F(), implicit.p, [], ray, lambda _: [E]
    assert given is not None
    return implicit.F(), implicit.p, implicit.box(given), False, implicit.hull


def quadratic(rows: Rows, P: Rows) -> Rows:
    """rows'P rows."""
    size, n = len(rows[0]), len(rows)
    PF = [
        [sum((P[a][b] * rows[b][j] for b in range(n)), Fraction(0)) for j in range(size)]
        for a in range(n)
    ]
    return [
        [sum((rows[a][i] * PF[a][j] for a in range(n)), Fraction(0)) for j in range(size)]
        for i in range(size)
    ]


def direct(tube: Json, j: int) -> tuple[Fraction, Fraction]:
    """c_j and the peak of e_j."""
    if "direct" not in tube:
        return Fraction(0), Fraction(0)
    peaks = tube["peak"]["at_most"]
    assert set(tube["peak"]) == {"at_most", "measured"}
    assert len(tube["direct"]) == len(peaks) == len(tube["tau"])
    return Fraction(tube["direct"][j]), Fraction(peaks[j])


def holds(
    rows: tuple[Rows, Rows], m: int, tube: Json, tree: Json | None, shape: Any, kept: int
) -> bool:
    """(D) and every (O_j) for (F, H); the first `kept` entries of the box are not split."""
    (F, H), (box, ray, hull) = rows, shape
    n, p = len(F), len(H)
    size, rho = m + n + p, Fraction(tube["rho"])
    P, R = matrix(tube["P"], n, n), matrix(tube["R"], p, p)
    L, tau = matrix(tube["L"], n, p), [Fraction(t) for t in tube["tau"]]
    if not (is_definite(P) and is_definite(R) and len(tau) == p and min(tau) > 0):
        return False
    supply = zeros(size, size)
    for i, j in product(range(n), range(n)):
        supply[m + i][m + j] = rho * P[i][j]
    for i, j in product(range(p), range(p)):
        supply[m + n + i][m + n + j] = R[i][j]
    moved = quadratic([F[i] + L[i] for i in range(n)], P)
    forms = [
        [[a - b for a, b in zip(x, y, strict=True)] for x, y in zip(supply, moved, strict=True)]
    ]
    for j in range(p):
        h = H[j] + [(1 - direct(tube, j)[0]) * int(i == j) for i in range(p)]
        forms.append(
            [[supply[a][b] - tau[j] * h[a] * h[b] for b in range(size)] for a in range(size)]
        )
    if m == 0:
        return tree is None and all(is_definite(M) for M in forms)
    assert tree is not None

    def proved(tree: Json, box: Box) -> bool:
        if "split" in tree:
            assert set(tree) == {"split", "parts"}
            i = tree["split"]
            if i < kept:
                return False
            low, high = box[i]
            halves = [(low, (low + high) / 2), ((low + high) / 2, high)]
            return all(
                proved(part, [*box[:i], half, *box[i + 1 :]])
                for part, half in zip(tree["parts"], halves, strict=True)
            )
        Ns = [matrix(N, size, m) for N in tree["N"]]
        if len(Ns) != p + 1:
            return False
        if ray and any(N[0][0] < 0 or any(row[0] != 0 for row in N[1:]) for N in Ns):
            return False
        assert set(tree) == {"N"}
        for E, (M, N) in product(hull(box), zip(forms, Ns, strict=True)):
            cross, whole = zeros(size, size), zeros(size, size)
            for i, j in product(range(size), range(m + n)):
                cross[i][j] = sum((N[i][k] * E[k][j] for k in range(m)), Fraction(0))
            whole = [
                [M[i][j] + cross[i][j] + cross[j][i] for j in range(size)] for i in range(size)
            ]
            if not is_definite(whole):
                return False
        return True

    return proved(tree, box)


def follows(level: Json, model: Json, rows: int) -> bool:
    """Whether a level by commands is one: its terms make sense and no weight is negative."""
    inputs = 1 if isinstance(model["u"], dict) else len(model["u"])
    if set(level) != {"terms", "weights"} or not 1 <= len(level["terms"]) <= 200:
        return False
    for term in level["terms"]:
        if set(term) != {"inputs", "of", "centre", "scale", "fading"}:
            return False
        factors = term["inputs"]
        if len(factors) > 4 or any(type(i) is not int or not 0 <= i < inputs for i in factors):
            return False
        if term["of"] not in ("value", "change") or Fraction(term["scale"]) <= 0:
            return False
        Fraction(term["centre"])
        if not 0 <= Fraction(term["fading"]) < 1:
            return False
    weights = matrix(level["weights"], rows, len(level["terms"]))
    return all(min(row) >= 0 and sum(row) > 0 for row in weights)


def closed(model: Json, policy: Json, kappa: Fraction) -> tuple[Rows, Rows]:
    """F - κBK and H - κDK of a difference equation."""
    a, b = ([Fraction(entry) for entry in model[key]] for key in "ab")
    K, n = [Fraction(entry) for entry in policy["K"][0]], len(a)
    A = [[a[i] if j == 0 else Fraction(int(j == i + 1)) for j in range(n)] for i in range(n)]
    B = [b[i + 1] + a[i] * b[0] for i in range(n)]
    F = [[A[i][j] - kappa * B[i] * K[j] for j in range(n)] for i in range(n)]
    return F, [[Fraction(int(j == 0)) - kappa * b[0] * K[j] for j in range(n)]]


def is_a_plan(model: Json, policy: Json, funnel: Json) -> bool:
    """What has to hold of a policy beside the inequalities."""
    low, high = (Fraction(end) for end in model["u_range"])
    n, u = len(model["a"]), [Fraction(entry) for (entry,) in policy["u"]]
    return (
        model["kind"] == "difference_equation"
        and len(policy["start"]) == n == len(policy["K"][0])
        and Fraction(policy["period"]) == Fraction(model["period"])
        and 1 <= len(u) <= 10**6
        and all(low <= entry <= high for entry in u)
        and all(tube["L"] == policy["L"] for tube in funnel["tubes"])
    )


def is_proved(model: Json, funnel: Json, proof: Json, policy: Json | None = None) -> bool:
    """Whether every obligation holds, for the contents of the files and of the proof."""
    F, m, box, ray, hull = form(model, funnel.get("box"))
    modes = [(F, outputs(model, m, len(F)))]
    if policy is not None:
        if {"response", "cusum"} & set(funnel) or any("follows" in t for t in funnel["tubes"]):
            return False
        if not is_a_plan(model, policy, funnel):
            return False
        modes.append(closed(model, policy, Fraction(1)))
    trees = proof.get("multipliers", [None] * len(funnel["tubes"]))
    if not 1 <= len(trees) == len(funnel["tubes"]) <= 8 or ("multipliers" in proof) != (m > 0):
        return False
    for tube, tree in zip(funnel["tubes"], trees, strict=True):
        given, rho = tube["assumption"], Fraction(tube["rho"])
        level, inlet = Fraction(tube["level"]), Fraction(tube["inlet"])
        if not 0 < rho <= 1 or (given["kind"] == "energy") != (rho == 1):
            return False
        if inlet < 0 or level < 0:
            return False
        if "follows" in tube and not (
            given["kind"] == "fading" and inlet == 0 and follows(tube["follows"], model, 1)
        ):
            return False
        kept = m + len(F) if model["kind"] == "implicit" and m > 1 and box else 0
        if not all(holds(rows, m, tube, tree, (box, ray, hull), kept) for rows in modes):
            return False
        for j, (tau, width) in enumerate(zip(tube["tau"], tube["half_widths"], strict=True)):
            c, peak = direct(tube, j)
            if not 0 <= c <= 1 or peak < 0 or (c and ("follows" in tube or policy)):
                return False
            left = Fraction(width) - c * peak
            if not (width > 0 and left > 0) or level + rho * inlet > Fraction(tau) * left**2:
                return False
    return True


def V(P: Rows, x: list[Fraction]) -> Fraction:
    n = range(len(P))
    return sum((x[i] * P[i][j] * x[j] for i in n for j in n), Fraction(0))


def runs(
    model: Json, policy: Json, tube: Json, rng: random.Random, samples: int
) -> Iterator[tuple[Fraction, Fraction]]:
    """(o, E) of an exact run with random start in the inlet, innovations, and κ at every sample.

    It lasts `samples`, no more than those of an energy.
    """
    P, rho = matrix(tube["P"], len(tube["P"]), len(tube["P"])), Fraction(tube["rho"])
    n, R = len(P), Fraction(tube["R"][0][0])
    inlet, level = Fraction(tube["inlet"]), Fraction(tube["level"])
    L = [Fraction(entry[0]) for entry in policy["L"]]
    x = [Fraction(rng.randrange(-8, 9)) for _ in range(n)]
    while inlet and V(P, x) > inlet:
        x = [entry / 2 for entry in x]
    if not inlet:
        x = [Fraction(0)] * n
    E = Fraction(0)
    for _ in range(samples):
        e = Fraction(rng.randrange(-8, 9), 4)
        for _ in range(60):
            if rho * E + R * e * e > level:
                e /= 2
        if rho * E + R * e * e > level:
            e = Fraction(0)
        E = rho * E + R * e * e
        F, (output,) = closed(model, policy, Fraction(rng.randrange(5), 4))
        yield sum((h * entry for h, entry in zip(output, x, strict=True)), e), E
        x = [sum((F[i][j] * x[j] for j in range(n)), L[i] * e) for i in range(n)]
        x = [entry.limit_denominator(10**12) for entry in x]


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether a proof document about these files proves its claim, with or without a policy."""
    try:
        bindings = document["claim"]["about"]
        model, funnel = (about[bindings[role]["file"]] for role in ("model", "funnel"))
        policy = about[bindings["policy"]["file"]] if "policy" in bindings else None
        if funnel["model"] != files.digest(model) or ("policy" in funnel) != (policy is not None):
            return False
        if policy is not None and (
            policy["model"] != funnel["model"] or funnel["policy"] != files.digest(policy)
        ):
            return False
        return is_proved(model, funnel, document["proof"], policy)
    except (ArithmeticError, AssertionError, LookupError, TypeError, ValueError):
        return False
