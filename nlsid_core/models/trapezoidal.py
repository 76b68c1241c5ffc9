"""`TrapezoidalModel`: an identified implicit model of a mechanism, its kinematics built in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json
from nlsid_core.errors import ShapeError, SolverError
from nlsid_core.models.signal import Signal
from nlsid_core.models.state_map import read_fields, settle, write_fields
from nlsid_core.polynomial import Polynomial, variables

KIND = "trapezoidal"
NEWTON_STEPS = 30
NEWTON_TOLERANCE = 1e-13  # of the rate's size; quadratic convergence passes it in one more step


@dataclass(frozen=True, eq=False)
class TrapezoidalModel:
    """q⁺ = q + h/2(v + v⁺),  v⁺ = v + h/2 Σ_i coefficients[i]·[(q, v, u)^e_i + (q⁺, v⁺, u)^e_i].

    exponents e: (m, 2d + p) of the monomials in [q; v; u], coefficients: (m, d), accelerations.
    period h in s; the other fields are those of a `StateModel` with the state x = [q; v]. The
    equation has spurious roots far away: what a step means is the root that Newton's method finds
    from v, and what is claimed of one holds where a monitor has seen it to be near.

    Source: (2.7), separable implicit models. Raises ShapeError or DataError on numbers that do not
    fit.
    """

    exponents: IntArray
    coefficients: FloatArray
    period: float
    x: tuple[Signal, ...]
    u: tuple[Signal, ...]
    x_range: FloatArray
    u_range: FloatArray
    noise: FloatArray
    disturbance: FloatArray
    bags: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if len(self.x) % 2:
            raise ShapeError(f"trapezoidal model: {len(self.x)} states are not positions and rates")
        settle(self, len(self.x) // 2)

    def __len__(self) -> int:
        """The number of states 2d."""
        return len(self.x)

    @property
    def joints(self) -> int:
        """d, half the states."""
        return len(self.x) // 2

    def __call__(self, x: ArrayLike, u: ArrayLike) -> FloatArray:
        """x⁺ (..., 2d) of states (..., 2d) under inputs (..., p), by Newton's method from v.

        Raises SolverError if it does not converge.
        """
        state, inputs = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        d, half = self.joints, self.period / 2
        q, v = state[..., :d], state[..., d:]
        known = v + half * self._acceleration(np.concatenate([q, v, inputs], axis=-1))
        rate = v.copy()
        for _ in range(NEWTON_STEPS):
            point = np.concatenate([q + half * (v + rate), rate, inputs], axis=-1)
            with np.errstate(over="ignore", invalid="ignore"):
                residual = rate - half * self._acceleration(point) - known
                slope = self._slope(self._jacobian(point))
            if not (np.isfinite(residual).all() and np.isfinite(slope).all()):
                break
            change = np.linalg.solve(slope, residual[..., None])[..., 0]
            rate = rate - change
            if (np.abs(change) <= NEWTON_TOLERANCE * (1.0 + np.abs(rate).max())).all():
                return np.concatenate([q + half * (v + rate), rate], axis=-1)
        raise SolverError(f"no next rate found from {state.tolist()!s:.200} under these inputs")

    def linearised(self, x: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """∂x⁺/∂x (2d, 2d) and ∂x⁺/∂u (2d, p) at one state and input. Raises as a step."""
        state, inputs = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        d, half, after = self.joints, self.period / 2, self(state, inputs)
        now = self._jacobian(np.concatenate([state, inputs]))
        later = self._jacobian(np.concatenate([after, inputs]))
        right = half * (now + later)  # of q, v and u; q⁺ moves with q and v, v⁺ is left
        right[:, d : 2 * d] += np.eye(d) + half * (half * later[:, :d] - later[:, d : 2 * d])
        rates = np.linalg.solve(self._slope(later), right)
        positions = half * rates
        positions[:, : 2 * d] += np.hstack([np.eye(d), half * np.eye(d)])
        jacobian = np.vstack([positions, rates])
        return jacobian[:, : 2 * d], jacobian[:, 2 * d :]

    def simulate(self, x_start: ArrayLike, u: ArrayLike) -> FloatArray:
        """States (N + 1, 2d) from x_start under inputs u (N, p); NaN after a step that fails."""
        inputs = np.asarray(u, dtype=np.float64)
        states = np.full((len(inputs) + 1, len(self)), np.nan)
        states[0] = x_start
        for k, u_k in enumerate(inputs):
            try:
                states[k + 1] = self(states[k], u_k)
            except SolverError:
                break
        return states

    def equations(self) -> NDArray[np.object_]:
        """(d,) polynomials in x0…, u0…, w0… (next rates) that vanish at a step, q⁺ substituted."""
        d, p = self.joints, len(self.u)
        names = [f"x{i}" for i in range(2 * d)] + [f"u{i}" for i in range(p)]
        following = variables([*names, *(f"w{i}" for i in range(d))])
        x, w = following[: 2 * d], following[2 * d + p :]
        half = self.period / 2
        later = {f"x{i}": x[i] + half * (x[d + i] + w[i]) for i in range(d)}
        later |= {f"x{d + i}": w[i] for i in range(d)}
        rows = np.empty(d, dtype=object)
        for i, column in enumerate(self.coefficients.T):
            now = Polynomial(self.exponents, column, tuple(names))
            rows[i] = w[i] - x[d + i] - half * (now + now.substitute(later))
        return rows

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return write_fields(
            self, KIND, "q+ = q + h/2 (v + v+);  v+ = v + h/2 (a(q, v, u) + a(q+, v+, u))"
        )

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "TrapezoidalModel":
        """Raises DocumentError if the document is not a trapezoidal model."""
        return cls(**read_fields(document, KIND, source=source))

    def _slope(self, jacobian: FloatArray) -> FloatArray:
        """∂(v⁺ - h/2 a(q⁺, v⁺, u))/∂v⁺ (..., d, d) where the acceleration's is `jacobian`."""
        d, half = self.joints, self.period / 2
        rates = jacobian[..., d : 2 * d] + half * jacobian[..., :d]
        return np.asarray(np.eye(d) - half * rates)

    def _acceleration(self, point: FloatArray) -> FloatArray:
        values: FloatArray = np.prod(point[..., None, :] ** self.exponents, axis=-1)
        return values @ self.coefficients

    def _jacobian(self, point: FloatArray) -> FloatArray:
        """(..., d, 2d + p) of the acceleration."""
        columns = []
        for j in range(point.shape[-1]):
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(lowered[:, j] - 1, 0)
            weight = self.exponents[:, j] * np.prod(point[..., None, :] ** lowered, axis=-1)
            columns.append(weight @ self.coefficients)
        return np.stack(columns, axis=-1)
