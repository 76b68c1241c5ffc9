"""`Controller`: runs a policy on samples as they come; the live twin of what was proved.

Input k+1 depends on the samples up to k only, so it is known a period before it acts.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.monitor_bank import GRID_TOLERANCE
from nlsid_core.policy import Policy

Input = TypeVar("Input", float, FloatArray)


@dataclass(frozen=True)
class Limits:
    """lowest, highest: of the input, in its unit; stop_rate: its fastest change while stopping, in
    unit/s; stop_at: the input of a robot at rest.

    Raises DataError unless lowest <= stop_at <= highest and stop_rate > 0.
    """

    lowest: float
    highest: float
    stop_rate: float
    stop_at: float = 0.0

    def __post_init__(self) -> None:
        if not (self.lowest <= self.stop_at <= self.highest) or not self.stop_rate > 0.0:
            raise DataError(
                f"limits: {self.stop_at} should be in [{self.lowest}, {self.highest}], "
                f"stop_rate {self.stop_rate} positive"
            )

    def clip(self, u: Input) -> Input:
        """The nearest input that is allowed; of several, each."""
        allowed: Input = np.clip(u, self.lowest, self.highest)
        return allowed

    def towards_stop(self, u: Input, dt: float) -> Input:
        """The input dt s later on the way to `stop_at`."""
        step = self.stop_rate * dt
        nearer: Input = u + np.clip(self.stop_at - u, -step, step)
        return self.clip(nearer)

    def at_rest(self, u: Input) -> bool:
        """Whether every input is where a robot at rest has it."""
        return bool(np.all(u == self.stop_at))


class Controller:
    """u_k = clip(u_k - K(x̂_k - x_k)) with the observer x̂⁺ = A x̂ + B u + f + L(y - ŷ).

    Before sample 0 the plan's first input is held until the last n samples give an x̂ in the
    funnel's inlet, at most for `settling` s. `k` is the index of the next sample, negative before.
    `ended` says why it is over, empty while it runs. `lead`: s from a sample to the stamp of its
    input, which is not quite a period, so that a sample off the grid still finds it in force.
    """

    def __init__(
        self,
        model: DifferenceEquation,
        policy: Policy,
        funnel: Funnel,
        *,
        limits: Limits,
        settling: float,
    ) -> None:
        self.model, self.policy, self.funnel, self.limits = model, policy, funnel, limits
        self._A, self._B, self._offset = model.A, model.B[:, 0], model.offset
        self.ended = ""
        self.lead = (1.0 - GRID_TOLERANCE) * model.period
        self.k = -1
        self.u = limits.clip(float(policy.u[0]))  # the input in force at the next sample
        self._settling = settling
        self._y_lags: deque[float] = deque(maxlen=len(model))
        self._u_lags: deque[float] = deque(maxlen=len(model))
        self._first_t = self._last_t = math.nan
        self._x: FloatArray = np.zeros(len(model))

    def update(self, t: float, y: float) -> float:
        """Take the sample at t (s); the input in force from the next sample on.

        Once `ended`, the input stays where it was: stopping is the caller's.
        """
        if self.ended:
            return self.u
        self.ended = self._fault(t, y)
        if self.ended:
            return self.u
        self._last_t = t
        if self.k < 0:
            self._settle(t, y)
            return self.u
        innovation = y - (self._x[0] + self.model.D * self.u + self.model.c)
        self._x = self._A @ self._x + self._B * self.u + self._offset + self.policy.L * innovation
        self.k += 1
        if self.k >= len(self.policy):
            self.ended = "the plan is over"
        else:
            self.u = self.limits.clip(self.policy(self.k, self._x))
        return self.u

    def _settle(self, t: float, y: float) -> None:
        """Wait for a state in the inlet."""
        if math.isnan(self._first_t):
            self._first_t = t
        self._y_lags.append(y)
        self._u_lags.append(self.u)
        if len(self._y_lags) < len(self.model):
            return
        self._x = self.model.state_after(list(self._y_lags), list(self._u_lags))
        start = self.funnel.value(self._x - self.policy.x[0], 0.0)
        if start <= self.funnel.inlet:
            self.k = 0
            self.u = self.limits.clip(self.policy(0, self._x))
        elif t - self._first_t > self._settling:
            self.ended = (
                f"not at the start of the plan after {self._settling:g} s: V = {start:.3g} above "
                f"the inlet's {self.funnel.inlet:.3g}"
            )

    def _fault(self, t: float, y: float) -> str:
        period = self.model.period
        if not (math.isfinite(t) and math.isfinite(y)):
            return f"{self.model.y.name} is {y} at t = {t:g} s"
        step = t - self._last_t
        if math.isfinite(step) and abs(step - period) > GRID_TOLERANCE * period:
            return f"{step:g} s between samples; the policy's period is {period:g} s"
        return ""
