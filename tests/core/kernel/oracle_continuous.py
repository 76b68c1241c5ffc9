"""What docs/certificate_continuous_funnel.md says that a piece claims, in Fractions, at points.

Written from that page alone; shares no code with the kernel, the prover or the search.
"""

from fractions import Fraction
from itertools import product
from math import comb
from typing import Any

Document = dict[str, Any]


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


def squares(basis: list[list[int]], columns: list[int], node: Document, s: Fraction,
            x: list[Fraction]) -> Fraction:  # fmt: skip
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


class Oracle:
    """c(s, x̄) of the pieces of one proof about three documents."""

    def __init__(
        self, field: Document, policy: Document, funnel: Document, proof: Document,
        claim: Document | None = None,
    ):  # fmt: skip
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

    def pushing(self) -> list[int]:
        """The entries of w that are alone in every monomial that they are in."""
        rows = [r for span in self.field["pieces"] for e in span for r in e["exponents"]]
        first = 1 + self.n + self.m
        return [j for j in range(len(self.field["uncertain"]))
                if all(sum(row) == 1 for row in rows if row[first + j])]  # fmt: skip

    def rate_corners(self) -> list[tuple[Fraction, ...]]:
        """w at the vertices of rates: what pushes only is in the middle."""
        box, pushing = numbers(self.field["uncertain"]), self.pushing()
        return list(
            product(*(((a + b) / 2,) if j in pushing else (a, b) for j, (a, b) in enumerate(box)))
        )

    def rate_vertices(self) -> int:
        """How many vertices a rate is proved at."""
        return len(self.rate_corners()) * len(self.sides())

    def rate_left(self, piece: Document, sigma: Fraction, e: list[Fraction]) -> Fraction:
        """h R ∓ dũ_i/ds - τ_0 (ρ - W) - Σ τ_l q_l, with what w pushes taken off R."""
        k, n, i = piece["interval"], self.n, piece["input"]
        s = (piece["index"] + sigma) / Fraction(2) ** piece["level"]
        t0, t1 = (Fraction(self.funnel["t"][j]) for j in (k, k + 1))
        h, corners = t1 - t0, self.rate_corners()
        x0, u0, K = (numbers(part[k]) for part in (self.funnel["x"], self.policy["u"],
                                                   self.policy["K"]))  # fmt: skip
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
            taken.append((high - wanted[j]) * (wanted[j] - low) if mode == 0
                         else low - wanted[j] if mode < 0 else wanted[j] - high)  # fmt: skip
        applied = add(applied, self.push(k, piece["vertex"], len(corners)))
        w = list(corners[piece["vertex"] % len(corners)])
        f = self.rate(k, (1 - s) * t0 + s * t1, add(nominal, e), applied, w)
        gains = [bernstein([gain[i][a] for gain in K], s) for a in range(n)]
        turning = [slope([gain[i][a] for gain in K], s) for a in range(n)]
        away = [h * a - b for a, b in zip(f, motion, strict=True)]
        change = slope([p[i] for p in u0], s) - dot(turning, e) - dot(gains, away)
        room = Fraction(self.proof["rates"][k][i])
        for j in self.pushing():
            low, high = numbers(self.field["uncertain"][j])
            unit = [Fraction(int(a == j)) for a in range(len(w))]
            still = self.rate(k, t0, nominal, wanted, [Fraction(0)] * len(w))
            g = [a - b for a, b in zip(self.rate(k, t0, nominal, wanted, unit), still, strict=True)]
            room -= (high - low) / 2 * max(abs(dot(gain[i], g)) for gain in K)
        P0, P1 = (numbers(self.funnel["P"][j]) for j in (k, k + 1))
        Pe = [dot([(1 - s) * a + s * b for a, b in zip(*rows, strict=True)], e)
              for rows in zip(P0, P1, strict=True)]  # fmt: skip
        rho0, rho1 = (Fraction(self.funnel["rho"][j]) for j in (k, k + 1))
        left: Fraction = h * room - piece["sign"] * change
        for q, tau in zip([(1 - s) * rho0 + s * rho1 - dot(e, Pe), *taken], piece["tau"],
                          strict=True):  # fmt: skip
            left -= q * squares(self.proof["sides"], tau["columns"], tau["squares"], sigma, e)
        return left

    def span(self, k: int) -> int:
        """Which equations interval k obeys."""
        start = Fraction(self.funnel["t"][k])
        return sum(1 for t in self.field["breaks"] if Fraction(t) <= start)

    def rate(self, k: int, t: Fraction, x: list[Fraction], u: list[Fraction],
             w: list[Fraction]) -> list[Fraction]:  # fmt: skip
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
        pushed = Fraction(0)
        for j, kappa in enumerate(numbers(self.proof["kappa"][k]) if "kappa" in self.proof else []):
            low, high = numbers(self.field["uncertain"][j])
            one = [Fraction(int(i == j)) for i in range(len(w))]
            zero = [Fraction(0)] * len(w)
            still = self.rate(k, t0, nominal, u, zero)
            g = [a - b for a, b in zip(self.rate(k, t0, nominal, u, one), still, strict=True)]
            pushed += h * (high - low) / 2 * (kappa * dot(Pe, g) ** 2 + 1 / kappa)
        margin = Fraction(self.proof["margin"])
        total: Fraction = rho1 - rho0 - growth - margin * h * rho + mu * (rho - W) - held - pushed
        return total


def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    """a'b."""
    return sum((p * q for p, q in zip(a, b, strict=True)), Fraction(0))


def add(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    """a + b."""
    return [p + q for p, q in zip(a, b, strict=True)]
