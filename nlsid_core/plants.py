"""Simulated robots to try the chain on: an identified model, and a pendulum."""

import math
from typing import Protocol

import numpy as np

from nlsid_core.errors import DataError
from nlsid_core.models import DifferenceEquation


class Plant(Protocol):
    """Something that answers inputs: `measure` at a sample, then `step` to the next."""

    period: float

    def measure(self, u: float) -> float:
        """The output under the input in force."""

    def step(self, u: float, push: float) -> None:
        """Go on by one period under input u, disturbed by `push` in the input's unit."""


class ModelPlant:
    """x⁺ = A x + B(u + push) + f, y = C x + D u + c, from rest at zero input."""

    def __init__(self, model: DifferenceEquation) -> None:
        self.period = model.period
        self._model = model
        self._A, self._B, self._offset = model.A, model.B[:, 0], model.offset
        self._x = np.linalg.solve(np.eye(len(model)) - self._A, self._offset)

    def measure(self, u: float) -> float:
        """The output under the input in force."""
        return float(self._x[0] + self._model.D * u + self._model.c)

    def step(self, u: float, push: float) -> None:
        """One sample of the difference equation."""
        self._x = self._A @ self._x + self._B * (u + push) + self._offset


class Pendulum:
    """q̈ = -(g/l) sin q - d q̇ + u/(m l²): the angle q (rad) under a torque u (N m), from rest.

    Integrated by the classical Runge-Kutta method with steps of at most 1 ms.
    """

    GRAVITY = 9.81  # m/s²
    STEP = 1e-3  # s

    def __init__(
        self, period: float, *, length: float = 0.5, mass: float = 1.0, damping: float = 0.5
    ) -> None:
        if min(period, length, mass) <= 0.0 or damping < 0.0:
            raise DataError(f"pendulum: {period} s, {length} m, {mass} kg should be positive")
        self.period = period
        self._stiffness, self._damping = self.GRAVITY / length, damping
        self._gain = 1.0 / (mass * length**2)
        self._q, self._v = 0.0, 0.0

    def measure(self, u: float) -> float:  # noqa: ARG002 - the torque acts on the acceleration
        """The angle."""
        return self._q

    def step(self, u: float, push: float) -> None:
        """One period."""
        count = math.ceil(self.period / self.STEP)
        h = self.period / count
        for _ in range(count):
            q, v = self._q, self._v
            a1 = self._acceleration(q, v, u + push)
            v2 = v + h / 2 * a1
            a2 = self._acceleration(q + h / 2 * v, v2, u + push)
            v3 = v + h / 2 * a2
            a3 = self._acceleration(q + h / 2 * v2, v3, u + push)
            v4 = v + h * a3
            a4 = self._acceleration(q + h * v3, v4, u + push)
            self._q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            self._v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def _acceleration(self, q: float, v: float, torque: float) -> float:
        return -self._stiffness * math.sin(q) - self._damping * v + self._gain * torque
