"""The V-step: multipliers fixed, one semidefinite program improves P(t) over a window of knots.

At each end of each interval, in the coordinates z in which the present funnel is |z| ≤ 1, a new
P_κ = T⁻ᵀ(I + D)T⁻¹ changes c(z) = -Ẇ + μ(1 - W) linearly in D; c - margin = v'Qv with Q ⪰ 0.
Source: thesis (6.8); the linearised-volume objective needs the trust region.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.design.continuous.graded import monomials_of, positions, product_table

MAX_DEGREE = 3  # of the dynamics
DEGREE = MAX_DEGREE + 1  # of c in z


@dataclass(frozen=True, eq=False)
class Sample:
    """One end of one interval: knot κ, the interval's other knot, 1/h, error y = T⁻¹(f - ẋ₀) and μ.

    y: (n, M₃) in monomials of degree 0..3, mu: (M₂,) of degree 0..2. to_other: (n, n), z of the
    other knot from z here. sign: +1 at the start of the interval, -1 at its end.
    """

    knot: int
    other: int
    rate: float
    sign: int
    y: FloatArray
    mu: FloatArray
    to_other: FloatArray


@dataclass(frozen=True, eq=False)
class Affine:
    """c = constant + own·D_own + others·D_other over monomials, D by its upper triangle."""

    constant: FloatArray
    own: FloatArray
    others: FloatArray
    mu: FloatArray


def affine_form(sample: Sample) -> Affine:
    """How c depends on the two matrices D at this sample."""
    n = len(sample.y)
    pairs = list(zip(*np.triu_indices(n), strict=True))
    sizes = [len(monomials_of(n, q)) for q in range(DEGREE + 1)]
    starts = np.cumsum([0, *sizes])
    own = np.zeros((starts[-1], len(pairs)))
    others = np.zeros_like(own)
    second = product_table(n, 1, 1)

    def put(column: FloatArray, tables: list[IntArray], poly: FloatArray, factor: float) -> None:
        """column += factor·monomial·poly; tables: where the monomial takes each degree of poly."""
        at = 0
        for q, table in enumerate(tables):
            column[table] += factor * poly[at : at + sizes[q]]
            at += sizes[q]

    variables = [[starts[q + 1] + product_table(n, 1, q)[p] for q in range(4)] for p in range(n)]
    for column, (p, q) in enumerate(pairs):
        twice = 1.0 if p == q else 2.0
        # -2 z'Dy: z_p y_q + z_q y_p for p < q, z_p y_p on the diagonal.
        put(own[:, column], variables[p], sample.y[q], -2.0)
        if p != q:
            put(own[:, column], variables[q], sample.y[p], -2.0)
        square = int(second[p, q])
        own[starts[2] + square, column] += sample.sign * sample.rate * twice
        quadratic = [starts[r + 2] + product_table(n, 2, r)[square] for r in range(3)]
        put(own[:, column], quadratic, sample.mu, -twice)
        a = sample.to_other
        product = (np.outer(a[p], a[q]) + np.outer(a[q], a[p])) * (twice / 2)
        values = np.bincount(second.ravel(), product.ravel(), sizes[2])
        others[starts[2] : starts[3], column] = -sample.sign * sample.rate * values
    diagonal = np.array([float(p == q) for p, q in pairs])
    constant = own @ diagonal + others @ diagonal
    constant[: starts[3]] += sample.mu
    return Affine(constant, own, others, sample.mu)


def gram_columns(basis: IntArray) -> tuple[sp.csc_matrix, int]:
    """Monomial coefficients of v'Qv from svec(Q), and how long that is."""
    n = basis.shape[1]
    i, j = conic.triangle(len(basis))
    rows = np.concatenate([monomials_of(n, q) for q in range(DEGREE + 1)])
    home = positions(basis[i] + basis[j], rows)
    weight = np.where(i == j, 1.0, conic.SQRT2)
    shape = (len(rows), len(i))
    return sp.csc_matrix((weight, (home, np.arange(len(i)))), shape=shape), len(i)


def improve(
    samples: list[Affine],
    knots: list[tuple[int, int]],
    free: int,
    basis: IntArray,
    *,
    weights: FloatArray,
    margins: list[float],
    trust: float,
    reference: FloatArray | None = None,
) -> FloatArray:
    """D (free, n, n) for the free knots 0..free-1; D = 0 for knots beyond.

    samples and knots: c at each sample, and (own, other) knot. margins: what c keeps
    above zero at each sample, in 1/s. weights: (free,) of each knot's volume.
    reference: (free, n, n) matrices of the reference ellipsoids in the knots' coordinates: then the
    objective is Σ weights·r with I + D ⪯ r·reference; else the linearised volume. trust: of |D|.
    """
    n, k = basis.shape[1], len(basis)
    d = n * (n + 1) // 2
    gram, triangle = gram_columns(basis)
    rows = gram.shape[0]
    extra = free if reference is not None else 0
    left, right = [], []
    for sample, (own, other), margin in zip(samples, knots, margins, strict=True):
        block = sp.lil_matrix((rows, free * d + extra))
        if own < free:
            block[:, own * d : (own + 1) * d] = sample.own
        if other < free:
            block[:, other * d : (other + 1) * d] = sample.others
        left.append(-block.tocsc())
        target = sample.constant.copy()
        target[0] -= margin
        right.append(target)
    count = len(samples)
    A = [sp.hstack([sp.vstack(left), sp.kron(sp.eye(count), gram)], format="csc")]
    b = [np.concatenate(right)]
    cones = [Cone("zero", count * rows)]
    size = free * d + extra + count * triangle
    # Gram matrices: s = svec(Q) ⪰ 0.
    A.append(
        sp.hstack([sp.csc_matrix((count * triangle, free * d + extra)), -sp.eye(count * triangle)])
    )
    b.append(np.zeros(count * triangle))
    cones += [Cone("psd", k)] * count
    a, c = conic.triangle(n)
    upper = {pair: m for m, pair in enumerate(zip(*np.triu_indices(n), strict=True))}
    to_svec = sp.lil_matrix((d, d))
    for row, (p, q) in enumerate(zip(a.tolist(), c.tolist(), strict=True)):
        to_svec[row, upper[min(p, q), max(p, q)]] = 1.0 if p == q else conic.SQRT2
    identity = conic.svec(np.eye(n))
    for f in range(free):
        place = sp.lil_matrix((d, size))
        place[:, f * d : (f + 1) * d] = to_svec
        for sign in (1.0, -1.0):
            A.append(sp.csc_matrix(sign * place))
            b.append(trust * identity)
            cones.append(Cone("psd", n))
        if reference is not None:
            scaled = place.copy()
            scaled[:, free * d + f] = -conic.svec(reference[f])[:, None]
            A.append(sp.csc_matrix(scaled))
            b.append(-identity)
            cones.append(Cone("psd", n))
    q_vector = np.zeros(size)
    if reference is None:
        diagonal = np.array([float(p == q) for p, q in zip(*np.triu_indices(n), strict=True)])
        for f in range(free):
            q_vector[f * d : (f + 1) * d] = weights[f] * diagonal
    else:
        q_vector[free * d : free * d + free] = weights
    program = ConeProgram(sp.csc_matrix((size, size)), q_vector, sp.vstack(A, format="csc"),
                          np.concatenate(b), tuple(cones))  # fmt: skip
    x = conic.solve(program, tolerance=1e-6).x
    result = np.zeros((free, n, n))
    p, q = np.triu_indices(n)
    for f in range(free):
        result[f, p, q] = result[f, q, p] = x[f * d : (f + 1) * d]
    return result
