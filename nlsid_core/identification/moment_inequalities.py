"""The two inequalities of the moment RIE as matrices, affine in the unknowns.

Unknowns: P (storage function, n × n), c (equation error ε = c'Λ, that is e = c[:D], f from -c[D:]),
R, and for D = 3 six numbers τ that say how a monomial is split over Gram entries.
With Δ = x - x̃, d = v - y, s = v + ṽ or the measured y:
    (3.8)  2d(e(v) - e(ṽ) + c_x'Δ) + |Δ|²_P - |[d; SΔ]|²_P - δ|Δ|²      = z₈'G₈z₈ + ½ c₃ d⁴,
    (3.9)  |Λ|²_R - Δ_1² + |Δ|²_P - |[d; SΔ]|²_P + 2d(e(v) - f(x, w))  = z₉'G₉z₉,
    z₈ = [Δ, d, sd] (the d⁴ stands alone by sign symmetry), z₉ = [Λ, Δ, d, yd, d²].
Source: thesis (3.8), (3.9) with V = |x₁ - x₂|²_P, Q = e₁e₁' and Lemmas 2.10, 2.16.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core._types import FloatArray, IntArray

SPLITS = 6  # τ: of y d, y²d, y³d, d², y d², y²d²


@dataclass(frozen=True, eq=False)
class AffineMatrix:
    """svec(G(x)) = slope x + constant for unknowns x, G of this order."""

    order: int
    slope: sp.csr_matrix
    constant: FloatArray

    def at(self, x: FloatArray) -> FloatArray:
        """G(x)."""
        return conic.smat(self.slope @ x + self.constant)

    def scaled(self, rows: FloatArray, columns: FloatArray) -> "AffineMatrix":
        """diag(rows) G(columns·x) diag(rows)."""
        i, j = conic.triangle(self.order)
        factor = rows[i] * rows[j]
        slope = sp.diags(factor) @ self.slope @ sp.diags(columns)
        return AffineMatrix(self.order, sp.csr_matrix(slope), factor * self.constant)


@dataclass(frozen=True)
class Layout:
    """Where the unknowns are: lags n, window entries m, degree D of e."""

    lags: int
    window: int
    degree: int

    @property
    def monomials(self) -> int:
        """The length of Λ."""
        return self.degree + 1 + self.lags + self.window

    @cached_property
    def P(self) -> IntArray:
        """(n, n) column of each entry of P."""
        return _symmetric(0, self.lags)

    @cached_property
    def c(self) -> IntArray:
        """(length of Λ,) columns of the equation error's coefficients."""
        start = self.lags * (self.lags + 1) // 2
        return start + np.arange(self.monomials)

    @cached_property
    def R(self) -> IntArray:
        """(length of Λ, same) column of each entry of R."""
        return _symmetric(int(self.c[-1]) + 1, self.monomials)

    @property
    def unknowns(self) -> int:
        """How many columns there are."""
        return int(np.max(self.R)) + 1 + (SPLITS if self.degree == 3 else 0)

    @property
    def past(self) -> IntArray:
        """Columns of c that multiply y(t-1) … y(t-n)."""
        return self.c[self.degree + 1 : self.degree + 1 + self.lags]

    def stability(self, delta: float) -> AffineMatrix:
        """G₈."""
        n, d, sd = self.lags, self.lags, self.lags + 1
        G = _Entries(n + 1 if self.degree == 1 else n + 2)
        self._storage(G, 0, d)
        for k in range(n):
            G.add(k, k, None, -delta)
            G.add(k, d, self.past[k], 1.0)
        G.add(d, d, self.c[0], 2.0)
        if self.degree == 3:
            G.add(d, sd, self.c[1], 1.0)
            G.add(sd, sd, self.c[2], 1.5)
        return G.matrix(self.unknowns)

    def error_bound(self) -> AffineMatrix:
        """G₉."""
        n, L, D = self.lags, self.monomials, self.degree
        d, yd, dd = L + n, L + n + 1, L + n + 2
        G = _Entries(L + n + 1 if D == 1 else L + n + 3)
        for i in range(L):
            for j in range(i, L):
                G.add(i, j, self.R[i, j], 1.0)
            G.add(i, d, self.c[i], 1.0)
        self._storage(G, L, d)
        G.add(L, L, None, -1.0)
        for k in range(n):
            G.add(L + k, d, self.past[k], 1.0)
        G.add(d, d, self.c[0], 2.0)
        if D == 3:
            second, third = self.c[1], self.c[2]
            G.add(d, yd, second, 2.0)
            G.add(d, dd, second, 1.0)
            G.add(yd, yd, third, 6.0)
            G.add(yd, dd, third, 3.0)
            G.add(dd, dd, third, 2.0)
            y, y2, y3, one = range(4)
            tau = self.unknowns - SPLITS
            # The same monomial twice: what one entry gives, the other takes.
            for k, (plus, minus, weight) in enumerate(
                (
                    ((one, yd), (y, d), 1.0),
                    ((y, yd), (y2, d), 1.0),
                    ((y2, yd), (y3, d), 1.0),
                    ((one, dd), (d, d), 2.0),
                    ((y, dd), (d, yd), 1.0),
                    ((y2, dd), (yd, yd), 2.0),
                )
            ):
                G.add(*plus, tau + k, 1.0)
                G.add(*minus, tau + k, -weight)
        return G.matrix(self.unknowns)

    def _storage(self, G: "_Entries", start: int, d: int) -> None:
        """|Δ|²_P - |[d; Δ_1 … Δ_{n-1}]|²_P, Δ from index `start` on."""
        place = [d, *range(start, start + self.lags - 1)]
        for k in range(self.lags):
            for j in range(k, self.lags):
                G.add(start + k, start + j, self.P[k, j], 1.0)
                G.add(place[k], place[j], self.P[k, j], -1.0)


class _Entries:
    """Collects G[i, j] += value · x[column] (None: a constant), symmetric."""

    def __init__(self, order: int) -> None:
        self.order = order
        self._rows: list[int] = []
        self._columns: list[int] = []
        self._values: list[float] = []
        self._constant = np.zeros(order * (order + 1) // 2)

    def add(self, i: int, j: int, column: int | None, value: float) -> None:
        low, high = min(i, j), max(i, j)
        row = high * (high + 1) // 2 + low
        value = value if i == j else value * conic.SQRT2
        if column is None:
            self._constant[row] += value
        else:
            self._rows.append(row)
            self._columns.append(int(column))
            self._values.append(value)

    def matrix(self, unknowns: int) -> AffineMatrix:
        shape = (len(self._constant), unknowns)
        slope = sp.csr_matrix((self._values, (self._rows, self._columns)), shape)
        return AffineMatrix(self.order, slope, self._constant)


def _symmetric(start: int, size: int) -> IntArray:
    """(size, size) column numbers of a symmetric matrix of unknowns."""
    table = np.zeros((size, size), dtype=np.int64)
    upper = np.triu_indices(size)
    table[upper] = start + np.arange(len(upper[0]))
    return np.maximum(table, table.T)
