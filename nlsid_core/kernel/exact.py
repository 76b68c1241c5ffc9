"""Two of the kernel's three obligations, in integers: `definite` and `at_most`; and matrices.

A matrix is a list of rows of Fractions or ints.
"""

from collections.abc import Sequence
from contextvars import ContextVar
from fractions import Fraction
from math import lcm

from .files import Rejected

Matrix = list[list[Fraction]]
MAX_ORDER = 200  # of a matrix whose definiteness is decided
MAX_COMMON = 10_000  # bits of a matrix's common denominator
MAX_ELIMINATION = 10**8  # entries eliminated in one claim, long ones counted as several: a minute
LONG = 22  # an elimination whose longest numbers have b bits counts b^2 / 2^22 times

_left: ContextVar[list[int] | None] = ContextVar("elimination", default=None)


def allow_elimination() -> None:
    """From here on all matrices of this context share MAX_ELIMINATION; otherwise each has it."""
    _left.set([MAX_ELIMINATION])


def definite(M: Sequence[Sequence[Fraction | int]], what: str) -> None:
    """Raise Rejected unless M is symmetric and positive definite.

    M is scaled to integers and eliminated without fractions (Bareiss). The pivots are the leading
    principal minors: M ≻ 0 exactly when all are positive (Sylvester).
    """
    rows, size = _whole(M, what), len(M)
    before = 1
    for k in range(size):
        pivot = rows[k][k]
        if pivot <= 0:
            raise Rejected(f"{what} is not positive definite (leading minor {k + 1} of {size})")
        for i in range(k + 1, size):
            for j in range(i, size):
                rows[i][j] = (rows[i][j] * pivot - rows[k][i] * rows[k][j]) // before
        before = pivot


def semidefinite(M: Sequence[Sequence[Fraction | int]], what: str) -> None:
    """Raise Rejected unless M is symmetric and positive semidefinite, by the same elimination.

    A zero pivot is passed over if the rest of its row is zero, else M is indefinite.
    """
    rows, size = _whole(M, what), len(M)
    before = 1
    for k in range(size):
        pivot = rows[k][k]
        if pivot < 0 or (pivot == 0 and any(rows[k][k:])):
            raise Rejected(f"{what} is not positive semidefinite")
        if pivot == 0:
            continue
        for i in range(k + 1, size):
            for j in range(i, size):
                rows[i][j] = (rows[i][j] * pivot - rows[k][i] * rows[k][j]) // before
        before = pivot


def inverse_forms(
    M: Sequence[Sequence[Fraction]], vectors: Sequence[Sequence[Fraction]], what: str
) -> list[Fraction]:
    """g'M⁻¹g for each of the vectors g, the largest (g'x)² where x'Mx <= 1; Rejected unless M ≻ 0.

    The elimination of `definite` on [[M, G'], [G, 0]]: its last entries are -(pivot) g'M⁻¹g.
    """
    scales = [lcm(*(Fraction(entry).denominator for entry in g)) for g in vectors]
    whole = [[int(e * scale) for e in g] for g, scale in zip(vectors, scales, strict=True)]
    rows, size = _whole(M, what, whole), len(M)
    lines = [[*row, *(g[i] for g in whole)] for i, row in enumerate(rows)]
    corners, before, first = [0] * len(vectors), 1, rows[0][0]
    for k, line in enumerate(lines):
        pivot = line[k]
        if pivot <= 0:
            raise Rejected(f"{what} is not positive definite (leading minor {k + 1} of {size})")
        pairs = zip(corners, line[size:], strict=True)
        corners = [(corner * pivot - e * e) // before for corner, e in pairs]
        for i in range(k + 1, size):
            for j in range(i, len(line)):
                lines[i][j] = (lines[i][j] * pivot - line[i] * line[j]) // before
        before = pivot
    return [
        Fraction(-corner * first, before * scale**2) / M[0][0]
        for corner, scale in zip(corners, scales, strict=True)
    ]


def at_most(small: Fraction | int, large: Fraction | int, what: str) -> None:
    """Raise Rejected unless small <= large."""
    if not small <= large:
        raise Rejected(what)


def product(A: Sequence[Sequence], B: Sequence[Sequence]) -> Matrix:  # type: ignore[type-arg]
    """A B."""
    columns = list(zip(*B, strict=True))
    return [[_dot(row, column) for column in columns] for row in A]


def congruence(F: Sequence[Sequence], P: Sequence[Sequence]) -> Matrix:  # type: ignore[type-arg]
    """F'P F."""
    return product(transposed(F), product(P, F))


def transposed(A: Sequence[Sequence]) -> list[list]:  # type: ignore[type-arg]
    """A'."""
    return [list(column) for column in zip(*A, strict=True)]


def combined(A: Sequence[Sequence], B: Sequence[Sequence], weight: Fraction | int = 1) -> Matrix:  # type: ignore[type-arg]
    """A + weight B."""
    return [
        [a + weight * b for a, b in zip(left, right, strict=True)]
        for left, right in zip(A, B, strict=True)
    ]


def _dot(row: Sequence, column: Sequence) -> Fraction:  # type: ignore[type-arg]
    total: Fraction = Fraction(0)
    for a, b in zip(row, column, strict=True):
        if a and b:
            total += a * b
    return total


def _whole(
    M: Sequence[Sequence[Fraction | int]], what: str, more: Sequence[Sequence[int]] = ()
) -> list[list[int]]:
    """M times the least common denominator; Rejected unless square, symmetric and of some size.

    Spends what the elimination costs, `more` rows that are carried along included.
    """
    size = len(M)
    if not 0 < size <= MAX_ORDER or any(len(row) != size for row in M):
        raise Rejected(f"{what} should be a square matrix of order 1 to {MAX_ORDER}")
    if any(M[i][j] != M[j][i] for i in range(size) for j in range(i)):
        raise Rejected(f"{what} is not symmetric")
    common = 1
    for denominator in {Fraction(entry).denominator for row in M for entry in row}:
        common = lcm(common, denominator)
        if common.bit_length() > MAX_COMMON:
            raise Rejected(f"{what}: denominators of more than {MAX_COMMON} bits together")
    rows = [[int(entry * common) for entry in row] for row in M]
    bits = max(abs(entry).bit_length() for row in rows for entry in row)
    longest = size * bits + 2 * max((abs(e).bit_length() for row in more for e in row), default=0)
    left = _left.get() or [MAX_ELIMINATION]
    left[0] -= size**2 * (size + len(more)) * (1 + (longest**2 >> LONG))
    if left[0] < 0:
        raise Rejected(f"{what}: order {size} with entries of {bits} bits takes too long to decide")
    return rows
