"""Levenberg-Marquardt: steps (J'J + λ diag(J'J))δ = -J'r on a sum of squares."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from nlsid_core.arrays import FloatArray

DAMPING_DOWN, DAMPING_UP, GIVE_UP_DAMPING = 0.2, 4.0, 1e8
RIDGE = 1e-10  # of the largest diagonal entry: what the data do not show has no curvature


def descend(
    theta: FloatArray,
    cost: Callable[[FloatArray], float],
    normal: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    *,
    steps: int,
    tolerance: float,
    damping: float,
    patience: int,
) -> tuple[FloatArray, float, int]:
    """(θ, its cost, steps taken) where `patience` steps in a row gain less than the tolerance.

    cost: inf where θ is not allowed. normal: J'J and J'r, both by one factor. damping: the first λ;
    patience: as the first steps may be damped, not done.
    """

    def cost_at(theta: FloatArray) -> float:
        with np.errstate(all="ignore"):  # a wild candidate may overflow: its cost is not less
            return cost(theta)

    reached, taken, small = cost_at(theta), 0, 0
    while taken < steps and small < patience and damping < GIVE_UP_DAMPING:
        H, gradient = normal(theta)
        taken += 1
        gain, diagonal = 0.0, np.diag(H)
        while damping < GIVE_UP_DAMPING:
            try:
                damped = H + np.diag(damping * diagonal + RIDGE * np.max(diagonal))
                candidate = theta - cho_solve(cho_factor(damped), gradient)
                lower = cost_at(candidate)
            except (LinAlgError, ValueError):
                lower = float("inf")
            if lower < reached:
                gain = (reached - lower) / reached
                theta, reached = candidate, lower
                damping *= DAMPING_DOWN
                break
            damping *= DAMPING_UP
        small = small + 1 if gain < tolerance else 0
    return theta, reached, taken
