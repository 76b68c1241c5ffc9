"""One ellipsoid in another, and whether a matrix is positive definite: decided in rationals.

{|x-a|²_A ≤ 1} ⊂ {|x-b|²_B ≤ 1} if, for some λ ≥ 0 and d = a - b,
    [λA - B, -Bd; -(Bd)', 1 - λ - d'Bd] ⪰ 0        (S-lemma),
and only if, where the first has an interior. With d = 0 it is 0 ≤ λ ≤ 1 and λA ⪰ B.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import lcm

from nlsid_core._types import FloatArray
from nlsid_core.certificate import dyadic
from nlsid_core.certificate.exact import Matrix

Rows = Sequence[Sequence[float | Fraction]]


def ellipsoid_inside(
    inner_centre: Sequence[float],
    inner: Rows,
    outer_centre: Sequence[float],
    outer: Rows,
    multiplier: float,
) -> bool:
    """Decide, exactly, whether `multiplier` proves the containment; False proves nothing."""
    A, B = _rational(inner), _rational(outer)
    d = [Fraction(a) - Fraction(b) for a, b in zip(inner_centre, outer_centre, strict=True)]
    scale = Fraction(multiplier)
    if scale < 0 or not _is_symmetric(A) or not _is_symmetric(B):
        return False
    shift = [sum((b * e for b, e in zip(row, d, strict=True)), Fraction(0)) for row in B]
    corner = 1 - scale - sum((e * b for e, b in zip(d, shift, strict=True)), Fraction(0))
    upper = [[scale * a - b for a, b in zip(p, q, strict=True)] for p, q in zip(A, B, strict=True)]
    if not any(shift):
        return corner >= 0 and is_positive_semidefinite(upper)
    rows = [[*row, -entry] for row, entry in zip(upper, shift, strict=True)]
    return is_positive_semidefinite([*rows, [*(-entry for entry in shift), corner]])


def is_positive_definite(P: FloatArray) -> bool:
    """Decide P ≻ 0 for a float matrix, exactly; False too if it is not symmetric."""
    rows = _rational(P.tolist())
    return _is_symmetric(rows) and dyadic.is_positive_definite(_integers(rows))


def is_positive_semidefinite(rows: Matrix) -> bool:
    """Decide whether a symmetric rational matrix is ⪰ 0."""
    return dyadic.is_positive_semidefinite(_integers(rows))


def _rational(rows: Rows) -> Matrix:
    return [[Fraction(entry) for entry in row] for row in rows]


def _is_symmetric(rows: Matrix) -> bool:
    return all(len(row) == len(rows) for row in rows) and all(
        rows[i][j] == rows[j][i] for i in range(len(rows)) for j in range(i)
    )


def _integers(rows: Matrix) -> list[list[int]]:
    scale = lcm(*(entry.denominator for row in rows for entry in row)) if rows else 1
    return [[int(entry * scale) for entry in row] for row in rows]
