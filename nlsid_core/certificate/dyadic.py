"""Definiteness of integer matrices, decided exactly with Python integers.

Fast: a rounded floating-point Cholesky factor L of M is only a guess; that M - LL' is strictly
diagonally dominant is checked in integers, and proves M ≻ 0. Where that fails (semidefinite or
very ill-conditioned matrices) fraction-free elimination decides.
"""

from math import frexp, inf, ldexp
from typing import TypeAlias

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.errors import Undecided

Integers: TypeAlias = list[list[int]]

FACTOR_BITS = 60  # of the rounded factor; past the 53 of a float there is nothing left to keep
SHIFT = 2.0**-46  # taken off a unit diagonal first, so that rounding the factor cannot matter
ELIMINATION_WORK = 2_000_000  # order² times bits: beyond it elimination takes longer than seconds


def is_positive_definite(M: Integers) -> bool:
    """Decide M ≻ 0 for a symmetric integer matrix; Undecided if it is too large to eliminate."""
    if any(M[i][i] <= 0 for i in range(len(M))):
        return False
    return is_dominated(M) or _eliminate(M) == len(M)


def is_positive_semidefinite(M: Integers) -> bool:
    """Decide M ⪰ 0; see `is_positive_definite`."""
    if any(M[i][i] < 0 for i in range(len(M))):
        return False
    if all(M[i][i] > 0 for i in range(len(M))) and is_dominated(M):
        return True
    return _eliminate(M) is not None


def as_floats(M: Integers) -> tuple[FloatArray, list[int]]:
    """M rounded, with rows and columns scaled to diagonal entries in [¼, 1): 2^-(s_i+s_j) M_ij."""
    shifts = [(M[i][i].bit_length() + 1) // 2 for i in range(len(M))]
    rounded = [
        [_ldexp(entry, -shifts[i] - shifts[j]) for j, entry in enumerate(row)]
        for i, row in enumerate(M)
    ]
    return np.array(rounded), shifts


def is_dominated(M: Integers) -> bool:
    """True proves M ≻ 0, False proves nothing.

    Shown: 2^(2t) S M S - LL' is strictly diagonally dominant, S the diagonal of 2^-s_i.
    """
    n = len(M)
    scaled, shifts = as_floats(M)
    if not np.isfinite(scaled).all():
        return False
    try:
        factor = np.linalg.cholesky(scaled - SHIFT * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    low = 2 * max(shifts, default=0)
    # Integers throughout: multiply by 2^(low + 2t), which makes every scaled entry whole.
    L = [
        [round(entry * 2**FACTOR_BITS) for entry in row[: i + 1]]
        for i, row in enumerate(factor.tolist())
    ]
    rest = [[0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            square = sum(map(int.__mul__, L[i], L[j]))
            entry = M[i][j] << (low - shifts[i] - shifts[j] + 2 * FACTOR_BITS)
            rest[i][j] = rest[j][i] = entry - (square << low)
    return all(2 * rest[i][i] > sum(map(abs, rest[i])) and rest[i][i] > 0 for i in range(n))


def _eliminate(M: Integers) -> int | None:
    """The rank of M if M ⪰ 0, else None, by fraction-free symmetric elimination (Bareiss)."""
    n = len(M)
    bits = max((abs(entry).bit_length() for row in M for entry in row), default=0)
    if n * n * bits > ELIMINATION_WORK:
        raise Undecided(
            f"a {n}x{n} matrix with {bits} bits is too close to singular for the fast exact test, "
            "and too large to eliminate"
        )
    rows, previous = [row[:] for row in M], 1
    for rank in range(n):
        size = len(rows)
        if any(rows[i][i] < 0 for i in range(size)):
            return None
        pivot = next((i for i in range(size) if rows[i][i] > 0), None)
        if pivot is None:
            return rank if not any(map(any, rows)) else None
        head, top = rows[pivot], rows[pivot][pivot]
        rows = [
            [(top * row[j] - row[pivot] * head[j]) // previous for j in range(size) if j != pivot]
            for i, row in enumerate(rows)
            if i != pivot
        ]
        previous = top
    return n


def _ldexp(value: int, power: int) -> float:
    """value · 2^power, rounded; ±inf and 0 beyond what a float64 holds."""
    excess = max(0, value.bit_length() - 64)
    mantissa, exponent = frexp(float(value >> excess))
    total = exponent + excess + power
    if total > 1000:
        return inf if value > 0 else -inf
    return ldexp(mantissa, total)
