"""`SingleStep`: one sample of an implicit model, for a few states at once, with little overhead.

For given (x, w) every equation is a polynomial in v alone, whose coefficients are found for all
states together; then Newton's method runs on plain numbers from the last output on.
"""

import math

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.monotone import NEWTON_STEPS, RESIDUAL
from nlsid_core.polynomial.products import Products

Monomial = list[tuple[int, int]]  # (variable, power) of each variable that occurs


class SingleStep:
    """x⁺ (B, n) of states x (B, n) under one input w (m,); as `ImplicitModel.step` to rounding.

    Where Newton's full steps do not go down, `ImplicitModel.solve` takes over, and raises
    SolverError as it does.
    """

    def __init__(self, model: ImplicitModel) -> None:
        self._model, self._unknowns, n = model, model.unknowns, len(model)
        h, shift, n_v = model.h, model.shift, model.unknowns
        known, places = np.unique(
            np.vstack([h.exponents[:, n_v:], shift.exponents]), axis=0, return_inverse=True
        )
        powers, of = np.unique(h.exponents[:, :n_v], axis=0, return_inverse=True)
        places, of = places.ravel(), of.ravel()
        self._split = len(powers) * n_v
        # The monomials of (x, w) times this: h's coefficients of v's monomials, then ã.
        self._table = np.zeros((len(known), self._split + n - n_v))
        for place, power, values in zip(places[: len(of)], of, h.coefficients, strict=True):
            self._table[place, power * n_v : (power + 1) * n_v] += values
        for place, values in zip(places[len(of) :], shift.coefficients, strict=True):
            self._table[place, self._split :] += values
        self._products, self._size = Products(known), known.shape[1] + 1
        self._monomials: list[Monomial] = [
            [(j, e) for j, e in enumerate(row) if e] for row in powers.tolist()
        ]
        self._degrees = [row[0] for row in powers.tolist()] if n_v == 1 else []

    def __call__(self, x: FloatArray, w: FloatArray) -> FloatArray:
        """The next states (B, n)."""
        n, n_v = x.shape[1], self._unknowns
        known = np.ones((len(x), self._size))
        known[:, :n], known[:, n : self._size - 1] = x, w
        found = self._products(known) @ self._table
        after = np.empty_like(x)
        after[:, n_v:] = found[:, self._split :]
        equations, starts = found[:, : self._split].tolist(), x[:, :n_v].tolist()
        for i, (row, start) in enumerate(zip(equations, starts, strict=True)):
            v = [self._single(row, start[0])] if n_v == 1 else self._several(row, start)
            if not all(map(math.isfinite, v)):
                given = known[i : i + 1, :-1]
                v = self._model.solve(given, start=x[i : i + 1, :n_v])[0].tolist()
            after[i, :n_v] = v
        return after

    def _single(self, row: list[float], v: float) -> float:
        """The root of Σ row_i v^degree_i, or NaN."""
        polynomial = [0.0] * (self._degrees[-1] + 1)  # highest degree first
        for degree, c in zip(self._degrees, row, strict=True):
            polynomial[-1 - degree] = c
        enough, before = RESIDUAL * (1.0 + abs(polynomial[-1])), math.inf
        for _ in range(NEWTON_STEPS):
            value = slope = 0.0
            for c in polynomial:
                slope = slope * v + value
                value = value * v + c
            error = abs(value)
            if error <= enough:
                return v
            if not error < before or slope == 0.0:
                break
            before = error
            v -= value / slope
        return math.nan

    def _several(self, row: list[float], start: list[float]) -> list[float]:
        """The root of the n_v equations, or NaNs."""
        p, v, before = len(start), list(start), math.inf
        constant = row[:p] if not self._monomials[0] else [0.0] * p  # h at v = 0
        enough = RESIDUAL * (1.0 + math.hypot(*constant))
        for _ in range(NEWTON_STEPS):
            values = [0.0] * p
            slopes = [[0.0] * p for _ in range(p)]
            for m, monomial in enumerate(self._monomials):
                c = row[m * p : m * p + p]
                whole = math.prod([v[j] if e == 1 else _power(v[j], e) for j, e in monomial])
                for i in range(p):
                    values[i] += c[i] * whole
                for j, e in monomial:
                    rest = [_power(v[k], d - (k == j)) for k, d in monomial]
                    slope = e * math.prod(rest)
                    for i in range(p):
                        slopes[i][j] += c[i] * slope
            error = math.hypot(*values)
            if error <= enough:
                return v
            steps = _solved(slopes, values) if error < before else None
            if steps is None:
                break
            before = error
            v = [now - step for now, step in zip(v, steps, strict=True)]
        return [math.nan] * p


def _power(value: float, exponent: int) -> float:
    """value**exponent for a whole exponent, infinite where it overflows."""
    result = 1.0
    for _ in range(exponent):
        result *= value
    return result


def _solved(A: list[list[float]], b: list[float]) -> list[float] | None:
    """x with A x = b, by elimination with the largest pivots; None if A is singular.

    A and b are overwritten.
    """
    n = len(b)
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(A[i][k]))
        if not abs(A[pivot][k]) > 0.0:
            return None
        A[k], A[pivot], b[k], b[pivot] = A[pivot], A[k], b[pivot], b[k]
        for i in range(k + 1, n):
            part = A[i][k] / A[k][k]
            if part:
                for j in range(k + 1, n):
                    A[i][j] -= part * A[k][j]
                b[i] -= part * b[k]
    for k in reversed(range(n)):
        b[k] = (b[k] - sum(A[k][j] * b[j] for j in range(k + 1, n))) / A[k][k]
    return b
