"""Cart-pole swing-up: the motion, its policy and the funnel around it, from the equations.

x = (cart position in m, angle from hanging in rad, their rates), u the force on the cart in N.
"""

from typing import Any, Literal

import numpy as np

from nlsid import ContinuousTracking, design, plan_motion
from nlsid_core.arrays import FloatArray
from nlsid_core.design import FunnelDesign

CART, POLE, LENGTH, GRAVITY = 1.0, 0.25, 0.5, 9.81  # kg, kg, m, m/s²
SECONDS = 2.0
GOAL = [0.2, 0.12, 0.34, 0.67]  # half-widths at the top, of the states
Q, R = np.diag([20.0, 200.0, 20.0, 20.0]), np.array([[2.0]])


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


def designed(hold: float | Literal["largest"] | None = None) -> FunnelDesign:
    """The funnel, proved for every t and for the true dynamics; the force is held for `hold` s."""
    top = np.array([0.0, np.pi, 0.0, 0.0])
    motion = plan_motion(rate, start=np.zeros(4), end=top, seconds=SECONDS, u=[0.0])
    return design(ContinuousTracking(rate, motion, goal=GOAL, Q=Q, R=R, hold=hold))


def main() -> tuple[float, float]:
    """(smallest half-width of the funnel at the start in the angle in rad, 0)."""
    found = designed()
    print(found)
    return float(np.sqrt(np.linalg.inv(found.funnel.shape(0.0))[1, 1])), 0.0


if __name__ == "__main__":
    print(main())
