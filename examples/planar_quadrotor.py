"""A quadrotor in the plane that hops sideways: cubic Taylor models, their remainder proved.

x = (sideways and upward position in m, tilt in rad, their rates), u = (thrust over mass in m/s²,
torque over inertia in rad/s²).
"""

from typing import Any

import numpy as np
from scipy.linalg import solve_continuous_are

from nlsid import Nominal, VectorField, taylor_field
from nlsid_core.arrays import FloatArray
from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    Goal,
    design,
    nominal_through,
    plan_motion,
)

GRAVITY = 9.81  # m/s²
SECONDS = 2.0
START, END = np.zeros(6), np.array([3.0, 0.5, 0.0, 0.0, 0.0, 0.0])
RADIUS = np.array([10.0, 10.0, 0.4, 10.0, 10.0, 20.0, 6.0, 100.0])  # around the motion
Q, R = np.diag([10.0, 10.0, 10.0, 2.0, 2.0, 1.0]), np.diag([0.5, 0.02])
LEVEL = 0.3  # of the goal, in the LQR's cost at the end


def rate(x: Any, u: Any) -> Any:
    """ẋ for one state, of numbers or of Taylor models; entries (6,)."""
    return [x[3], x[4], x[5], -u[0] * np.sin(x[2]), u[0] * np.cos(x[2]) - GRAVITY, u[1]]


def truth(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (N, 6)."""
    return np.stack(rate(x.T, u.T), axis=1)


def problem() -> tuple[VectorField, Nominal]:
    """The cubic models of the intervals, with what they leave out, and the motion."""

    hover = np.array([GRAVITY, 0.0])

    def hovering(x: Any, u: Any) -> Any:  # both inputs from those of hovering: they cost alike
        return rate(x, hover + u)

    planned = plan_motion(hovering, start=START, end=END, seconds=SECONDS, u=[0.0, 0.0])
    finer = planned.halved(np.ones(len(planned.t) - 1, dtype=bool))
    t, x, u = finer.t, finer.x.ends(), finer.u.ends() + hover
    field = taylor_field(rate, t, x, u, radius=RADIUS)
    return field, nominal_through(t, x, u, field)


def designed() -> FunnelDesign:
    """The funnel, proved for every t and for the true dynamics."""
    field, nominal = problem()
    end = nominal.x.ends()[-1]
    A, B = field.jacobians(SECONDS, end, nominal.u.ends()[-1])
    S = solve_continuous_are(A, B, Q, R)
    goal = Goal(end, (S + S.T) / 2 / LEVEL)
    return design(ContinuousTracking(field, nominal, goal=goal, Q=Q / LEVEL, R=R / LEVEL))


def main() -> tuple[float, float]:
    """(half-width of the funnel at the start in tilt, the tilt around the motion covered)."""
    found = designed()
    print(found)
    shadow = np.linalg.inv(found.funnel.shape(0.0))
    return float(np.sqrt(shadow[2, 2])), float(RADIUS[2])


if __name__ == "__main__":
    print(main())
