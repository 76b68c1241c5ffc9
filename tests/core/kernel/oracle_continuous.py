"""Claim `continuous_funnel` decided a second time, in Fractions.

Written from docs/certificate_continuous_funnel.md alone; shares no code with the kernel, the prover
or the search. What a piece claims is evaluated at points, or at the variables themselves (`P`),
which leaves the polynomial: `agrees` decides all that the page asks, with nothing left out.
"""

import json
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise, product, zip_longest
from math import comb
from typing import Any

from nlsid_core import files
from tests.core.kernel.oracle_polynomial import P, left_over
from tests.core.kernel.oracle_stability import is_definite, solved

Document = dict[str, Any]
Rows = list[list[Fraction]]


def numbers(nested: Any) -> Any:
    """Nested lists of JSON numbers or texts p/q, exactly."""
    return [numbers(entry) for entry in nested] if isinstance(nested, list) else Fraction(nested)


def bernstein(points: list[Fraction], s: Fraction) -> Fraction:
    """Σ_i C(d, i) s^i (1 - s)^(d - i) points[i]."""
    d = len(points) - 1
    return sum(
        (comb(d, i) * s**i * (1 - s) ** (d - i) * p for i, p in enumerate(points)), Fraction(0)
    )


def slope(points: list[Fraction], s: Fraction) -> Fraction:
    """Its derivative in s, from the product rule."""
    d, total = len(points) - 1, Fraction(0)
    for i, p in enumerate(points):
        up = i * s ** (i - 1) * (1 - s) ** (d - i) if i else Fraction(0)
        down = (d - i) * s**i * (1 - s) ** (d - i - 1) if i < d else Fraction(0)
        total += comb(d, i) * (up - down) * p
    return total


def power(row: list[int], values: list[Fraction]) -> Fraction:
    """A monomial at a point."""
    result = Fraction(1)
    for e, value in zip(row, values, strict=True):
        result *= value**e
    return result


def squares(
    basis: list[list[int]], columns: list[int], node: Document, s: Fraction, x: list[Fraction]
) -> Fraction:
    """Σ_j B_j(s) |R_j V v|² / 4^unit, V = diag 2^columns; a row may leave out leading zeros."""
    v = [power(row, x) * Fraction(2) ** c for row, c in zip(basis, columns, strict=True)]
    points = []
    for factor in node["factors"]:
        total = Fraction(0)
        for row in factor:
            entries = [0] * (len(v) - len(row)) + [int(e) for e in row]
            total += sum((e * a for e, a in zip(entries, v, strict=True)), Fraction(0)) ** 2
        points.append(total / Fraction(4) ** node["unit"])
    return bernstein(points, s)


class Degree:
    """The degree that a formula states: of a sum the largest, of a product the sum."""

    def __init__(self, degree: int) -> None:
        self.degree = degree

    def __add__(self, other: Any) -> "Degree":
        return Degree(max(self.degree, degree_of(other)))

    __radd__ = __sub__ = __rsub__ = __add__

    def __mul__(self, other: Any) -> "Degree":
        return Degree(self.degree + degree_of(other))

    __rmul__ = __mul__

    def __truediv__(self, _: Fraction) -> "Degree":
        return self

    def __pow__(self, power: int) -> "Degree":
        return Degree(self.degree * power)


def degree_of(value: Any) -> int:
    """Of a formula, or 0 of a number."""
    return value.degree if isinstance(value, Degree) else 0


class Oracle:
    """c(s, x̄) of the pieces of one proof about three documents."""

    def __init__(
        self,
        field: Document,
        policy: Document,
        funnel: Document,
        proof: Document,
        claim: Document | None = None,
    ):
        self.field, self.policy, self.funnel, self.proof = field, policy, funnel, proof
        self.claim = claim or {}
        self.n, self.m = field["states"], field["inputs"]

    def vertex(self, number: int) -> list[Fraction]:
        """The corner of w's box; its centre with kappa."""
        box = numbers(self.field["uncertain"])
        if "kappa" in self.proof:
            return [(low + high) / 2 for low, high in box]
        corners = list(product(*box))
        return [Fraction(e) for e in corners[number % len(corners)]]

    def sides(self) -> list[tuple[int, ...]]:
        """The signs of the corners of what the input is off by."""
        moved = "hold" in self.claim or any(self.claim.get("error", []))
        return list(product((-1, 1), repeat=self.m)) if moved else [()]

    def push(self, k: int, number: int, vertices: int) -> list[Fraction]:
        """What the input is off by at a vertex, `vertices` of them to each corner."""
        side = self.sides()[number // vertices]
        return [e * self.width(k, i) for i, e in enumerate(side)] or [Fraction(0)] * self.m

    def width(self, k: int, i: int) -> Fraction:
        """W_ki: hold times the largest rate, and the largest |Ke|, over what was before."""
        hold = Fraction(self.claim.get("hold", 0))
        times = [Fraction(t) for t in self.funnel["t"]]
        seen = [j for j in range(k + 1) if j == k or times[j + 1] > times[k] - hold]
        rates = self.proof.get("rates")
        fastest = max(Fraction(rates[j][i]) for j in seen) if rates else Fraction(0)
        errors = numbers(self.claim.get("error", [0] * self.n))
        shaken = max(
            sum((abs(g) * e for g, e in zip(gain[i], errors, strict=True)), Fraction(0))
            for j in seen
            for gain in numbers(self.policy["K"][j])
        )
        total: Fraction = hold * fastest + shaken
        return total

    def ranges(self, k: int) -> list[list[Fraction]]:
        """Lows and highs of what the input is off by, if anything, and of w."""
        off = [self.width(k, i) for i in range(self.m)] if self.sides() != [()] else []
        box: list[list[Fraction]] = numbers(self.field["uncertain"])
        return [[-width, width] for width in off] + box

    def pushing(self) -> list[int]:
        """The entries of `ranges` that are alone in every monomial that they are in."""
        rows = [r for span in self.field["pieces"] for e in span for r in e["exponents"]]
        first = 1 + self.n + (self.m if self.sides() == [()] else 0)
        return [
            j
            for j in range(len(self.ranges(0)))
            if all(sum(row) == 1 for row in rows if row[first + j])
        ]

    def rate_corners(self, k: int) -> list[tuple[Fraction, ...]]:
        """The vertices of rates in `ranges`: what pushes only is in the middle."""
        pushing = self.pushing()
        return list(
            product(
                *(
                    ((a + b) / 2,) if j in pushing else (a, b)
                    for j, (a, b) in enumerate(self.ranges(k))
                )
            )
        )

    def rate_vertices(self) -> int:
        """How many vertices a rate is proved at."""
        return len(self.rate_corners(0))

    def rate_left(self, piece: Document, sigma: Fraction, e: list[Fraction]) -> Fraction:
        """h R ∓ dũ_i/ds - τ_0 (ρ - W) - Σ τ_l q_l, with what only pushes taken off R."""
        k, n, i = piece["interval"], self.n, piece["input"]
        s = (piece["index"] + sigma) / Fraction(2) ** piece["level"]
        t0, t1 = (Fraction(self.funnel["t"][j]) for j in (k, k + 1))
        h, ranges = t1 - t0, self.ranges(k)
        x0, u0, K = (
            numbers(part[k]) for part in (self.funnel["x"], self.policy["u"], self.policy["K"])
        )
        nominal = [bernstein([p[j] for p in x0], s) for j in range(n)]
        motion = [slope([p[j] for p in x0], s) for j in range(n)]
        wanted = [
            bernstein([p[j] for p in u0], s)
            - dot([bernstein([gain[j][a] for gain in K], s) for a in range(n)], e)
            for j in range(self.m)
        ]
        applied, taken = list(wanted), []
        for place, (number, low, high) in enumerate(numbers(self.policy["limits"])):
            j, mode = int(number), piece["mode"][place]
            applied[j] = wanted[j] if mode == 0 else low if mode < 0 else high
            taken.append(
                (high - wanted[j]) * (wanted[j] - low)
                if mode == 0
                else low - wanted[j]
                if mode < 0
                else wanted[j] - high
            )
        corner = list(self.rate_corners(k)[piece["vertex"]])
        off = corner[: len(corner) - len(self.field["uncertain"])]
        applied = [u + by for u, by in zip_longest(applied, off, fillvalue=Fraction(0))]
        w = corner[len(off) :]
        f = self.rate(k, (1 - s) * t0 + s * t1, add(nominal, e), applied, w)
        gains = [bernstein([gain[i][a] for gain in K], s) for a in range(n)]
        turning = [slope([gain[i][a] for gain in K], s) for a in range(n)]
        away = [h * a - b for a, b in zip(f, motion, strict=True)]
        change = slope([p[i] for p in u0], s) - dot(turning, e) - dot(gains, away)
        room = Fraction(self.proof["rates"][k][i])
        for j in self.pushing():
            low, high = ranges[j]
            none = [Fraction(0)] * self.n, [Fraction(0)] * self.m, [Fraction(0)] * len(w)
            unit = [
                [Fraction(int(a == j)) for a in range(len(off))],
                [Fraction(int(a == j - len(off))) for a in range(len(w))],
            ]
            there = self.rate(k, t0, none[0], unit[0] or none[1], unit[1])
            g = [a - b for a, b in zip(there, self.rate(k, t0, *none), strict=True)]
            room -= (high - low) / 2 * max(abs(dot(gain[i], g)) for gain in K)
        P0, P1 = (numbers(self.funnel["P"][j]) for j in (k, k + 1))
        Pe = [
            dot([(1 - s) * a + s * b for a, b in zip(*rows, strict=True)], e)
            for rows in zip(P0, P1, strict=True)
        ]
        rho0, rho1 = (Fraction(self.funnel["rho"][j]) for j in (k, k + 1))
        left: Fraction = h * room - piece["sign"] * change
        for q, tau in zip(
            [(1 - s) * rho0 + s * rho1 - dot(e, Pe), *taken], piece["tau"], strict=True
        ):
            left -= q * squares(self.proof["sides"], tau["columns"], tau["squares"], sigma, e)
        return left

    def span(self, k: int) -> int:
        """Which equations interval k obeys."""
        start = Fraction(self.funnel["t"][k])
        return sum(1 for t in self.field["breaks"] if Fraction(t) <= start)

    def rate(
        self, k: int, t: Fraction, x: list[Fraction], u: list[Fraction], w: list[Fraction]
    ) -> list[Fraction]:
        """f(t, x, u, w)."""
        values = [t, *x, *u, *w]
        result = []
        for equation in self.field["pieces"][self.span(k)]:
            terms = zip(equation["exponents"], numbers(equation["coefficients"]), strict=True)
            result.append(sum((c * power(row, values) for row, c in terms), Fraction(0)))
        return result

    def c(self, piece: Document, sigma: Fraction, e: list[Fraction]) -> Fraction:
        """c at sigma in [0, 1] along the piece's part of time and e = x - x₀."""
        k, n = piece["interval"], self.n
        s = (piece["index"] + sigma) / Fraction(2) ** piece["level"]
        t0, t1 = (Fraction(self.funnel["t"][j]) for j in (k, k + 1))
        h = t1 - t0
        x0 = numbers(self.funnel["x"][k])
        nominal = [bernstein([p[i] for p in x0], s) for i in range(n)]
        motion = [slope([p[i] for p in x0], s) for i in range(n)]
        P0, P1 = (numbers(self.funnel["P"][j]) for j in (k, k + 1))
        P = [[(1 - s) * P0[i][j] + s * P1[i][j] for j in range(n)] for i in range(n)]
        bend = [[P1[i][j] - P0[i][j] for j in range(n)] for i in range(n)]
        rho0, rho1 = (Fraction(self.funnel["rho"][j]) for j in (k, k + 1))
        rho = (1 - s) * rho0 + s * rho1
        u0, K = numbers(self.policy["u"][k]), numbers(self.policy["K"][k])
        u = []
        for i in range(self.m):
            gains = [bernstein([gain[i][j] for gain in K], s) for j in range(n)]
            u.append(bernstein([p[i] for p in u0], s) - dot(gains, e))
        held = Fraction(0)
        for place, (number, low, high) in enumerate(numbers(self.policy["limits"])):
            i, mode = int(number), piece["mode"][place]
            wanted = u[i]
            if mode == 0:
                q = (high - wanted) * (wanted - low)
            else:
                q = low - wanted if mode < 0 else wanted - high
                u[i] = low if mode < 0 else high
            tau = piece["tau"][place]
            held += q * squares(self.proof["sides"], tau["columns"], tau["squares"], sigma, e)
        w = self.vertex(piece["vertex"])
        count = 1 if "kappa" in self.proof else 2 ** len(w)
        u = add(u, self.push(k, piece["vertex"], count))
        f = self.rate(k, (1 - s) * t0 + s * t1, add(nominal, e), u, w)
        Pe = [dot(row, e) for row in P]
        W, W_bend = dot(e, Pe), dot(e, [dot(row, e) for row in bend])
        growth = 2 * dot(Pe, [h * a - b for a, b in zip(f, motion, strict=True)]) + W_bend
        mu = Fraction(0)
        lists = (piece["mu"][key] for key in ("shifts", "start", "end"))
        for row, shift, start, end in zip(self.proof["multiplier"], *lists, strict=True):
            mu += Fraction(2) ** shift * (start + (end - start) * sigma) * power(row, e)
        pushed = self.pushed(k, t0, Pe, u, w)
        margin = Fraction(self.proof["margin"])
        total: Fraction = rho1 - rho0 - growth - margin * h * rho + mu * (rho - W) - held - pushed
        return total

    def pushed(
        self, k: int, t0: Fraction, Pe: list[Fraction], u: list[Fraction], w: list[Fraction]
    ) -> Fraction:
        """Σ_j h r_j (κ_j (x̄'Pg_j)² + 1/κ_j), if the proof has kappa."""
        total, h = Fraction(0), Fraction(self.funnel["t"][k + 1]) - t0
        nowhere = [Fraction(0)] * self.n
        for j, kappa in enumerate(numbers(self.proof["kappa"][k]) if "kappa" in self.proof else []):
            low, high = numbers(self.field["uncertain"][j])
            one = [Fraction(int(i == j)) for i in range(len(w))]
            still = self.rate(k, t0, nowhere, u, [Fraction(0)] * len(w))
            g = [a - b for a, b in zip(self.rate(k, t0, nowhere, u, one), still, strict=True)]
            total += h * (high - low) / 2 * (kappa * dot(Pe, g) ** 2 + 1 / kappa)
        return total


def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    """a'b."""
    return sum((p * q for p, q in zip(a, b, strict=True)), Fraction(0))


def add(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    """a + b."""
    return [p + q for p, q in zip(a, b, strict=True)]


def agrees(document: Document, about: Mapping[str, Document]) -> bool:
    """Whether a proof document about these files proves its claim."""
    try:
        named = document["claim"]["about"]
        assert document["claim"]["kind"] == "continuous_funnel"
        assert set(named) == {"vector_field", "policy", "funnel"}
        field, policy, funnel = (
            bound(named[role], about) for role in ("vector_field", "policy", "funnel")
        )
        return is_proved(document["claim"], document["proof"], field, policy, funnel)
    except (ArithmeticError, AssertionError, LookupError, TypeError, ValueError):
        return False


def bound(binding: Document, about: Mapping[str, Document]) -> Document:
    """The document of a binding, whose digest has to be its own."""
    document = about[binding["file"]]
    assert files.digest(document) == binding["digest"]
    return document


def is_proved(
    claim: Document, proof: Document, field: Document, policy: Document, funnel: Document
) -> bool:
    """Every obligation of the page, for the contents of the files."""
    digest = files.digest(field)
    if {policy["vector_field"], funnel["vector_field"]} != {digest}:
        return False
    if funnel["policy"] != files.digest(policy) or funnel["kind"] != "continuous":
        return False
    oracle = Oracle(field, policy, funnel, proof, claim)
    return (
        makes_sense(oracle)
        and is_a_funnel(oracle)
        and (("goal" in claim) == ("goal_multiplier" in proof))
        and ("goal" not in claim or ends_inside(claim["goal"], proof, funnel))
        and all(stays_valid(oracle, k) for k in range(len(funnel["t"]) - 1))
        and is_covered(oracle, proof["pieces"], rates=False)
        and all(holds(oracle, piece, rates=False) for piece in proof["pieces"])
        and ("hold" not in claim or is_followed(oracle))
    )


def makes_sense(oracle: "Oracle") -> bool:
    """What the page says of the members of the three files and of the claim and proof."""
    field, policy, claim, proof = oracle.field, oracle.policy, oracle.claim, oracle.proof
    n, m, w = oracle.n, oracle.m, len(field["uncertain"])
    assert type(n) is type(m) is int
    rows = [row for span in field["pieces"] for e in span for row in e["exponents"]]
    first = 1 + n + m
    limited = [int(row[0]) for row in policy["limits"]]
    alone = all(sum(row) == 1 for row in rows if any(row[first:]))
    affine = all(max(row[1 + n : first], default=0) <= 1 for row in rows)
    return (
        1 <= n <= 16
        and 0 <= m <= 16
        and w <= 32
        and all(low <= high for low, high in numbers(field["uncertain"]))
        and increasing(field["breaks"])
        and len(field["pieces"]) == len(field["breaks"]) + 1
        and all(len(span) == n for span in field["pieces"])
        and all(len(row) == first + w and sum(row) <= 7 for row in rows)
        and all(type(e) is int and e >= 0 for row in rows for e in row)
        and all(max(row[first:], default=0) <= 1 for row in rows)
        and all(
            a < b for span in field["pieces"] for e in span for a, b in pairwise(e["exponents"])
        )
        and all(row[0] in range(n + m) for row in field["valid"])
        and len(limited) <= 3
        and len(set(limited)) == len(limited)
        and all(row[0] in range(m) and row[1] < row[2] for row in policy["limits"])
        and set(claim) <= {"kind", "about", "goal", "hold", "error"}
        and (("kappa" not in proof) or (alone and w > 0))
        and Fraction(proof["margin"]) > 0
        and ("hold" not in claim or claim["hold"] > 0)
        and min(claim.get("error", [0])) >= 0
        and (affine or not {"hold", "error"} & set(claim))
        and min((min(row) for row in proof.get("kappa", [[1]])), default=1) > 0
    )


def increasing(times: list[float]) -> bool:
    """Whether they do."""
    return all(Fraction(a) < Fraction(b) for a, b in pairwise(times))


def is_a_funnel(oracle: "Oracle") -> bool:
    """Knots, one nominal in policy and funnel, continuous; P ≻ 0 and ρ > 0 at every knot."""
    field, policy, funnel, n, m = oracle.field, oracle.policy, oracle.funnel, oracle.n, oracle.m
    t, x = numbers(funnel["t"]), numbers(funnel["x"])
    K = len(t)
    return (
        K >= 2
        and increasing(funnel["t"])
        and numbers(policy["t"]) == t
        and numbers(policy["x"]) == x
        and all(len(curve) == K - 1 for curve in (x, policy["u"], policy["K"]))
        and all(1 <= len(c) <= 4 for curve in (x, policy["u"], policy["K"]) for c in curve)
        and all(len(point) == n for control in x for point in control)
        and all(len(point) == m for control in policy["u"] for point in control)
        and all(len(gain) == m for control in policy["K"] for gain in control)
        and all(len(row) == n for control in policy["K"] for gain in control for row in gain)
        and all(before[-1] == after[0] for before, after in pairwise(x))
        and len(funnel["P"]) == len(funnel["rho"]) == K
        and all(len(shape) == n and is_definite(numbers(shape)) for shape in funnel["P"])
        and min(funnel["rho"]) > 0
        and all(b in t for b in numbers(field["breaks"]) if t[0] < b < t[-1])
    )


def ends_inside(goal: Document, proof: Document, funnel: Document) -> bool:
    """Obligation 3."""
    shape, multiplier = numbers(goal["P"]), Fraction(proof["goal_multiplier"])
    end = ellipsoid(funnel, -1)
    return is_definite(shape) and is_inside(*end, numbers(goal["centre"]), shape, multiplier)


def ellipsoid(funnel: Document, end: int) -> tuple[list[Fraction], Rows, Fraction]:
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


def stays_valid(oracle: "Oracle", k: int) -> bool:
    """Obligation 4 on interval k."""
    policy, funnel, n = oracle.policy, oracle.funnel, oracle.n
    limits = {int(j): (low, high) for j, low, high in numbers(policy["limits"])}
    for number, low, high, *spans in numbers(oracle.field["valid"]):
        if spans and spans[0] not in range(len(oracle.field["pieces"])):
            return False
        if spans and spans[0] != oracle.span(k):
            continue
        j = int(number)
        if j < n:
            middle = [point[j] for point in numbers(funnel["x"][k])]
            rows, off = [[Fraction(int(a == j)) for a in range(n)]], Fraction(0)
        else:
            middle = [point[j - n] for point in numbers(policy["u"][k])]
            rows = [gain[j - n] for gain in numbers(policy["K"][k])]
            off = oracle.width(k, j - n)
        room = [min(middle) - low - off, high - max(middle) - off]
        if j >= n and j - n in limits:
            least, most = limits[j - n]
            if (least < low and low + off > most) or (most > high and least > high - off):
                return False
            room = [
                r for r, kept in zip(room, (least >= low, most <= high), strict=True) if not kept
            ]
        if not room:
            continue
        if min(room) < 0:
            return False
        for knot, g in product((k, k + 1), rows):
            P, rho = numbers(funnel["P"][knot]), Fraction(funnel["rho"][knot])
            form = dot(g, [row[0] for row in solved(P, [[e] for e in g])])
            if rho * form > min(room) ** 2 or (j < n and rho * form == min(room) ** 2):
                return False
    return True


def is_covered(oracle: "Oracle", pieces: list[Document], *, rates: bool) -> bool:
    """Obligation 5, or that part of 8: every case at every time."""
    limited = [int(row[0]) for row in oracle.policy["limits"]]
    modes = list(product((-1, 0, 1), repeat=len(limited)))
    cases: list[tuple[int, ...]] = modes
    if rates:
        vertices = oracle.rate_vertices()
        cases = [
            (i, sign, *mode)
            for i, sign, mode in product(range(oracle.m), (-1, 1), modes)
            if i not in limited or mode[limited.index(i)] == 0
        ]
    else:
        corners = 1 if "kappa" in oracle.proof else 2 ** len(oracle.field["uncertain"])
        vertices = corners * len(oracle.sides())
    needed = set(product(range(len(oracle.funnel["t"]) - 1), range(vertices), cases))
    parts: dict[Any, list[tuple[Fraction, Fraction]]] = {key: [] for key in needed}
    for piece in pieces:
        level, index = piece["level"], piece["index"]
        assert type(level) is type(index) is type(piece["interval"]) is type(piece["vertex"]) is int
        assert 0 <= level <= 16
        assert 0 <= index < 2**level
        case = tuple(piece["mode"]) if limited else ()
        case = (piece["input"], piece["sign"], *case) if rates else case
        length = Fraction(1, 2**level)
        parts[piece["interval"], piece["vertex"], case].append((index * length, length))
    return all(covers(found) for found in parts.values())


def covers(parts: list[tuple[Fraction, Fraction]]) -> bool:
    """Whether parts of time (start, length) leave nothing of [0, 1] out."""
    until = Fraction(0)
    for start, length in sorted(parts):
        until = max(until, start + length) if start <= until else until
    return until >= 1


def is_followed(oracle: "Oracle") -> bool:
    """Obligation 8: u₀ and K are continuous, and no input moves faster than its rate."""
    policy, proof = oracle.policy, oracle.proof
    curves = (numbers(policy["u"]), numbers(policy["K"]))
    return (
        all(before[-1] == after[0] for curve in curves for before, after in pairwise(curve))
        and len(proof["rates"]) == len(oracle.funnel["t"]) - 1
        and all(len(row) == oracle.m and min(row, default=1) > 0 for row in proof["rates"])
        and is_covered(oracle, proof["rate_pieces"], rates=True)
        and all(holds(oracle, piece, rates=True) for piece in proof["rate_pieces"])
    )


def holds(oracle: "Oracle", piece: Document, *, rates: bool) -> bool:
    """Whether a piece is decided by its own witness."""
    without = {
        "pieces",
        "rate_pieces",
        "goal",
        "goal_multiplier",
        "about",
        "vector_field",
        "policy",
    }
    about = [
        {key: part for key, part in document.items() if key not in without}
        for document in (oracle.policy, oracle.funnel, oracle.proof, oracle.claim)
    ]
    field = {key: part for key, part in oracle.field.items() if key not in ("valid", "expansion")}
    about.insert(0, field)
    return _holds(json.dumps(about), json.dumps(piece), rates)


@lru_cache(maxsize=50_000)
def _holds(shared: str, stated: str, rates: bool) -> bool:
    """`holds`, once for the same piece of the same proof about the same files."""
    oracle, piece = Oracle(*json.loads(shared)), json.loads(stated)
    n = oracle.n
    s, *e = (P.variable(1 + n, i) for i in range(1 + n))
    claimed: Callable[[Document, Any, Any], Any] = oracle.rate_left if rates else oracle.c
    by_power: dict[int, P] = {}
    for (power_of_s, *key), value in claimed(piece, s, e).terms.items():
        part = P(n, {tuple(key): value})
        by_power[power_of_s] = by_power.get(power_of_s, P(n)) + part
    c = [by_power.get(i, P(n)) for i in range(max(by_power, default=0) + 1)]
    formal = degree_of(claimed(piece, Degree(1), [Degree(0)] * n))
    witness = {key: piece[key] for key in ("columns", "squares")}
    left = left_over(c, witness | {"basis": oracle.proof["basis"]}, formal)
    return left is not None and left.get((0,) * n, 0) > 0
