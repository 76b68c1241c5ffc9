"""An oracle of the polynomial claims, written from docs/certificate*.md alone, in Fractions.

It shares no code with the kernel or with a prover: polynomials are dictionaries from exponents to
Fractions, nothing is packed, rounded or scaled to integers. `left_over` decides the obligation
`positive`; `agrees` decides a whole proof document.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from math import comb
from typing import Any

from tests.core.kernel.oracle_stability import is_definite

Key = tuple[int, ...]


class P:
    """A polynomial in n variables."""

    def __init__(self, n: int, terms: Mapping[Key, Fraction | int] | None = None) -> None:
        self.n = n
        self.terms = {
            k: v if type(v) is Fraction else Fraction(v) for k, v in (terms or {}).items() if v
        }

    @classmethod
    def constant(cls, n: int, value: Fraction | int) -> "P":
        return cls(n, {(0,) * n: Fraction(value)})

    @classmethod
    def variable(cls, n: int, i: int) -> "P":
        return cls(n, {tuple(int(j == i) for j in range(n)): 1})

    def lifted(self, other: "P | Fraction | int") -> "P":
        return other if isinstance(other, P) else P.constant(self.n, other)

    def __add__(self, other: "P | Fraction | int") -> "P":
        total = dict(self.terms)
        for k, v in self.lifted(other).terms.items():
            total[k] = total[k] + v if k in total else v
        return P(self.n, total)

    __radd__ = __add__

    def __sub__(self, other: "P | Fraction | int") -> "P":
        return self + P(self.n, {k: -v for k, v in self.lifted(other).terms.items()})

    def __rsub__(self, other: "P | Fraction | int") -> "P":
        return self.lifted(other) - self

    def __mul__(self, other: "P | Fraction | int") -> "P":
        if not isinstance(other, P):
            return P(self.n, {k: v * other for k, v in self.terms.items()})
        total: dict[Key, Fraction] = {}
        for a, x in self.terms.items():
            for b, y in other.terms.items():
                k = tuple(i + j for i, j in zip(a, b, strict=True))
                total[k] = total[k] + x * y if k in total else x * y
        return P(self.n, total)

    __rmul__ = __mul__

    def __truediv__(self, other: Fraction | int) -> "P":
        return self * (Fraction(1) / other)

    def __pow__(self, power: int) -> "P":
        total = self if power else P.constant(self.n, 1)
        for _ in range(power - 1):
            total = total * self
        return total

    def __call__(self, point: Sequence[Fraction]) -> Fraction:
        total = Fraction(0)
        for k, v in self.terms.items():
            for x, power in zip(point, k, strict=True):
                v *= x**power
            total += v
        return total


def stated(document: Any) -> list[tuple[Key, Fraction]]:
    """The terms of a polynomial of a file."""
    rows = zip(document["exponents"], document["coefficients"], strict=True)
    return [(tuple(e), Fraction(c)) for e, c in rows]


def put(terms: Sequence[tuple[Key, Fraction]], values: Sequence[P]) -> P:
    """With a polynomial in the place of each variable."""
    n = values[0].n
    total = P(n)
    for exponents, c in terms:
        product = P.constant(n, c)
        for value, power in zip(values, exponents, strict=True):
            for _ in range(power):
                product = product * value
        total = total + product
    return total


def slope(terms: Sequence[tuple[Key, Fraction]], j: int) -> list[tuple[Key, Fraction]]:
    """The derivative in variable j."""
    return [(tuple(e - (i == j) for i, e in enumerate(k)), c * k[j]) for k, c in terms if k[j] > 0]


def dot(a: Sequence[P], b: Sequence[P], n: int) -> P:
    """a'b."""
    total = P(n)
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def squares(witness: Any, n: int) -> list[P]:
    """Σ_i (R_j[i] V v)² / 4^unit, for each factor R_j."""
    part = witness["squares"]
    assert set(part) == {"unit", "factors"}
    result = []
    for factor in part["factors"]:
        total = P(n)
        for row in factor:
            offset = len(witness["basis"]) - len(row)
            line = P(n)
            for k, entry in enumerate(row):
                value = Fraction(entry) * Fraction(2) ** witness["columns"][offset + k]
                line = line + P(n, {tuple(witness["basis"][offset + k]): value})
            total = total + line * line
        result.append(total / 4 ** part["unit"])
    return result


def bernstein(c: Sequence[P], degree: int) -> list[P]:
    """Σ_k c[k] s^k as control points of Bernstein degree `degree`."""
    return [
        sum(
            (c[i] * Fraction(comb(k, i), comb(degree, i)) for i in range(min(k, len(c) - 1) + 1)),
            P(c[0].n),
        )
        for k in range(degree + 1)
    ]


def raised(points: Sequence[P], degree: int) -> list[P]:
    """Bernstein control points written with a higher degree."""
    J = len(points) - 1
    return [
        sum(
            (
                points[j] * Fraction(comb(J, j) * comb(degree - J, k - j), comb(degree, k))
                for j in range(J + 1)
                if 0 <= k - j <= degree - J
            ),
            P(points[0].n),
        )
        for k in range(degree + 1)
    ]


def left_over(c: Sequence[P], witness: Any, stated: int = 0) -> dict[Key, Fraction] | None:
    """What every Bernstein coefficient of r leaves on the diagonal; None if it is not dominant.

    c: coefficients of s^0, s^1, …. stated: the degree in s that c has by its formula. Source:
    docs/certificate.md, "positive".
    """
    n, basis = c[0].n, [tuple(row) for row in witness["basis"]]
    of_squares = squares(witness, n)
    while len(c) > 1 and not c[-1].terms:  # of the degree that c has
        c = c[:-1]
    degree = max(len(c) - 1, len(of_squares) - 1, stated)
    rest = [a - b for a, b in zip(bernstein(c, degree), raised(of_squares, degree), strict=True)]
    size = [Fraction(2) ** column for column in witness["columns"]]
    least: dict[Key, Fraction] = {}
    for r in rest:
        diagonal = [Fraction(0)] * len(basis)
        charges = [Fraction(0)] * len(basis)
        for key, value in r.terms.items():
            home = [i for i, b in enumerate(basis) if tuple(2 * e for e in b) == key]
            if home:
                diagonal[home[0]] += value / size[home[0]] ** 2
                continue
            pairs = [
                (i, j)
                for i, a in enumerate(basis)
                for j, b in enumerate(basis)
                if i < j and tuple(x + y for x, y in zip(a, b, strict=True)) == key
            ]
            if not pairs:
                return None
            i, j = max(pairs, key=lambda p: size[p[0]] * size[p[1]])  # the first of the largest
            charge = abs(value) / (2 * size[i] * size[j])
            charges[i] += charge
            charges[j] += charge
        for i, b in enumerate(basis):
            room = diagonal[i] - charges[i]
            if room < 0:
                return None
            room *= size[i] ** 2
            least[b] = min(least.get(b, room), room)
    return least


def on_domain(c: P, domain: Sequence[P], witness: Any) -> dict[Key, Fraction] | None:
    """`left_over` of c - Σ σ_k domain[k]."""
    for multiplier in witness.get("multipliers", []):
        c = c - squares(multiplier, c.n)[0] * domain[multiplier["of"]]
    return left_over([c], witness)


def stable_inequalities(claim: Any, proof: Any, model: Any) -> dict[str, tuple[P, list[P]]]:
    """Each inequality and its domain. Source: docs/certificate_stable_set.md."""
    nx, nw = len(model["states"]), len(model["inputs"])
    nv = len(model["h"]["coefficients"][0])
    n = 2 * nv + 2 * nx + nw + 2 * nx + 1
    z = [P.variable(n, i) for i in range(n)]
    v, x, w = z[:nv], z[nv : nv + nx], z[nv + nx : nv + nx + nw]
    y = z[2 * nv + 2 * nx + nw :]

    def stack(name: str, count: int) -> list[list[tuple[Key, Fraction]]]:
        part = model.get(name, {"exponents": [], "coefficients": []})
        return [
            [
                (tuple(e), Fraction(c[i]))
                for e, c in zip(part["exponents"], part["coefficients"], strict=True)
            ]
            for i in range(count)
        ]

    def along(p: Any, at: list[P], direction: list[P]) -> P:
        return dot([put(slope(p, j), at) for j in range(len(direction))], direction, n)

    def inside(values: list[P], which: Sequence[int]) -> list[P]:
        if "box" not in claim:
            return []
        ends = [[Fraction(e) for e in claim["box"][i]] for i in which]
        return [
            (a - P.constant(n, low)) * (P.constant(n, high) - a)
            for a, (low, high) in zip(values, ends, strict=True)
        ]

    h, shift = stack("h", nv), stack("shift", nx - nv)
    known, here, m = [*x, *w], [*v, *x, *w], Fraction(model["monotonicity"])
    domain = inside(known, range(nx + nw))
    yv, delta = y[:nv], Fraction(claim["delta"])
    H = [along(p, here, yv) for p in h]
    found = {"monotone": ((dot(yv, H, n) - dot(yv, yv, n) * m) * 2, domain)}
    if claim["set"] == "2.11":
        M = [[stated(entry) for entry in row] for row in proof["M"]]

        def form(at: list[P], d: list[P]) -> P:
            return dot(d, [dot([put(e, at) for e in row], d, n) for row in M], n)

        nu, d = y[:nv], y[nv : nv + nx]
        x_after = [*v, *(put(p, known) for p in shift)]
        d_after = [*nu, *(along(p, known, d) for p in shift)]
        moved = [along(p, here, [*nu, *d]) for p in h]
        c = dot(nu, moved, n) * 2 + form(x, d) - dot(d, d, n) * delta - form(x_after, d_after)
        found["stable"] = (c, domain + inside(v, range(nv)))
        found["storage"] = (form(x, y[:nx]), [])
        return found
    e = [[(k[:nx], c) for k, c in p if any(k[:nx])] for p in h]
    f = [[(k[nx:], -c) for k, c in p if not any(k[:nx])] for p in h]
    P_ = [[Fraction(entry) for entry in row] for row in proof.get("P", [])]

    def energy(d: list[P]) -> P:
        return dot(d, [sum((b * a for a, b in zip(row, d, strict=True)), P(n)) for row in P_], n)

    d, ys = y[:nx], y[nx : 2 * nx]
    risen = dot(d, [along(p, x, d) for p in e], n)
    turned = dot(ys, [along(p, known, d) for p in f], n) * 2
    lost = dot(d, d, n) * delta
    if claim["set"] == "2.13":
        c = risen * 2 - energy(d) - lost + turned + energy(ys)
    else:
        c = risen - lost + turned + dot(ys, [along(p, x, ys) for p in e], n)
    found["stable"] = (c, domain)
    return found


def agrees(document: Any, files: Mapping[str, Any]) -> bool:
    """True if every obligation of the proof holds, by this file's arithmetic."""
    claim, proof = document["claim"], document["proof"]
    model = files[claim["about"]["model"]["file"]]
    return _side_conditions(claim, proof, model) and all(
        on_domain(c, domain, proof["inequalities"][name]) is not None
        for name, (c, domain) in stable_inequalities(claim, proof, model).items()
    )


def _side_conditions(claim: Any, proof: Any, model: Any) -> bool:
    """δ and m positive, a box that is not empty, and a storage that is one."""
    kind, n = claim["set"], len(model["states"])
    if min(Fraction(model["monotonicity"]), Fraction(claim["delta"])) <= 0:
        return False
    if any(not low < high for low, high in claim.get("box", [])):
        return False
    if kind == "2.11":
        M = [[dict(stated(entry)) for entry in row] for row in proof["M"]]
        flat = all(not any(k) for row in M for entry in row for k, c in entry.items() if c)
        symmetric = all(M[i][j] == M[j][i] for i in range(n) for j in range(n))
        return symmetric and (flat or "box" not in claim)
    if kind == "2.13":
        return is_definite([[Fraction(entry) for entry in row] for row in proof["P"]])
    h, size = model["h"], len(model["h"]["exponents"][0])
    linear = {tuple(row): c for row, c in zip(h["exponents"], h["coefficients"], strict=True)}
    units = [tuple(int(i == j) for i in range(size)) for j in range(n)]
    E = [linear.get(unit, [0] * n) for unit in units]
    return bool(kind == "2.19") and all(E[i][j] == E[j][i] for i in range(n) for j in range(i))
