"""Observers: from what is measured and applied to the state that a policy answers.

Controller, commissioning, replay and monitor share them, so that they agree bit for bit. lags:
samples before sample 0 that give one its state. ahead: 1 if the state after a sample is that of the
next one, 0 if it is that of the sample itself.
"""

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.models import DifferenceEquation, StateModel


class PredictingObserver:
    """x̂⁺ = A x̂ + B u + f + L(y - ŷ), ŷ = C x̂ + D u + c: a difference equation's."""

    ahead = 1

    def __init__(self, model: DifferenceEquation, L: FloatArray) -> None:
        self.lags, self._model, self._L = len(model), model, L
        self._A, self._B, self._offset = model.A, model.B[:, 0], model.offset
        self._x: FloatArray = np.zeros(len(model))

    def begin(self, y: list[float], u: list[float]) -> FloatArray:
        """The state of sample 0 from the n samples before it."""
        self._x = self._model.state_after(y, u)
        return self._x

    def update(self, y: float, u: float) -> FloatArray:
        """The state of the next sample."""
        innovation = y - (self._x[0] + self._model.D * u + self._model.c)
        self._x = self._A @ self._x + self._B * u + self._offset + self._L * innovation
        return self._x


class StateObserver:
    """x̂⁺ = f(x̂, u) + d, d = L(y⁺ - f(x̂, u)), from x̂_0 = y_0."""

    lags, ahead = 0, 0

    def __init__(self, model: StateModel, L: FloatArray) -> None:
        self._model, self._L = model, L
        self.x: FloatArray | None = None
        self.d: FloatArray = np.zeros(len(model))

    def begin(self, y: list[FloatArray], _u: list[FloatArray]) -> FloatArray:
        """The measured state is the estimate."""
        self.x = np.array(y[-1])
        return self.x

    def update(self, y: FloatArray, u: FloatArray | None) -> FloatArray:
        """The estimate (n,) at this sample, from y (n,) and the input (p,) since the last one."""
        if self.x is None or u is None:
            return self.begin([y], [])
        predicted = self._model(self.x, u)
        self.d = self._L @ (y - predicted)
        self.x = predicted + self.d
        return self.x


class MeasuredStateObserver:
    """The state is what is measured."""

    lags, ahead = 0, 0

    def begin(self, y: list[FloatArray], _u: list[FloatArray]) -> FloatArray:
        """The measured state."""
        return y[-1]

    def update(self, y: FloatArray, _u: FloatArray) -> FloatArray:
        """The measured state."""
        return y
