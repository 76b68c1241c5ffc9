"""A 12-state quadrotor that climbs 3 m in 3 s and drifts sideways, and its cubic Taylor model.

State x = [p; v; σ; ω]: position in m, velocity in m/s, modified Rodrigues parameters, body rates in
rad/s. Input u = [T; τ]: thrust in N along the body's third axis, torques in N m.
"""

from typing import Any

import numpy as np
from scipy.linalg import solve_continuous_are

from nlsid import Nominal, VectorField, integrate_nominal
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, FunnelDesign, design_funnel

MASS, GRAVITY = 0.5, 9.81  # kg, m/s²
INERTIA = np.array([0.0032, 0.0032, 0.0055])  # kg m²
FINAL_TIME, CLIMB = 3.0, 3.0
KNOTS, LEVEL = 31, 0.1  # level: of the goal, in the hover LQR's cost
TILT, THRUST = 0.06, 1.8  # where the expansion is bounded: |σ_i|, and |T - mg| in N
ROUNDING_ROOM = 1.0001  # the bounds are computed in floating point
Q = np.diag([10.0] * 3 + [4.0] * 3 + [40.0] * 3 + [2.0] * 3)
R = np.diag([1.0, 400.0, 400.0, 400.0])


def taylor(x: Any, u: Any, w: Any) -> Any:
    """ẋ to third order in σ and T - mg, plus w (3,), what the rotation's expansion leaves out."""
    v, s, rates = x[3:6], x[6:9], x[9:12]
    hover = MASS * GRAVITY
    square = s[0] * s[0] + s[1] * s[1] + s[2] * s[2]
    tilt = np.array([s[1], -s[0], 0 * s[0]])
    bend = np.array([s[0] * s[2], s[1] * s[2], -s[0] * s[0] - s[1] * s[1]])
    second = 4 * tilt + 8 * bend
    lift = hover * (second - 12 * square * tilt) + (u[0] - hover) * second
    lift = lift + np.array([0 * u[0], 0 * u[0], u[0]])
    acceleration = lift * (1 / MASS) - np.array([0.0, 0.0, GRAVITY])
    return np.concatenate([v, acceleration + w, attitude(s, rates), spin(rates, u[1:4])])


def remainder(tilt: float, thrust: float) -> FloatArray:
    """(3,) bounds of |v̇ - its expansion| in m/s² where every |σ_i| ≤ tilt and |T - mg| ≤ thrust.

    With q = |σ|², a = 4(1-q)/(1+q)² - 4 and b = 8/(1+q)² - 8, the expansion takes -12q for a at
    T = mg, 0 for the rest of a, and 0 for b. |a| ≤ 12q, |a + 12q| ≤ 20q² and |b| ≤ 16q bound
    what is left out:
    mg/m·20q²|σ| + |T - mg|/m·12q|σ| + T/m·16q·|σ_iσ_3|, and T/m·16q(σ_1² + σ_2²) along the axis.
    """
    q = 3 * tilt**2
    most = (MASS * GRAVITY + thrust) / MASS
    side = GRAVITY * 20 * q**2 * tilt + thrust / MASS * 12 * q * tilt + most * 16 * q * tilt**2
    axis = most * 16 * q * 2 * tilt**2
    return ROUNDING_ROOM * np.array([side, side, axis])


def attitude(s: Any, w: Any) -> Any:
    """σ̇ = ¼((1-|σ|²)ω + 2σ×ω + 2σ(σ'ω)); exact."""
    square = s[0] * s[0] + s[1] * s[1] + s[2] * s[2]
    inner = s[0] * w[0] + s[1] * w[1] + s[2] * w[2]
    return np.array(
        [((1 - square) * w[i] + 2 * cross(s, w)[i] + 2 * inner * s[i]) / 4 for i in range(3)]
    )


def spin(w: Any, torque: Any) -> Any:
    """ω̇ = J⁻¹(τ - ω × Jω); exact."""
    gyro = cross(w, [INERTIA[i] * w[i] for i in range(3)])
    return np.array([(torque[i] - gyro[i]) * (1 / INERTIA[i]) for i in range(3)])


def cross(a: Any, b: Any) -> list[Any]:
    """a × b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def truth(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (12, N) without any expansion, for x (12, N) and u (4, N)."""
    v, s, w = x[3:6], x[6:9], x[9:12]
    square = (s * s).sum(axis=0)
    scale = 1 / (1 + square) ** 2
    tilt = np.stack([s[1], -s[0], 0 * s[0]])
    bend = np.stack([s[0] * s[2], s[1] * s[2], -s[0] * s[0] - s[1] * s[1]])
    third = scale * (8 * bend + 4 * (1 - square) * tilt)
    third[2] += 1
    acceleration = u[0] / MASS * third
    acceleration[2] -= GRAVITY
    return np.concatenate([v, acceleration, attitude(s, w), spin(w, u[1:4])])


def inputs(t: float) -> FloatArray:
    """Thrust of a rest-to-rest climb, and roll and pitch torques that tilt it; cubic in t."""
    s = t / FINAL_TIME
    lift = CLIMB / FINAL_TIME**2 * (60 * s - 180 * s**2 + 120 * s**3)
    swing = s * (1 - s) * (1 - 2 * s)
    return np.array([MASS * (GRAVITY + lift), 0.0015 * swing, -0.0015 * swing, 0.0])


def designed(knots: int = KNOTS, level: float = LEVEL) -> FunnelDesign:
    """The funnel into {LQR cost in hover ≤ level}; Q and R scaled alike keep the LQR's gains."""
    field, nominal, S = problem(knots)
    return design_funnel(
        ContinuousTracking(field, nominal, goal=S / level, Q=Q / level, R=R / level)
    )


def problem(knots: int) -> tuple[VectorField, Nominal, FloatArray]:
    """The cubic model, the motion, and a goal: a level of the hover LQR's cost."""
    most = remainder(TILT, THRUST)
    hover = MASS * GRAVITY
    valid = [[6 + i, -TILT, TILT] for i in range(3)] + [[12, hover - THRUST, hover + THRUST]]
    field = VectorField.from_function(
        taylor,
        12,
        4,
        uncertain=np.stack([-most, most], axis=1),
        valid=valid,
        expansion="a cubic expansion of the rotation, with a remainder bounded by hand in "
        "examples/quadrotor.py",
    )
    nominal = integrate_nominal(
        field, inputs, t=np.linspace(0, FINAL_TIME, knots), start=np.zeros(12)
    )
    A, B = field.jacobians(FINAL_TIME, nominal.x.ends()[-1], nominal.u.ends()[-1])
    S = solve_continuous_are(A, B, Q, R)
    return field, nominal, np.asarray((S + S.T) / 2)
