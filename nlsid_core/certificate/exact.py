"""Exact linear algebra on small matrices: every float64 is a rational, so decide in rationals."""

from collections.abc import Sequence
from fractions import Fraction
from math import lcm
from typing import TypeAlias

Matrix: TypeAlias = list[list[Fraction]]


def rational(rows: Sequence[Sequence[float]]) -> Matrix:
    """The exact value of a float matrix, entry by entry."""
    return [[Fraction(float(entry)) for entry in row] for row in rows]


def transpose(A: Matrix) -> Matrix:
    """A'."""
    return [list(column) for column in zip(*A, strict=True)]


def product(A: Matrix, B: Matrix) -> Matrix:
    """AB."""
    columns = transpose(B)
    return [[sum(map(_times, row, column), Fraction(0)) for column in columns] for row in A]


def combine(A: Matrix, B: Matrix, scale: Fraction = Fraction(1)) -> Matrix:
    """A + scale·B."""
    return [
        [a + scale * b for a, b in zip(row, other, strict=True)]
        for row, other in zip(A, B, strict=True)
    ]


def congruence(F: Matrix, P: Matrix) -> Matrix:
    """F'PF."""
    return product(transpose(F), product(P, F))


def is_symmetric(A: Matrix) -> bool:
    """True if A is square and A = A'."""
    return all(len(row) == len(A) for row in A) and transpose(A) == A


def is_positive_definite(A: Matrix) -> bool:
    """Decide A ≻ 0 for a symmetric rational matrix by Sylvester's criterion.

    Fraction-free (Bareiss) elimination on integers: the pivots are the leading principal minors of
    the matrix scaled by its common denominator, so their signs are those of A's minors.
    """
    if not is_symmetric(A):
        return False
    scale = lcm(*(entry.denominator for row in A for entry in row)) if A else 1
    M = [[int(entry * scale) for entry in row] for row in A]
    previous = 1
    for k in range(len(M)):
        pivot = M[k][k]
        if pivot <= 0:
            return False
        for i in range(k + 1, len(M)):
            for j in range(k + 1, len(M)):
                M[i][j] = (M[i][j] * pivot - M[i][k] * M[k][j]) // previous
        previous = pivot
    return True


def _times(a: Fraction, b: Fraction) -> Fraction:
    return a * b
