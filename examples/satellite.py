"""The tumbling satellite of thesis Chapter 7: dynamics, nominal motion, TVLQR, and its L-steps.

State x = [σ; ω]: modified Rodrigues parameters (dimensionless) and body rates in rad/s; input u:
torques in N m. P_G is used as printed.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from nlsid_core.arrays import FloatArray
from nlsid_core.polynomial import Polynomial, trace, variables

INERTIA = np.array([5.0, 3.0, 2.0])  # kg m², principal axes
FINAL_TIME = 5.0  # s
KNOTS = 49
SAMPLES_PER_INTERVAL = 4
DECAY = 3.0  # of the first ρ(t) = exp(-c (t_f - t)/t_f)
R_INVERSE = 0.1  # R = 10 I
COUPLING = np.diag([12.1205, 7.2723, 4.8482])
GOAL = np.block(
    [
        [np.diag([36.1704, 17.4283, 9.8911]), COUPLING],
        [COUPLING, np.diag([9.1505, 7.3484, 6.2557])],
    ]
)
NAMES = ("s1", "s2", "s3", "w1", "w2", "w3")


def dynamics(x: Any, u: Any) -> Any:
    """ẋ; x (6,) and u (3,) may hold numbers or polynomials."""
    sigma, omega = x[:3], x[3:]
    H = np.diag(INERTIA)
    cross = np.array(_cross(sigma, omega))
    kinematics = ((1 - sigma @ sigma) * omega + 2 * sigma * (sigma @ omega) + 2 * cross) / 4
    torque = u - np.array(_cross(omega, H @ omega))
    return np.concatenate([kinematics, torque * (1 / INERTIA)])


def nominal_input(t: float) -> FloatArray:
    """u₀(t) in N m."""
    return t * (t - 5) * (t + 5) / 100 * np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Nominal:
    """At the knots t (49,): x₀ (a cubic between), S (49, 6, 6) of the TVLQR, K (48, 3, 6)."""

    t: FloatArray
    x: CubicHermiteSpline
    S: FloatArray
    K: FloatArray


@dataclass(frozen=True, eq=False)
class LStep:
    """One sample: g(z) = (ρ̇ - Ẇ)/ρ in normalised coordinates, in 1/s; maximise m ≤ g on |z| = 1.

    error(z): ẋ - ẋ₀ in x̄ = T z; T = √ρ L⁻ᵀ, P = LL'.
    """

    time: float
    P: FloatArray
    P_rate: FloatArray
    rho: float
    rho_rate: float
    T: FloatArray
    offset: FloatArray
    K: FloatArray
    u: FloatArray
    x_rate: FloatArray

    def polynomial(self) -> Polynomial:
        """g as a polynomial in z0..z5."""
        x_bar = self.T @ np.array(variables([f"z{i}" for i in range(6)]))
        moved = dynamics(self.offset + x_bar, self.u - self.K @ x_bar) - self.x_rate
        W_rate = 2 * (self.P @ x_bar) @ moved + x_bar @ (self.P_rate @ x_bar)
        g: Polynomial = (self.rho_rate - W_rate) / self.rho
        return g

    def values(self, z: FloatArray) -> FloatArray:
        """g at points (N, 6), straight from the vector field."""
        x_bar = z @ self.T.T
        x = (self.offset + x_bar).T
        u = (self.u - x_bar @ self.K.T).T
        rate = np.array(_vectorised(x, u)).T - self.x_rate
        W_rate = 2 * np.einsum("ij,ij->i", x_bar @ self.P, rate)
        W_rate += np.einsum("ij,ij->i", x_bar @ self.P_rate, x_bar)
        return np.asarray((self.rho_rate - W_rate) / self.rho)


def nominal() -> Nominal:
    """Integrate x₀ and S backward from t = 5 s, x₀(5) = 0, S(5) = 1.01 P_G, Q = I."""
    t = np.linspace(0.0, FINAL_TIME, KNOTS)
    motion = solve_ivp(
        lambda s, x: dynamics(x, nominal_input(s)),
        (FINAL_TIME, 0.0),
        np.zeros(6),
        rtol=1e-11,
        atol=1e-12,
        dense_output=True,
    )
    field = [f.rounded() for f in trace(dynamics, {"x": 6, "u": 3})]
    jacobian = [[f.derivative(f"x{j}") for j in range(6)] for f in field]
    B = np.vstack([np.zeros((3, 3)), np.diag(1 / INERTIA)])

    def riccati(s: float, flat: FloatArray) -> FloatArray:
        S = flat.reshape(6, 6)
        point = np.r_[motion.sol(s), nominal_input(s)]
        A = np.array([[entry(point) for entry in row] for row in jacobian])
        return np.asarray(-(A.T @ S + S @ A - R_INVERSE * S @ B @ B.T @ S + np.eye(6)).ravel())

    cost = solve_ivp(
        riccati, (FINAL_TIME, 0.0), (1.01 * GOAL).ravel(), rtol=1e-9, atol=1e-10, t_eval=t[::-1]
    )
    S = cost.y.T[::-1].reshape(-1, 6, 6)
    S = (S + S.transpose(0, 2, 1)) / 2
    x = motion.sol(t).T
    rates = np.array([dynamics(x[k], nominal_input(s)) for k, s in enumerate(t)])
    return Nominal(
        t, CubicHermiteSpline(t, x, rates), S, R_INVERSE * np.einsum("ji,kjl->kil", B, S)[:-1]
    )


def l_steps(motion: Nominal) -> list[LStep]:
    """The 192 L-steps of the first iteration: 4 samples, ends included, in each of 48 intervals."""
    steps = []
    for k, (start, end) in enumerate(zip(motion.t[:-1], motion.t[1:], strict=True)):
        rate = (motion.S[k + 1] - motion.S[k]) / (end - start)
        for s in np.linspace(0, 1, SAMPLES_PER_INTERVAL):
            t = float(start + s * (end - start))
            P = motion.S[k] + (t - start) * rate
            rho = float(np.exp(-DECAY * (FINAL_TIME - t) / FINAL_TIME))
            T = np.sqrt(rho) * np.linalg.inv(np.linalg.cholesky(P)).T
            steps.append(
                LStep(
                    time=t,
                    P=P,
                    P_rate=rate,
                    rho=rho,
                    rho_rate=rho * DECAY / FINAL_TIME,
                    T=T,
                    offset=motion.x(t),
                    K=motion.K[k],
                    u=nominal_input(t),
                    x_rate=motion.x.derivative()(t),
                )
            )
    return steps


def _cross(a: Any, b: Any) -> tuple[Any, Any, Any]:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _vectorised(x: FloatArray, u: FloatArray) -> Any:
    """`dynamics` for columns of points: x (6, N), u (3, N)."""
    sigma, omega = x[:3], x[3:]
    square, inner = (sigma * sigma).sum(axis=0), (sigma * omega).sum(axis=0)
    cross = np.array(_cross(sigma, omega))
    kinematics = ((1 - square) * omega + 2 * sigma * inner + 2 * cross) / 4
    torque = u - np.array(_cross(omega, INERTIA[:, None] * omega))
    return np.concatenate([kinematics, torque / INERTIA[:, None]])
