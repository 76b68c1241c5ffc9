"""Exact sums of squares for polynomials with real zeros, where no Gram matrix is positive definite.

At a zero z of p, every Gram matrix satisfies Qv(z) = 0. In the monomial combinations u = N'v that
vanish at all zeros, p = u'Gu usually has a strictly positive definite G; it is found in floating
point, rounded to rationals and corrected, in rationals, to meet the identity exactly.
Source: Peyrl and Parrilo, "Computing sum of squares decompositions with rational coefficients",
Theoretical Computer Science 409 (2008).
"""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.errors import Infeasible
from nlsid_core.kernel import Rejected
from nlsid_core.kernel.exact import semidefinite
from nlsid_core.polynomial import Gram, Polynomial
from nlsid_core.sos.basis import gram_basis

ROUNDING_BITS = (10, 16, 24, 32, 40)  # of G; few first, so that a simple proof stays simple
Rational = list[list[Fraction]]


def exact_gram(
    p: Polynomial,
    *,
    zeros: Sequence[Sequence[Fraction | int]] = (),
    directions: Sequence[Sequence[Fraction | int]] = (),
) -> Gram:
    """A rational Gram matrix Q ⪰ 0 with p = v'Qv exactly.

    p: with its exact coefficients (floats are the rationals they are). zeros: its real zeros, as
    exact numbers; directions: zeros of its leading form (zeros at infinity). Both are needed if
    there are any. Raises Infeasible if p is not a sum of squares, or has
    other zeros.
    """
    p = p.exact()
    basis = gram_basis(p.exponents)
    N = _vanishing(basis, zeros, directions)
    if not N:
        raise Infeasible("no monomial combination of the Gram basis vanishes at all the zeros")
    rhs, rows = _identity_rows(p, basis, N)
    G = _interior_gram(rows, rhs, len(N))
    for bits in ROUNDING_BITS:
        rounded = [
            [Fraction(round(entry * 2**bits), 2**bits) for entry in row] for row in G.tolist()
        ]
        corrected = _corrected(rounded, rows, rhs)
        if corrected is None:
            raise Infeasible(
                "p is not a combination of products of the reduced basis: is a zero wrong?"
            )
        Q = _congruence(corrected, N)
        gram = Gram(basis, np.array(Q, dtype=object), p.names)
        try:
            semidefinite(Q, "the Gram matrix")
        except Rejected:
            continue
        return gram
    raise Infeasible("no rational Gram matrix near the numerical one is positive semidefinite")


def _vanishing(
    basis: IntArray,
    zeros: Sequence[Sequence[Fraction | int]],
    directions: Sequence[Sequence[Fraction | int]],
) -> Rational:
    """Rows n with n'v(z) = 0 at every zero: a rational basis of the null space."""
    values = [[_monomial(row, zero) for row in basis.tolist()] for zero in zeros]
    top = int(np.max(basis.sum(axis=1), initial=0))
    values += [
        [_monomial(row, zero) if sum(row) == top else Fraction(0) for row in basis.tolist()]
        for zero in directions
    ]
    k = len(basis)
    reduced, pivots = _row_reduce(values)
    null = []
    for free in (j for j in range(k) if j not in pivots):
        row = [Fraction(0)] * k
        row[free] = Fraction(1)
        for pivot, equation in zip(pivots, reduced, strict=True):
            row[pivot] = -equation[free]
        null.append(row)
    return null


def _identity_rows(p: Polynomial, basis: IntArray, N: Rational) -> tuple[list[Fraction], Rational]:
    """Right-hand sides, and equations Σ_{a ≤ b} rows[α][ab] G_ab = p_α for every monomial α."""
    names = p.names
    u = [Polynomial(basis, np.array(row, dtype=object), names) for row in N]
    products = [u[a] * u[b] * (1 if a == b else 2) for a, b in _pairs(len(u))]
    exponents = sorted({e for q in [p, *products] for e, _ in q.terms()})
    at = {exponent: k for k, exponent in enumerate(exponents)}
    rows = [[Fraction(0)] * len(products) for _ in exponents]
    for column, q in enumerate(products):
        for exponent, coefficient in q.terms():
            rows[at[exponent]][column] = coefficient
    rhs = [Fraction(0)] * len(exponents)
    for exponent, coefficient in p.terms():
        rhs[at[exponent]] = coefficient
    return rhs, rows


def _interior_gram(rows: Rational, rhs: Sequence[Fraction], size: int) -> FloatArray:
    """A Gram matrix with the largest smallest eigenvalue t, from the cone solver."""
    A = np.array([[float(entry) for entry in row] for row in rows])
    i, j = conic.triangle(size)
    at = {pair: k for k, pair in enumerate(_pairs(size))}
    order = [at[(a, b)] for a, b in zip(i.tolist(), j.tolist(), strict=True)]
    weight = np.where(i == j, 1.0, conic.SQRT2)
    size_of_p = max(abs(float(value)) for value in rhs)
    E = A[:, order] / weight
    trace = E @ conic.svec(np.eye(size))
    top = sp.csc_matrix(np.hstack([trace[:, None], E]))
    bottom = sp.hstack([sp.csc_matrix((len(i), 1)), -sp.eye(len(i))])
    cap = sp.csc_matrix(np.r_[1.0, np.zeros(len(i))][None])
    program = ConeProgram(
        P=sp.csc_matrix((1 + len(i), 1 + len(i))),
        q=np.r_[-1.0, np.zeros(len(i))],
        A=sp.vstack([top, cap, bottom], format="csc"),
        b=np.r_[[float(value) / size_of_p for value in rhs], 1.0, np.zeros(len(i))],
        cones=(Cone("zero", len(rhs)), Cone("nonnegative", 1), Cone("psd", size)),
    )
    x = conic.solve(program).x
    if x[0] <= 0:
        raise Infeasible(
            f"no positive definite Gram matrix on the reduced basis (smallest eigenvalue "
            f"{x[0]:.1e}): p is not a sum of squares, or has zeros that were not given"
        )
    return np.asarray(size_of_p * (conic.smat(x[1:]) + x[0] * np.eye(size)))


def _corrected(G: Rational, rows: Rational, rhs: Sequence[Fraction]) -> Rational | None:
    """G plus a small rational change that meets the equations exactly; None if they contradict."""
    pairs = _pairs(len(G))
    residual = [
        value - sum((row[k] * G[a][b] for k, (a, b) in enumerate(pairs) if row[k]), Fraction(0))
        for row, value in zip(rows, rhs, strict=True)
    ]
    reduced, pivots = _row_reduce(
        [[*row, value] for row, value in zip(rows, residual, strict=True)]
    )
    if len(pairs) in pivots:
        return None
    result = [row[:] for row in G]
    for pivot, equation in zip(pivots, reduced, strict=True):
        a, b = pairs[pivot]
        result[a][b] += equation[-1]
        if a != b:
            result[b][a] += equation[-1]
    return result


def _row_reduce(rows: Rational) -> tuple[Rational, list[int]]:
    """Reduced row echelon form without zero rows, and its pivot columns."""
    rows, reduced, pivots = [row[:] for row in rows], [], []  # type: ignore[var-annotated]
    for column in range(len(rows[0]) if rows else 0):
        found = next((row for row in rows if row[column]), None)
        if found is None:
            continue
        rows.remove(found)
        pivot = [entry / found[column] for entry in found]
        rows = [_eliminate(row, pivot, column) for row in rows]
        reduced = [_eliminate(row, pivot, column) for row in reduced] + [pivot]
        pivots.append(column)
    return reduced, pivots


def _eliminate(row: list[Fraction], pivot: list[Fraction], column: int) -> list[Fraction]:
    factor = row[column]
    if not factor:
        return row
    return [a - factor * b if b else a for a, b in zip(row, pivot, strict=True)]


def _congruence(G: Rational, N: Rational) -> Rational:
    """N'GN."""
    k = len(N[0])
    GN = [
        [sum((g * N[c][j] for c, g in enumerate(row) if g), Fraction(0)) for j in range(k)]
        for row in G
    ]
    return [
        [sum((N[a][i] * GN[a][j] for a in range(len(N)) if N[a][i]), Fraction(0)) for j in range(k)]
        for i in range(k)
    ]


def _monomial(exponent: Sequence[int], point: Sequence[Fraction | int]) -> Fraction:
    value = Fraction(1)
    for power, x in zip(exponent, point, strict=True):
        value *= Fraction(x) ** power
    return value


def _pairs(size: int) -> list[tuple[int, int]]:
    return [(a, b) for a in range(size) for b in range(a, size)]
