"""`TrapezoidalModel`: an identified implicit model of a mechanism, its kinematics built in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core._types import ArrayLike, FloatArray, IntArray
from nlsid_core.errors import DataError, ShapeError, SolverError
from nlsid_core.polynomial import Polynomial, variables

NEWTON_STEPS = 30
NEWTON_TOLERANCE = 1e-13  # of the rate's size; quadratic convergence passes it in one more step


@dataclass(frozen=True, eq=False)
class TrapezoidalModel:
    """q⁺ = q + h/2(v + v⁺),  v⁺ = v + h/2 Σ_i coefficients[i]·[(q, v, u)^e_i + (q⁺, v⁺, u)^e_i].

    exponents e: (m, 2d + p) of the monomials in [q; v; u], coefficients: (m, d), accelerations.
    period h in s. rate_range: (d, 2), the box of the rates in the data: `step` refuses a root
    outside it, as the equation has spurious ones there.

    Source: (2.7), separable implicit models. Raises ShapeError or DataError on numbers that do not
    fit.
    """

    exponents: IntArray
    coefficients: FloatArray
    period: float
    rate_range: FloatArray

    def __post_init__(self) -> None:
        m, d = self.coefficients.shape
        if self.exponents.shape[0] != m or self.exponents.shape[1] <= 2 * d:
            raise ShapeError("trapezoidal model: exponents should be (m, 2d + p), p > 0")
        if self.rate_range.shape != (d, 2):
            raise ShapeError(f"trapezoidal model: rate_range should have shape ({d}, 2)")
        if not (np.isfinite(self.coefficients).all() and self.period > 0):
            raise DataError("trapezoidal model: coefficients or period are not usable")
        for key in ("exponents", "coefficients", "rate_range"):
            getattr(self, key).setflags(write=False)

    def __len__(self) -> int:
        """The number of joints d; the state [q; v] has 2d entries."""
        return int(self.coefficients.shape[1])

    def step(self, x: ArrayLike, u: ArrayLike) -> FloatArray:
        """The next state (2d,) from x (2d,) under u (p,), by Newton's method from v.

        Raises SolverError if it does not converge to a rate within the data's box.
        """
        state, inputs = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        d, half = len(self), self.period / 2
        q, v = state[:d], state[d:]
        known = v + half * self._acceleration(np.concatenate([q, v, inputs]))
        rate = v.copy()
        for _ in range(NEWTON_STEPS):
            point = np.concatenate([q + half * (v + rate), rate, inputs])
            residual = rate - half * self._acceleration(point) - known
            jacobian = self._jacobian(point)
            slope = np.eye(d) - half * (jacobian[:, d : 2 * d] + half * jacobian[:, :d])
            change = np.linalg.solve(slope, residual)
            rate = rate - change
            if np.abs(change).max() <= NEWTON_TOLERANCE * (1.0 + np.abs(rate).max()):
                break
        else:
            raise SolverError(f"no next rate found from {state.tolist()} under {inputs.tolist()}")
        if ((rate < self.rate_range[:, 0]) | (rate > self.rate_range[:, 1])).any():
            raise SolverError(f"next rate {rate.tolist()} is outside the box of the data")
        return np.concatenate([q + half * (v + rate), rate])

    def simulate(self, x_start: ArrayLike, u: ArrayLike) -> FloatArray:
        """States (N + 1, 2d) from x_start under inputs u (N, p); raises as `step`."""
        states: list[FloatArray] = [np.asarray(x_start, dtype=np.float64)]
        for inputs in np.asarray(u, dtype=np.float64):
            states.append(self.step(states[-1], inputs))
        return np.array(states)

    def equations(self) -> NDArray[np.object_]:
        """(d,) polynomials in x0…, u0…, w0… (next rates) that vanish at a step, q⁺ substituted."""
        d, p = len(self), self.exponents.shape[1] - 2 * len(self)
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

    def _acceleration(self, point: FloatArray) -> FloatArray:
        values: FloatArray = np.prod(point**self.exponents, axis=1) @ self.coefficients
        return values

    def _jacobian(self, point: FloatArray) -> FloatArray:
        """(d, 2d + p) of the acceleration."""
        columns = []
        for j in range(len(point)):
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(lowered[:, j] - 1, 0)
            weight = self.exponents[:, j] * np.prod(point**lowered, axis=1)
            columns.append(weight @ self.coefficients)
        return np.array(columns).T
