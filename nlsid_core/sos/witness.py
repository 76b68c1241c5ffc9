"""Witnesses for the kernel: sums of squares as small whole numbers, from float Gram matrices.

The kernel's `positive` takes monomials v, a power of two for each (V = diag 2^columns), and factors
R_j of whole numbers, and asks that what is left of the polynomial,
    r = c - Σ_j B_j(s) |R_j V v|² / 4^unit,
is diagonally dominant in V v. So the Gram matrix is scaled to a diagonal near 1, most of its least
eigenvalue is left to r, and the Cholesky factor of the rest is rounded to the fewest bits that
change no row of the Gram matrix by more than a part of that. Where v_i² = v_a v_b, the rounding of
the pair counts on the diagonal of v_i: there a column is raised to the mean of the pair's. Nothing
here is trusted.
Source: docs/certificate.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import ceil, log2

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cholesky

from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.errors import Infeasible
from nlsid_core.polynomial.documents import WHOLE, write_whole

ROOM = 0.7  # of the least eigenvalue of the scaled Gram matrix: what is left to the remainder
ROUNDING = 0.3  # of that room: what rounding may take of a diagonal entry
SPARE_BITS = 8  # beyond what is enough where no product of v is a square of another
MULTIPLIER_BITS = 48  # of a multiplier's factor: any rounding of it is a sum of squares
SMALLEST = 2.0**-200  # of a diagonal entry, relative to the largest: below it a column is not used
Residual = Mapping[tuple[int, ...], ArrayLike]


@dataclass(frozen=True, eq=False)
class Scale:
    """How a witness of Gram matrices is scaled, and what their errors cost there.

    diagonal: (k,) powers of two near the roots of their largest diagonal entries. columns: (k,)
    exponents that are written, no less. small: (k,) diagonal / 2^columns, at most 1. places: (k, k)
    each, where the kernel counts v_i v_j, a square's own place or that of one pair; weights: (k, k)
    of the scale at i, j over the scale at that place.
    """

    diagonal: FloatArray
    columns: IntArray
    small: FloatArray
    places: tuple[IntArray, IntArray]
    weights: FloatArray

    @classmethod
    def of(cls, monomials: IntArray, Q: FloatArray) -> "Scale":
        """Make the scale of matrices Q (J+1, k, k)."""
        exponents = _columns(Q)
        columns = _raised(monomials, exponents)
        product, square = products_of(monomials)
        i, j = np.triu_indices(len(monomials), 1)
        order = np.lexsort((-columns[i] - columns[j], product[i, j]))  # stable: the first pair wins
        found, first = np.unique(product[i, j][order], return_index=True)
        home = np.zeros((len(square), 2), dtype=np.int64)
        home[found] = np.column_stack([i, j])[order[first]]
        home[square >= 0] = square[square >= 0, None]
        places = home[product]
        steps = columns[:, None] + columns - columns[places].sum(axis=2)
        return cls(
            np.exp2(exponents.astype(np.float64)),
            columns,
            np.exp2((exponents - columns).astype(np.float64)),
            (places[..., 0], places[..., 1]),
            np.exp2(steps.astype(np.float64)),
        )

    def lost(self, change: FloatArray) -> FloatArray:
        """(J+1, k) what the diagonal of r loses by a change (J+1, k, k), scaled as written."""
        k = change.shape[1]
        flat = (self.places[0] * k + self.places[1]).ravel()
        moved = (change * self.weights).reshape(len(change), -1)
        at = np.array([np.bincount(flat, row, k * k) for row in moved]).reshape(-1, k, k)
        return np.asarray(np.abs(at).sum(axis=1) + np.abs(at).sum(axis=2)) / 2


def witness(
    basis: ArrayLike, grams: ArrayLike | Sequence[ArrayLike], *, residual: Residual | None = None
) -> Json:
    """`{basis, columns, squares}` of c = Σ_j B_j(s) v'Q_j v + residual, with room for rounding.

    basis: (k, n) exponents of v. grams: Q (k, k), or the J+1 Bernstein control points Q_j of a
    matrix in s on [0, 1]. residual: what c has beyond the Gram matrices, its Bernstein control
    points (J+1,) for each monomial; it is shared out among the products of v with that monomial.
    Raises Infeasible if a Gram matrix is not positive definite, or a monomial of the residual is
    no product of v.
    """
    monomials, Q = _checked(basis, grams)
    if residual:
        Q = _absorbed(monomials, Q, residual)
    scale = Scale.of(monomials, Q)
    S = Q / scale.diagonal[:, None] / scale.diagonal
    least = np.array([float(np.linalg.eigvalsh(part)[0]) for part in S])
    if not least.min() > 0.0:
        raise Infeasible(
            f"a Gram matrix is not positive definite: least eigenvalue {least.min():.1e} once its "
            "diagonal is 1"
        )
    room = ROOM * least
    try:
        roots = np.array(
            [
                cholesky(part - delta * np.eye(len(part))) * scale.small
                for part, delta in zip(S, room, strict=True)
            ]
        )
    except LinAlgError as error:
        raise Infeasible("a Gram matrix is positive definite to rounding only") from error
    allowed = ROUNDING * room[:, None] * scale.small**2
    enough = ceil(log2(len(monomials) ** 1.5 / allowed.min()))  # |E|₁ ≤ k^1.5 2^-unit
    enough = max(0, enough + SPARE_BITS)
    few, unit = -1, enough  # of bits: too few, and enough
    while unit - few > 1:
        middle = (few + unit) // 2
        if (scale.lost(_rounding(roots, middle)) <= allowed).all():
            unit = middle
        else:
            few = middle
    return _written(monomials, scale.columns, unit, list(roots))


def multiplier(
    basis: ArrayLike, grams: ArrayLike | Sequence[ArrayLike], *, bits: int = MULTIPLIER_BITS
) -> Json:
    """The same of a sum of squares near Σ_j B_j(s) v'Q_j v: never negative, however Q is rounded.

    What it changes in an identity is below 2^-bits, relatively; see `expanded` for what it is.
    """
    monomials, Q = _checked(basis, grams)
    columns = _columns(Q)
    scale = np.exp2(-columns.astype(np.float64))
    roots = []
    for part in Q * scale[:, None] * scale:
        values, vectors = np.linalg.eigh(part)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        roots.append(np.asarray(np.linalg.qr(root, mode="r")))
    return _written(monomials, columns, bits, roots)


def expanded(squares: Json) -> dict[tuple[int, ...], list[Fraction]]:
    """What `{basis, columns, squares}` is exactly: Bernstein control points of each monomial."""
    parts, columns = squares["squares"], squares["columns"]
    monomials, factors = [tuple(row) for row in squares["basis"]], parts["factors"]
    scale = Fraction(4) ** -parts["unit"]
    result: dict[tuple[int, ...], list[Fraction]] = {}
    for at, rows in enumerate(factors):
        for row in rows:
            start = len(monomials) - len(row)
            entries = [
                (monomials[start + k], Fraction(2) ** columns[start + k] * int(entry))
                for k, entry in enumerate(row)
                if int(entry)
            ]
            for left, a in entries:
                for right, b in entries:
                    key = tuple(i + j for i, j in zip(left, right, strict=True))
                    control = result.setdefault(key, [Fraction(0)] * len(factors))
                    control[at] += scale * a * b
    return result


def _checked(
    basis: ArrayLike, grams: ArrayLike | Sequence[ArrayLike]
) -> tuple[IntArray, FloatArray]:
    """(k, n) monomials and (J+1, k, k) symmetric matrices."""
    monomials = np.asarray(basis, dtype=np.int64)
    Q = np.asarray(grams, dtype=np.float64)
    Q = Q[None] if Q.ndim == 2 else Q
    if not len(monomials) or not np.isfinite(Q).all():
        raise Infeasible("a Gram matrix should be finite and have at least one monomial")
    return monomials, (Q + np.swapaxes(Q, 1, 2)) / 2.0


def _absorbed(monomials: IntArray, Q: FloatArray, residual: Residual) -> FloatArray:
    """Gram matrices with the residual in them, in equal parts for all products that fit."""
    places: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    sums = (monomials[:, None] + monomials[None]).tolist()
    for i, row in enumerate(sums):
        for j, key in enumerate(row):
            places.setdefault(tuple(key), []).append((i, j))
    Q = Q.copy()
    for key, values in residual.items():
        control = np.asarray(values, dtype=np.float64)
        if not control.any():
            continue
        if tuple(key) not in places:
            raise Infeasible(f"the monomial {tuple(key)} is no product of the basis")
        for i, j in places[tuple(key)]:
            Q[:, i, j] += control / len(places[tuple(key)])
    return Q


def _rounding(roots: FloatArray, unit: int) -> FloatArray:
    """(J+1, k, k): how the Gram matrices change where factors are whole numbers over 2^unit."""
    whole = np.ldexp(np.round(np.ldexp(roots, unit)), -unit)
    return np.asarray(np.swapaxes(roots, 1, 2) @ roots - np.swapaxes(whole, 1, 2) @ whole)


def _columns(Q: FloatArray) -> IntArray:
    """The power of two nearest to the root of each diagonal entry, the largest over s."""
    diagonal = np.diagonal(Q, axis1=1, axis2=2).max(axis=0)
    largest = max(float(diagonal.max()), SMALLEST)
    return np.asarray(np.round(np.log2(np.maximum(diagonal, SMALLEST * largest)) / 2), np.int64)


def _raised(monomials: IntArray, columns: IntArray) -> IntArray:
    """Columns with columns[i] >= (columns[a] + columns[b])/2 wherever v_i² = v_a v_b."""
    product, square = products_of(monomials)
    a, b = np.nonzero(np.tril(square[product] >= 0, -1))
    while True:
        raised = columns.copy()
        np.maximum.at(raised, square[product[a, b]], (columns[a] + columns[b]) // 2)
        if np.array_equal(raised, columns):
            return raised
        columns = raised


def products_of(monomials: IntArray) -> tuple[IntArray, IntArray]:
    """(k, k) which product v_i v_j is, and for each product the i whose square it is, else -1."""
    return _products(monomials.shape, np.asarray(monomials, dtype=np.int64).tobytes())


@lru_cache(maxsize=8)
def _products(shape: tuple[int, int], monomials: bytes) -> tuple[IntArray, IntArray]:
    rows = np.frombuffer(monomials, dtype=np.int64).reshape(shape)
    sums = (rows[:, None] + rows).reshape(-1, shape[1])
    _, which = np.unique(sums, axis=0, return_inverse=True)
    product = np.asarray(which.reshape(shape[0], shape[0]), dtype=np.int64)
    square = np.full(int(product.max()) + 1, -1)
    square[np.diagonal(product)] = np.arange(shape[0])
    return product, square


def _written(
    monomials: IntArray, columns: IntArray, unit: int, roots: Sequence[FloatArray]
) -> Json:
    factors = []
    for root in roots:
        whole = np.rint(np.ldexp(root, unit))
        if np.abs(whole).max(initial=0.0) <= WHOLE:
            rows = whole.astype(np.int64).tolist()
        else:
            rows = [[write_whole(round(entry)) for entry in row] for row in whole.tolist()]
        factors.append([_row(row) for row in rows if any(row)])
    return {
        "basis": monomials.tolist(),
        "columns": columns.tolist(),
        "squares": {"unit": unit, "factors": factors},
    }


def _row(row: Sequence[int | str]) -> list[int | str]:
    """Without leading zeros: the last entry belongs to the last monomial."""
    first = next((k for k, entry in enumerate(row) if entry), len(row) - 1)
    return list(row[first:])
