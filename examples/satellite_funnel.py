"""A funnel for the satellite of thesis Chapter 7, designed, saved and checked in a few lines."""

import tempfile
from typing import Any

import numpy as np

from examples.satellite import FINAL_TIME, GOAL, KNOTS, dynamics, nominal_input
from nlsid import Nominal, VectorField, check, integrate_nominal
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, FunnelDesign, design_funnel

PUBLISHED_SECONDS = 13429.0  # thesis: 223 min 49 s on 12 cores, exact in time
WEIGHTS = {"Q": np.eye(6), "R": 10.0 * np.eye(3)}


def goal_matrix(*, lqr_order: bool = False) -> FloatArray:
    """P_G as printed for [σ; ω], or with its blocks swapped (`lqr_order`)."""
    order = [3, 4, 5, 0, 1, 2] if lqr_order else [0, 1, 2, 3, 4, 5]
    return np.asarray(GOAL[np.ix_(order, order)])


def problem(knots: int = KNOTS) -> tuple[VectorField, Nominal, dict[str, Any]]:
    """Dynamics, nominal motion ending at rest at the origin, and LQR weights."""
    field = VectorField.from_function(dynamics, 6, 3)
    t = np.linspace(0.0, FINAL_TIME, knots)
    return field, integrate_nominal(field, nominal_input, t=t, final=np.zeros(6)), WEIGHTS


def designed() -> FunnelDesign:
    """The funnel into the published goal."""
    field, nominal, weights = problem()
    return design_funnel(ContinuousTracking(field, nominal, goal=goal_matrix(), **weights))


def main() -> tuple[float, float]:
    """(seconds for search and proof, seconds the thesis took)."""
    found = designed()
    with tempfile.TemporaryDirectory() as folder:
        *_, proof = found.save(folder)
        print(check(proof))
    print(found)
    return sum(found.found.seconds.values()), PUBLISHED_SECONDS


if __name__ == "__main__":
    main()
