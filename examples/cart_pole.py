"""Cart-pole swing-up: motion by collocation, cubic Taylor models along it, their remainder proved.

x = (cart position in m, angle from hanging in rad, their rates), u the force on the cart in N.
"""

from typing import Any, Literal

import numpy as np
from scipy.linalg import solve_continuous_are

from examples.transcription import motion
from nlsid import (
    ContinuousTracking,
    Goal,
    Nominal,
    VectorField,
    design,
    nominal_through,
    taylor_field,
)
from nlsid_core.arrays import FloatArray
from nlsid_core.design import FunnelDesign

CART, POLE, LENGTH, GRAVITY = 1.0, 0.25, 0.5, 9.81  # kg, kg, m, m/s²
SECONDS, SEGMENTS = 2.0, (24, 100)
RADIUS = np.array([5.0, 0.15, 20.0, 1.5, 12.0])  # around the motion, where the expansion is bounded
Q, R = np.diag([1.0, 10.0, 1.0, 1.0]), np.array([[0.1]])
LEVEL = 0.05  # of the goal, in the LQR's cost at the top


def rate(x: Any, u: Any) -> Any:
    """ẋ for one state, of numbers or of Taylor models; entries (4,)."""
    s, c = np.sin(x[1]), np.cos(x[1])
    swing = LENGTH * x[3] * x[3]
    heavy = CART + POLE * (s * s)
    cart = (u[0] + POLE * (s * (swing + GRAVITY * c))) / heavy
    pole = -(u[0] * c + POLE * (swing * (c * s)) + (CART + POLE) * GRAVITY * s) / (LENGTH * heavy)
    return [x[2], x[3], cart, pole]


def truth(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (N, 4)."""
    return np.stack(rate(x.T, u.T), axis=1)


def problem() -> tuple[VectorField, Nominal]:
    """The cubic models of the intervals, with what they leave out, and the motion."""
    top = np.array([0.0, np.pi, 0.0, 0.0])
    t, x, u = motion(
        truth, ends=(np.zeros(4), top), u_rest=np.zeros(1), seconds=SECONDS, segments=SEGMENTS
    )
    field = taylor_field(rate, t, x, u, radius=RADIUS)
    return field, nominal_through(t, x, u, field)


def designed(hold: float | Literal["largest"] | None = None) -> FunnelDesign:
    """The funnel, proved for every t and for the true dynamics; the force is held for `hold` s."""
    field, nominal = problem()
    end = nominal.x.ends()[-1]
    A, B = field.jacobians(SECONDS, end, nominal.u.ends()[-1])
    S = solve_continuous_are(A, B, Q, R)
    goal = Goal(end, (S + S.T) / 2 / LEVEL)
    return design(
        ContinuousTracking(field, nominal, goal=goal, Q=Q / LEVEL, R=R / LEVEL, hold=hold)
    )


def main() -> tuple[float, float]:
    """(smallest half-width of the funnel at the start in the angle in rad, 0)."""
    found = designed()
    print(found)
    return float(np.sqrt(np.linalg.inv(found.funnel.shape(0.0))[1, 1])), 0.0


if __name__ == "__main__":
    print(main())
