"""Simulated robots to try the chain on: a model and a vector field."""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError
from nlsid_core.models import DifferenceEquation

STEP = 1e-3  # s, the longest step of integration
FAR = 1e6  # of a state, its unit: equations that went there are of no robot any more


class Plant(Protocol):
    """Something that answers inputs: `measure` at a sample, then `step` to the next."""

    period: float

    def measure(self, u: FloatArray, /) -> FloatArray:
        """What its sensors say under the inputs (p,) in force."""

    def step(self, u: FloatArray, push: FloatArray, /) -> None:
        """Go on by one period under inputs (p,), disturbed by `push` (p,) in the inputs' unit."""


class ModelPlant:
    """x⁺ = A x + B(u + push) + f, y = C x + D u + c, from rest at zero input."""

    def __init__(self, model: DifferenceEquation) -> None:
        self.period = model.period
        self._model = model
        self._A, self._B, self._offset = model.A, model.B, model.offset
        self._x = np.linalg.solve(np.eye(len(model)) - self._A, self._offset)

    def measure(self, u: FloatArray, /) -> FloatArray:
        """The output (1,) under the input in force."""
        return np.asarray(self._x[0] + self._model.D * u + self._model.c)

    def step(self, u: FloatArray, push: FloatArray, /) -> None:
        """One sample of the difference equation."""
        self._x = self._A @ self._x + self._B @ (u + push) + self._offset


class FieldPlant:
    """ẋ = f(t, x, u, w) of any vector field: measured x. w is drawn from its box at every sample.

    It rests at x until the first input that is not zero; its time, which equations may depend on,
    starts at t0 s then. So it does again after a state that is FAR away, as of what falls after a
    stop. x: (n,).
    """

    def __init__(
        self,
        field: VectorField,
        x: FloatArray,
        *,
        period: float,
        t0: float = 0.0,
        rng: "np.random.Generator",
    ) -> None:
        if period <= 0.0 or x.shape != (field.n,) or not np.isfinite(x).all():
            raise DataError(f"a plant of {field.n} states starts at so many numbers, not at {x}")
        self.period, self._field, self._rng = period, field, rng
        self._start, self._t0 = x, t0
        self._x, self._t, self._rests = x, t0, True
        self.inputs = field.m
        still, w = np.zeros((1, field.m)), field.uncertain.mean(axis=1)
        field(t0, x[None], still, w, span=field.span(t0))  # the first takes longer than a sample

    def refuse(self, states: int, inputs: int) -> None:
        """DataError unless so many signals are its states and its inputs."""
        if (states, inputs) != (self._field.n, self.inputs):
            raise DataError(
                f"a vector field of {self._field.n} states and {self.inputs} inputs cannot speak "
                f"through {states} and {inputs} signals; set response and command"
            )

    def measure(self, _u: FloatArray, /) -> FloatArray:
        """The state (n,)."""
        return self._x

    def step(self, u: FloatArray, push: FloatArray, /) -> None:
        """One period."""
        applied = (u + push)[None]
        self._rests = self._rests and not applied.any()
        if self._rests:
            return
        low, high = self._field.uncertain.T
        w, count = self._rng.uniform(low, high), math.ceil(self.period / STEP)
        for _ in range(count):
            span, z = self._field.span(self._t), np.append(self._x, self._t)

            def rate(z: FloatArray, span: int = span) -> FloatArray:
                speed = self._field(float(z[-1]), z[None, :-1], applied, w, span=span)[0]
                return np.append(speed, 1.0)

            with np.errstate(over="ignore", invalid="ignore"):
                z = advanced(rate, z, self.period / count)
            self._x, self._t = z[:-1], float(z[-1])
            if not (np.abs(self._x) < FAR).all():
                self._x, self._t, self._rests = self._start, self._t0, True
                return


def advanced(rate: Callable[[FloatArray], FloatArray], x: FloatArray, h: float) -> FloatArray:
    """x (n,) after h s of ẋ = rate(x), by one step of Runge and Kutta's classical method."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
