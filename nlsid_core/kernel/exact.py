"""Two of the kernel's three obligations, in integers: `definite` and `at_most`; and matrices.

A matrix is a list of rows of Fractions or ints.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import lcm
from typing import Any

from .files import common_denominator, limit, refuse_if

Matrix = list[list[Fraction]]
Rows = Sequence[Sequence[Fraction | int]]
MAX_ORDER = 200  # of a matrix whose definiteness is decided


def definite(M: Rows, what: str) -> None:
    """Raise Rejected unless M is symmetric and positive definite."""
    inverse_forms(M, [], what)


def semidefinite(M: Rows, what: str) -> None:
    """Raise Rejected unless M is symmetric and positive semidefinite."""
    inverse_forms(M, [], what, strict=False)


def inverse_forms(M: Rows, vectors: Rows, what: str, *, strict: bool = True) -> list[Fraction]:
    """g'M⁻¹g for each of the vectors g, the largest (g'x)² where x'Mx <= 1; Rejected unless M ≻ 0.

    [[M, G'], [G, 0]] is scaled to integers and eliminated without fractions (Bareiss). The pivots
    are the leading principal minors: M ≻ 0 exactly when all are positive (Sylvester). The last
    entries are -(last pivot) g'M⁻¹g. Not strict, M ⪰ 0: a zero pivot is passed over if the rest of
    its row is zero, else M is indefinite.
    """
    size = limit(len(M), MAX_ORDER, f"{what}: order", least=1)
    refuse_if(any(len(row) != size for row in M), f"{what} is not square", "too_large")
    refuse_if(transposed(M) != list(map(list, M)), f"{what} is not symmetric", "not_definite")

    scales = [lcm(*(entry.denominator for entry in g)) for g in vectors]
    whole = [[int(e * scale) for e in g] for g, scale in zip(vectors, scales, strict=True)]
    common = common_denominator([entry for row in M for entry in row], what)
    rows = [[e.numerator * (common // e.denominator) for e in row] for row in M]
    rows = [[*row, *(g[i] for g in whole)] for i, row in enumerate(rows)]
    corners, before = [0] * len(whole), 1
    wanted = "definite" if strict else "semidefinite"

    for k, row in enumerate(rows):
        pivot = row[k]
        indefinite = pivot < 0 or (pivot == 0 and (strict or any(row[k:])))
        refuse_if(indefinite, f"{what} is not positive {wanted} (minor {k + 1})", "not_definite")
        if pivot == 0:
            continue
        corners = [
            (corner * pivot - e * e) // before
            for corner, e in zip(corners, row[size:], strict=True)
        ]
        for i in range(k + 1, size):
            head, pairs = row[i], zip(rows[i][i:], row[i:], strict=True)
            rows[i][i:] = [(a * pivot - head * b) // before for a, b in pairs]
        before = pivot

    return [
        Fraction(-corner * common, before * scale**2)
        for corner, scale in zip(corners, scales, strict=True)
    ]


def at_most(small: Fraction | int, large: Fraction | int, what: str) -> None:
    """Raise Rejected unless small <= large."""
    refuse_if(not small <= large, what, "not_below")


def dot(a: Sequence[Fraction | int], b: Sequence[Fraction | int]) -> Fraction:
    """a'b."""
    return Fraction(sum(p * q for p, q in zip(a, b, strict=True) if p and q))


def product(A: Rows, B: Rows) -> Matrix:
    """A B."""
    columns = list(zip(*B, strict=True))
    return [[dot(row, column) for column in columns] for row in A]


def transposed(A: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """A'."""
    return [list(column) for column in zip(*A, strict=True)]


def combined(A: Rows, B: Rows, weight: Fraction | int = 1) -> Matrix:
    """A + weight B."""
    return [
        [Fraction(a + weight * b) for a, b in zip(left, right, strict=True)]
        for left, right in zip(A, B, strict=True)
    ]


def scaled(M: Rows, weight: Fraction | int) -> Matrix:
    """Weight M."""
    return [[Fraction(weight * entry) for entry in row] for row in M]


def identity(size: int) -> Matrix:
    """I."""
    return [unit(i, size) for i in range(size)]


def unit(i: int, size: int) -> list[Fraction]:
    """Row i of the identity."""
    return [Fraction(j == i) for j in range(size)]
