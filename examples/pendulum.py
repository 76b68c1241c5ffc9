"""A pendulum that is held upright by a limited torque, with the true sine.

The sine becomes a cubic and a bounded push, |sin θ - θ + θ³/6| ≤ |θ|⁵/120, and the funnel is
proved to stay where that holds and where the torque is within its limits.
"""

from typing import Any

import numpy as np

from nlsid import ContinuousTracking, Nominal, VectorField, design, integrate_nominal
from nlsid_core.arrays import FloatArray
from nlsid_core.design import FunnelDesign

LENGTH, GRAVITY, DAMPING = 0.5, 9.81, 0.1  # m, m/s², 1/s
ANGLE, TORQUE = 0.6, 12.0  # rad where the sine is bounded; limit of torque over inertia in 1/s²
FINAL_TIME, KNOTS = 1.0, 21
Q, R = np.diag([10.0, 1.0]), np.array([[0.1]])
GOAL = np.diag([100.0, 10.0])
ROUNDING_ROOM = 1.0001


def taylor(x: Any, u: Any, w: Any) -> Any:
    """ẋ; x = (angle from upright in rad, rate), u torque over inertia, w beyond the cubic."""
    sine = x[0] - x[0] ** 3 / 6
    return np.array([x[1], GRAVITY / LENGTH * sine - DAMPING * x[1] + u[0] + w[0]])


def truth(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (N, 2) with the sine itself."""
    pull = GRAVITY / LENGTH * np.sin(x[:, 0])
    return np.stack([x[:, 1], pull - DAMPING * x[:, 1] + u[:, 0]], axis=1)


def problem() -> tuple[VectorField, Nominal]:
    """The pendulum at rest, upright."""
    most = ROUNDING_ROOM * GRAVITY / LENGTH * ANGLE**5 / 120
    field = VectorField.from_function(
        taylor,
        2,
        1,
        uncertain=[[-most, most]],
        valid=[[0, -ANGLE, ANGLE], [2, -TORQUE, TORQUE]],
        expansion="a cubic for the sine, whose remainder is bounded by its fifth-order term",
    )
    t = np.linspace(0, FINAL_TIME, KNOTS)
    return field, integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))


def designed() -> FunnelDesign:
    """The funnel, proved for the true sine and within the torque's limits."""
    return design(ContinuousTracking(*problem(), goal=GOAL, Q=Q, R=R))


def main() -> tuple[float, float]:
    """(largest torque in the funnel, its limit)."""
    found = designed()
    print(found)
    torques = [
        float(np.abs(found.policy(float(t), found.funnel.outline(float(t), (0, 1)))).max())
        for t in found.funnel.t
    ]
    return max(torques), TORQUE


if __name__ == "__main__":
    print(main())
