"""Claim `hybrid_funnel` decided a second time, written from its page alone, in Fractions.

A stage's own proof is decided by the oracle of docs/certificate_continuous_funnel.md. `worst_jump`
asks the same question of points of the guard, with no multiplier at all.
"""

from collections.abc import Mapping
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np

from nlsid_core.arrays import FloatArray
from tests.core.kernel.oracle_continuous import (
    Degree,
    add,
    bernstein,
    bound,
    covers,
    degree_of,
    dot,
    numbers,
    power,
    squares,
)
from tests.core.kernel.oracle_continuous import agrees as agrees_alone
from tests.core.kernel.oracle_polynomial import P, left_over
from tests.core.kernel.oracle_stability import solved

Json = dict[str, Any]


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether every stage is a funnel, and every jump leads into the next."""
    try:
        return is_one(document, about)
    except (ArithmeticError, AssertionError, LookupError, TypeError, ValueError):
        return False


def is_one(document: Json, about: Mapping[str, Json]) -> bool:
    """What the page asks, of documents that are what they should be."""
    bindings, proofs = document["claim"]["about"], document["proof"]["jumps"]
    assert document["claim"].keys() == {"kind", "about"}
    stages = [role for role in bindings if role.startswith("stage")]
    jumps = [role for role in bindings if role.startswith("jump")]
    count = len(jumps)
    assert set(jumps) == {f"jump{i}" for i in range(1, count + 1)}
    assert set(stages) == {f"stage{i}" for i in range(1, len(stages) + 1)}
    assert len(bindings) == len(stages) + count
    assert len(proofs) == count
    assert 1 <= count <= 50
    assert len(stages) in (count, count + 1)
    found = [bound(bindings[f"stage{i + 1}"], about) for i in range(len(stages))]
    if any("hold" in stage["claim"] or not agrees_alone(stage, about) for stage in found):
        return False
    funnels = [bound(stage["claim"]["about"]["funnel"], about) for stage in found]
    return all(
        Leap(
            bound(bindings[f"jump{i + 1}"], about),
            funnels[i],
            funnels[(i + 1) % len(funnels)],
            proofs[i],
        ).is_proved()
        for i in range(count)
    )


class Leap:
    """One jump, the funnels that it leads from and into, and its proof."""

    def __init__(self, jump: Json, before: Json, after: Json, proof: Json) -> None:
        self.jump, self.before, self.after, self.proof = jump, before, after, proof
        self.n = jump["states"]
        assert (len(before["t"]) - 1) * 2 ** len(jump["uncertain"]) <= 10**6
        self.corners = list(product(*numbers(jump["uncertain"])))

    def is_proved(self) -> bool:
        t = numbers(self.before["t"])
        start = Fraction(self.jump["start"])
        return (
            self.makes_sense()
            and start in t[:-1]
            and self.stays_valid(t.index(start))
            and self.keeps_side("start", t.index(start), 1)
            and self.keeps_side("end", len(t) - 1, -1)
            and self.is_covered(t.index(start))
            and all(map(self.holds, self.proof["pieces"]))
        )

    def makes_sense(self) -> bool:
        """What the page says of the jump's members, and of how its stages' states fit."""
        jump, n, box = self.jump, self.n, numbers(self.jump["uncertain"])
        rows = [row for entry in jump["reset"] for row in entry["exponents"]]
        return (
            jump["format"] == "nlsid/jump"
            and len(jump["reset"]) == len(self.after["x"][0][0])
            and n == len(self.before["x"][0][0])
            and len(box) <= 32
            and all(low <= high for low, high in box)
            and all(len(row) == n + len(box) and sum(row) <= 7 for row in rows)
            and all(max(row[n:], default=0) <= 1 for row in rows)
            and len({tuple(row[n:]) for row in rows}) <= 64
            and all(len(row) == n and sum(row) <= 7 for row in jump["guard"]["exponents"])
            and all(row[0] in range(n) for row in jump["valid"])
        )

    def stays_valid(self, first: int) -> bool:
        """x_j within its bounds on every interval from `first` on."""
        funnel = self.before
        for k in range(first, len(funnel["t"]) - 1):
            for number, low, high in numbers(self.jump["valid"]):
                j = int(number)
                middle = [point[j] for point in numbers(funnel["x"][k])]
                room = min(min(middle) - low, high - max(middle))
                unit = [Fraction(int(a == j)) for a in range(self.n)]
                for knot in (k, k + 1):
                    inverse = solved(numbers(funnel["P"][knot]), [[e] for e in unit])
                    if room < 0 or Fraction(funnel["rho"][knot]) * inverse[j][0] > room**2:
                        return False
        return True

    def keeps_side(self, name: str, knot: int, sign: int) -> bool:
        """Sign g > 0 in the funnel at a knot."""
        stated, funnel, n = self.proof[name], self.before, self.n
        x = numbers(funnel["x"])
        centre = x[knot][0] if knot < len(x) else x[-1][-1]
        shape = numbers(funnel["P"][knot])
        e: list[Any] = [P.variable(n, i) for i in range(n)]
        gap = Fraction(funnel["rho"][knot]) - dot(e, [dot(row, e) for row in shape])
        node = stated["tau"]
        tau = squares(node["basis"], node["columns"], node["squares"], Fraction(0), e)
        left = left_over([sign * self.guard(add(centre, e)) - tau * gap], stated, 0)
        return left is not None and left.get((0,) * n, 0) > 0

    def guard(self, x: list[Any]) -> Any:
        """g(x)."""
        return self.value(self.jump["guard"], x)

    @staticmethod
    def value(entry: Json, z: list[Any]) -> Any:
        """A polynomial of the jump."""
        terms = zip(entry["exponents"], numbers(entry["coefficients"]), strict=True)
        return sum((c * power(row, z) for row, c in terms), Fraction(0))

    def is_covered(self, first: int) -> bool:
        """Pieces cover every interval from `first` on at every vertex, and nothing else."""
        needed = set(product(range(first, len(self.before["t"]) - 1), range(len(self.corners))))
        parts: dict[Any, list[tuple[Fraction, Fraction]]] = {key: [] for key in needed}
        for piece in self.proof["pieces"]:
            level, index = piece["level"], piece["index"]
            assert type(level) is type(index) is int
            assert 0 <= level <= 16
            assert 0 <= index < 2**level
            length = Fraction(1, 2**level)
            parts[piece["interval"], piece["vertex"]].append((index * length, length))
        return all(covers(found) for found in parts.values())

    def c(self, piece: Json, sigma: Any, e: list[Any]) -> Any:
        """ρ_b - |R - b|²_{P_b} - τ (ρ - W) - μ g at sigma along the piece and e = x - x₀."""
        k, n, funnel = piece["interval"], self.n, self.before
        s = (piece["index"] + sigma) / Fraction(2) ** piece["level"]
        points = numbers(funnel["x"][k])
        x = [bernstein([p[i] for p in points], s) + e[i] for i in range(n)]
        ends = [numbers(funnel["P"][j]) for j in (k, k + 1)]
        shape = [[bernstein(list(pair), s) for pair in zip(*rows, strict=True)]
                 for rows in zip(*ends, strict=True)]  # fmt: skip
        rho = bernstein(numbers(funnel["rho"][k : k + 2]), s)
        gap = rho - dot(e, [dot(row, e) for row in shape])
        node = piece["tau"]
        tau = squares(self.proof["sides"], node["columns"], node["squares"], sigma, e)
        mu = Fraction(0)
        lists = (piece["mu"][key] for key in ("shifts", "start", "end"))
        for row, shift, start, end in zip(self.proof["multiplier"], *lists, strict=True):
            mu += Fraction(2) ** shift * (start + (end - start) * sigma) * power(row, e)
        corner = list(self.corners[piece["vertex"]])
        centre, after = numbers(self.after["x"][0][0]), numbers(self.after["P"][0])
        away = [self.value(entry, [*x, *corner]) - b
                for entry, b in zip(self.jump["reset"], centre, strict=True)]  # fmt: skip
        V = dot(away, [dot(row, away) for row in after])
        return Fraction(self.after["rho"][0]) - V - tau * gap - mu * self.guard(x)

    def holds(self, piece: Json) -> bool:
        """Whether a piece is decided by its own witness."""
        n = self.n
        s, *e = (P.variable(1 + n, i) for i in range(1 + n))
        by_power: dict[int, P] = {}
        for (power_of_s, *key), value in self.c(piece, s, e).terms.items():
            part = P(n, {tuple(key): value})
            by_power[power_of_s] = by_power.get(power_of_s, P(n)) + part
        c = [by_power.get(i, P(n)) for i in range(max(by_power, default=0) + 1)]
        formal = degree_of(self.c(piece, Degree(1), [Degree(0)] * n))
        witness = {key: piece[key] for key in ("columns", "squares")}
        left = left_over(c, witness | {"basis": self.proof["basis"]}, formal)
        return left is not None and left.get((0,) * n, 0) > 0


def worst_jump(
    jump: Json, before: Json, after: Json, count: int, rng: np.random.Generator
) -> tuple[float, int]:
    """The largest |R(x, w) - b|²_{P_b}/ρ_b at random x of the funnel on the guard, and how many.

    In floating point, for guards that are affine: points of the ellipsoid at random times, moved
    onto the guard along its gradient, those that stay in it.
    """
    t, n = np.array(before["t"]), jump["states"]
    rows, values = (np.array(jump["guard"][key], dtype=float) for key in
                    ("exponents", "coefficients"))  # fmt: skip
    assert (rows.sum(axis=1) <= 1).all()
    gradient = rows.T @ (values * rows.any(axis=1))
    offset = float(values[~rows.any(axis=1)].sum())
    shape = np.array(after["P"][0]) / after["rho"][0]
    worst, found = 0.0, 0
    for when in rng.uniform(jump["start"], t[-1], count):
        k = min(int(np.searchsorted(t, when, side="right")) - 1, len(t) - 2)
        s = (when - t[k]) / (t[k + 1] - t[k])
        points = np.array(before["x"][k])
        x0 = np.array([float(bernstein(list(map(Fraction, p)), Fraction(s))) for p in points.T])
        P0, P1 = (np.array(before["P"][j]) for j in (k, k + 1))
        W = ((1 - s) * P0 + s * P1) / ((1 - s) * before["rho"][k] + s * before["rho"][k + 1])
        T = np.linalg.inv(np.linalg.cholesky(W)).T
        z = rng.normal(size=(200, n))
        z *= (rng.uniform(size=200) ** (1 / n) / np.linalg.norm(z, axis=1))[:, None]
        x = x0 + z @ T.T
        to = np.linalg.solve(W, gradient)  # the shortest way in the funnel's norm
        x -= np.outer((x @ gradient + offset) / (gradient @ to), to)
        kept = x[np.einsum("ni,ij,nj->n", x - x0, W, x - x0) <= 1]
        found += len(kept)
        for corner in product(*jump["uncertain"]):
            reached = _reset(jump, kept, corner) - np.array(after["x"][0][0])
            V = np.einsum("ni,ij,nj->n", reached, shape, reached)
            worst = max(worst, float(V.max(initial=0.0)))
    return worst, found


def _reset(jump: Json, X: FloatArray, w: tuple[float, ...]) -> FloatArray:
    Z = np.hstack([X, np.broadcast_to(np.array(w, dtype=float), (len(X), len(w)))])
    columns = []
    for entry in jump["reset"]:
        terms = zip(entry["exponents"], entry["coefficients"], strict=True)
        columns.append(sum((float(Fraction(c)) * np.prod(Z ** np.array(row), axis=1)
                            for row, c in terms), np.zeros(len(X))))  # fmt: skip
    return np.stack(columns, axis=1)
