"""The V-step: multipliers fixed, one semidefinite program improves P(t) over a window of knots.

At each end of each interval, in the coordinates z in which the present funnel is |z| ≤ 1, a new
P_κ = T⁻ᵀ(I + D)T⁻¹ changes c(z) = -Ẇ + μ(1 - W) linearly in D; c - margin = v'Qv with Q ⪰ 0.
`vstep_program` solves what that makes.
Source: thesis (6.8); the linearised-volume objective needs the trust region.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design.continuous.graded import monomials_of, product_table
from nlsid_core.design.continuous.vstep_program import ShapeProgram
from nlsid_core.polynomial.values import monomial_values
from nlsid_core.sos.sphere import unisolvent_points

MAX_DEGREE = 3  # of the dynamics
DEGREE = MAX_DEGREE + 1  # of c in z


@dataclass(frozen=True, eq=False)
class Sample:
    """One end of one interval: knot κ, the other knot, 1/h and the error y = T⁻¹(f - ẋ₀).

    y: (n, M₃) in monomials of degree 0..3. to_other: (n, n), z of the other knot from z here.
    sign: +1 at the start of the interval, -1 at its end.
    """

    knot: int
    other: int
    rate: float
    sign: int
    y: FloatArray
    to_other: FloatArray


@dataclass(frozen=True, eq=False)
class Affine:
    """c = constant + own·D_own + others·D_other over monomials, D by its upper triangle.

    knots: the own and the other one. mu: (M₂,) of the multiplier in monomials of degree 0..2.
    """

    knots: tuple[int, int]
    constant: FloatArray
    own: FloatArray
    others: FloatArray
    mu: FloatArray

    def with_multiplier(self, mu: FloatArray, n: int) -> "Affine":
        """c + μ(1 - W) in n variables."""
        tables = _tables(n)
        own, constant = self.own.copy(), self.constant.copy()
        own[tables.quadratic, range(own.shape[1])] -= tables.twice * mu[:, None]
        constant += (own - self.own) @ tables.diagonal
        constant[: len(mu)] += mu
        return Affine(self.knots, constant, own, self.others, self.mu + mu)


@dataclass(frozen=True, eq=False)
class _Tables:
    """Where products land: linear (n, M₃) and quadratic (M₂, d) times the others' monomials."""

    p: IntArray
    q: IntArray
    square: IntArray  # (d,) the monomial z_p z_q
    twice: FloatArray  # (d,) 1 on the diagonal of D, 2 off it
    diagonal: FloatArray
    linear: IntArray
    quadratic: IntArray


@lru_cache(maxsize=8)
def _tables(n: int) -> _Tables:
    starts = np.cumsum([0, *(len(monomials_of(n, q)) for q in range(DEGREE + 1))])
    p, q = np.triu_indices(n)
    pairs = product_table(n, 1, 1)[p, q]
    linear = [starts[r + 1] + product_table(n, 1, r) for r in range(MAX_DEGREE + 1)]
    quadratic = [starts[r + 2] + product_table(n, 2, r)[pairs] for r in range(DEGREE - 1)]
    on = p == q
    return _Tables(
        p,
        q,
        starts[2] + pairs,
        np.where(on, 1.0, 2.0),
        on.astype(float),
        np.hstack(linear),
        np.hstack(quadratic).T,
    )


def affine_form(sample: Sample) -> Affine:
    """How -Ẇ depends on the two matrices D at this sample."""
    n = len(sample.y)
    tables = _tables(n)
    p, q, twice = tables.p, tables.q, tables.twice
    columns = np.arange(len(p))
    own = np.zeros((int(tables.quadratic.max()) + 1, len(p)))
    others = np.zeros_like(own)
    # -2 z'Dy: z_p y_q + z_q y_p off the diagonal, z_p y_p on it.
    own[tables.linear[p].T, columns] -= 2 * sample.y[q].T
    own[tables.linear[q].T, columns] -= (twice - 1) * 2 * sample.y[p].T
    own[tables.square, columns] += sample.sign * sample.rate * twice
    a = sample.to_other
    product = a[p][:, p] * a[q][:, q] + a[p][:, q] * a[q][:, p]  # (D, monomials)
    product *= twice[:, None] / 2 * twice
    others[tables.square] = -sample.sign * sample.rate * product.T
    none = np.zeros(len(tables.quadratic))
    knots = sample.knot, sample.other
    return Affine(knots, (own + others) @ tables.diagonal, own, others, none)


def squares_along(along: FloatArray, scale: FloatArray) -> FloatArray:
    """(M₄, d): what D adds at first order to Σ_j scale_j (z'(I + D)g_j)², along: (n, J) the g_j."""
    n = len(along)
    tables = _tables(n)
    result = np.zeros((int(tables.quadratic.max()) + 1, len(tables.p)))
    outer: FloatArray = 2 * (along * scale) @ along.T  # z'g z'Dg, twice
    for a, b in ((tables.p, tables.q), (tables.q, tables.p)):
        for column, (i, j) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
            np.add.at(
                result[:, column], tables.linear[i, 1 : n + 1], outer[j] * tables.twice[column] / 2
            )
    return result


def improve(
    samples: list[Affine],
    basis: IntArray,
    *,
    weights: FloatArray,
    trust: float,
    bounds: Sequence[FloatArray] = (),
) -> FloatArray:
    """D (free, n, n) for the free knots 0..free-1 with c ≥ 0 at each sample; D = 0 beyond.

    basis: (k, n) exponents of v. weights: (free,) of each knot's volume. bounds: per free knot
    (R, n) rows r: |r'z| ≤ 1 in the set, I + D ⪰ rr'. trust: of |D|; the linearised volume is what
    is enlarged.
    Raises SolverError if it ends at no point with c ≥ 0.
    """
    free = len(weights)
    n, d = basis.shape[1], samples[0].own.shape[1]
    p, q = np.triu_indices(n)
    units = np.zeros((d, n, n))
    units[range(d), p, q] = units[range(d), q, p] = 1.0
    # F (free, L, 1 + unknowns, n, n): trust·I ± D, and I + D - rr'.
    rows = [np.concatenate([trust * np.eye(n)[None], sign * units]) for sign in (1.0, -1.0)]
    F = np.repeat(np.array(rows)[None], free, axis=0)
    most = max((len(r) for r in bounds), default=0)
    inside = np.tile(np.concatenate([np.eye(n)[None], units]), (free, most, 1, 1, 1))
    for place, directions in zip(inside, bounds, strict=False):
        place[: len(directions), 0] -= directions[:, :, None] * directions[:, None]
    F = np.concatenate([F, inside], axis=1)
    cost = np.tile(np.trace(units, axis1=1, axis2=2), (free, 1))
    x = np.zeros((free, d))
    V, table = _at_points(basis.tobytes(), n)
    places = np.array([s.knots for s in samples])
    g = np.array([s.constant for s in samples]) @ table.T
    size = np.abs(g).max(axis=1)
    B = np.zeros((len(samples), 2, x.shape[1], len(table)))
    first = places.min(axis=1)
    for row, sample in enumerate(samples):
        for knot, part in zip(places[row], (sample.own, sample.others), strict=True):
            if knot < free:
                B[row, knot - first[row], :d] = (table @ part).T / size[row]
    program = ShapeProgram(V, g / size[:, None], B, first, F, weights[:, None] * cost)
    found = program.solve(x)
    D = np.zeros((free, n, n))
    D[:, p, q] = D[:, q, p] = found[:, :d]
    return D


@lru_cache(maxsize=8)
def _at_points(basis: bytes, n: int) -> tuple[FloatArray, FloatArray]:
    """(N, k) orthonormal combinations of the basis at N points, and (N, M) all monomials of degree
    0..4 there. Each is made homogeneous by one more variable, so that the points are on a sphere.
    """

    def filled(powers: IntArray, degree: int) -> IntArray:
        return np.column_stack([degree - powers.sum(axis=1), powers])

    squared = filled(np.frombuffer(basis, dtype=np.int64).reshape(-1, n), DEGREE // 2)
    points = unisolvent_points(squared)
    V = np.linalg.qr(monomial_values(squared, points))[0] * np.sqrt(len(points))
    powers = np.concatenate([monomials_of(n, q) for q in range(DEGREE + 1)])
    return V, monomial_values(filled(powers, DEGREE), points)
