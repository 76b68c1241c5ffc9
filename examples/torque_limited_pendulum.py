"""A pendulum held upright by a motor that saturates, against the set it can truly recover from.

The policy asks for more torque than there is; the funnel is proved for the torque that comes out,
clip(u₀ - Kx̄), mode by mode. The sine is exact: sin θ = θ - (1/6 - w)θ³ with 0 ≤ w ≤ θ²/120, w one
of the values that the proof covers.
"""

from typing import Any

import numpy as np

from nlsid import ContinuousTracking, Nominal, VectorField, design, integrate_nominal
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design import FunnelDesign
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy

STIFFNESS, DAMPING = 19.62, 0.1  # g/length in 1/s², 1/s
TORQUE = 12.0  # over inertia, in 1/s²: holds the pendulum up to 0.66 rad
ANGLE = 1.5  # rad, where the sine is bounded
FINAL_TIME, KNOTS = 1.0, 41
Q, R = np.diag([10.0, 1.0]), np.array([[0.1]])
GOAL = np.diag([100.0, 10.0])
LIMITS = [[0, -TORQUE, TORQUE]]
ROUNDING_ROOM = 1.0001
STEPS = 400  # Runge-Kutta steps of the simulated true set
SPAN = (6.0, 14.0)  # rad, rad/s: half-widths of the grid of starts


def bounded(x: Any, u: Any, w: Any) -> Any:
    """ẋ; x = (angle from upright in rad, rate), u torque over inertia."""
    sine = x[0] - x[0] ** 3 / 6 + w[0] * x[0] ** 3
    return np.array([x[1], STIFFNESS * sine - DAMPING * x[1] + u[0]])


def truth(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (N, 2) with the sine itself."""
    pull = STIFFNESS * np.sin(x[:, 0])
    return np.stack([x[:, 1], pull - DAMPING * x[:, 1] + u[:, 0]], axis=1)


def problem() -> tuple[VectorField, Nominal]:
    """The pendulum at rest, upright."""
    most = ROUNDING_ROOM * ANGLE**2 / 120
    field = VectorField.from_function(
        bounded,
        2,
        1,
        uncertain=[[0, most]],
        valid=[[0, -ANGLE, ANGLE]],
        expansion="a cubic for the sine, whose remainder is bounded by its fifth-order term",
    )
    t = np.linspace(0, FINAL_TIME, KNOTS)
    return field, integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))


def designed() -> FunnelDesign:
    """The funnel of the saturating policy."""
    return design(ContinuousTracking(*problem(), goal=GOAL, Q=Q, R=R, limits=LIMITS))


def reaching(policy: ContinuousPolicy, points: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """Angles, rates (points,), and which starts on that grid truly end in the goal, (rate, angle).

    By simulation of the saturated closed loop with the true sine, from t = 0.
    """
    angles, rates = (np.linspace(-span, span, points) for span in SPAN)
    X: FloatArray = np.stack(np.meshgrid(angles, rates), axis=-1).reshape(-1, 2)
    h = FINAL_TIME / STEPS
    for step in range(STEPS):
        t = step * h
        times = (t, t + h / 2, t + h / 2, min(t + h, FINAL_TIME))
        slope = np.zeros_like(X)
        total = np.zeros_like(X)
        for s, share, weight in zip(times, (0.0, h / 2, h / 2, h), (1, 2, 2, 1), strict=True):
            moved = X + share * slope
            slope = truth(moved, policy(s, moved))
            total += weight * slope
        X = X + h / 6 * total
    reached = np.einsum("ni,ij,nj->n", X, GOAL, X) <= 1
    return angles, rates, reached.reshape(points, points).astype(int)


def area_fractions(
    policy: ContinuousPolicy, funnel: ContinuousFunnel, points: int = 401
) -> tuple[float, float]:
    """Area of the funnel at t = 0 over that of all starts that truly end in the goal, and over that
    of the largest ellipse of its own shape among those."""
    angles, rates, reached = reaching(policy, points)
    cell = float((angles[1] - angles[0]) * (rates[1] - rates[0]))
    missed = np.stack(np.meshgrid(angles, rates), axis=-1)[reached == 0]
    largest = float(np.min(funnel.value(0.0, missed)))
    return funnel.volume(0.0) / (float(reached.sum()) * cell), 1 / largest


def main() -> tuple[float, float]:
    """(largest torque that the policy asks for in the funnel, the torque there is)."""
    found = designed()
    print(found)
    all_starts, ellipse = area_fractions(found.policy, found.funnel)
    print(f"{all_starts:.1%} of what truly reaches the goal, {ellipse:.1%} of its largest ellipse")
    edge = found.funnel.outline(0.0, (0, 1))
    demand = found.policy.u(0.0) - (edge - found.policy.x(0.0)) @ found.policy.K(0.0).T
    return float(np.abs(demand).max()), TORQUE


if __name__ == "__main__":
    print(main())
