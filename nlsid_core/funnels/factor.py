"""The size of a state in an ellipsoid, by a factor of its matrix, with a bound on the rounding.

|F x| is a sum of squares, so nothing cancels in it as it does in x'Px: where P has entries of 1e18
and the ellipsoid a radius of 1, the float64 value of x'Px can be wrong by hundreds.
"""

from fractions import Fraction
from typing import Protocol

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError

UNIT = 2.0**-53  # the rounding of one operation, relative
STEPS = 16  # rounded operations on one entry besides a row's sum, generously
MOST_ROUNDING = 1e-3  # of the tube's size: what a monitor may lose to rounding


class Factored(Protocol):
    """A funnel whose sizes are lengths |F x|."""

    @property
    def rounding(self) -> object:
        """What rounding can hide of a size, of itself."""


def refuse_unmonitorable(funnel: Factored) -> None:
    """DataError if rounding could hide too much of the funnel's sizes; see `rounding_of`.

    Designs ask this before they prove, monitors before they judge.
    """
    _ = funnel.rounding


def refuse_coarse(hidden: FloatArray, half_widths: FloatArray, what: str) -> None:
    """DataError where rounding can hide too much of the half-widths, as it can far from 0."""
    part = float(np.max(hidden / half_widths))
    if not part <= MOST_ROUNDING:
        raise DataError(
            f"{what} cannot be monitored in float64: rounding can hide {part:.2g} half-widths "
            f"there, at most {MOST_ROUNDING:g} is allowed; measure from a place nearby, not from 0"
        )


def factor_of(P: FloatArray) -> FloatArray:
    """F (n, n) upper triangular with F'F = P, every entry within 4 roundings of the true factor's.

    P = L D L' is found in exact arithmetic. Raises DataError if P (n, n) is not positive definite.
    """
    n = len(P)
    rows = [[Fraction(value) for value in row] for row in P.tolist()]
    F = np.zeros((n, n))
    for i in range(n):
        pivot = rows[i][i]
        if pivot <= 0:
            raise DataError(f"P is not positive definite: pivot {i} is {float(pivot):.3g}")
        scaled = [entry / pivot for entry in rows[i]]
        F[i, i:] = np.sqrt(float(pivot)) * np.array([float(entry) for entry in scaled[i:]])
        for j in range(i + 1, n):
            weight = rows[j][i]
            if weight:
                rows[j] = [a - weight * b for a, b in zip(rows[j], scaled, strict=True)]
    return F


def rounding_of(F: FloatArray, what: str) -> FloatArray:
    """Which part of itself |F (x - y)|, in float64, can be below the true value: (...).

    F: (..., n, n), x and y float64. Source: N. Higham, Accuracy and Stability of Numerical
    Algorithms, (3.11): |fl(F x) - F x| ≤ γ_n |F||x|, and |F||x| ≤ |F||F⁻¹| |F x|.

    Raises DataError if it is above MOST_ROUNDING: too ill-conditioned to be monitored in float64.
    """
    try:
        spread = np.linalg.norm(np.abs(F) @ np.abs(np.linalg.inv(F)), axis=(-2, -1))
    except np.linalg.LinAlgError:
        spread = np.full(F.shape[:-2], np.inf)
    rounding = 2.0 * (F.shape[-1] + STEPS) * UNIT * np.maximum(spread, 1.0)
    worst = float(np.max(rounding))
    if not worst <= MOST_ROUNDING:
        raise DataError(
            f"{what} is too ill-conditioned to be monitored in float64: rounding can hide "
            f"{worst:.2g} of its size, at most {MOST_ROUNDING:g} is allowed; use units in which "
            "the states are of similar size, or drop a state that nothing depends on"
        )
    return np.asarray(rounding)
