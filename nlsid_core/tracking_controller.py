"""`TrackingController`: runs a tracking policy on samples as they come; the live twin of its proof.

Input k depends on sample k, so it is stamped with that sample and has the period to get there.
"""

import math

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.controller import Limits
from nlsid_core.discrete_funnel import DiscreteFunnel
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.monitor import GRID_TOLERANCE
from nlsid_core.tracking_monitor import StateObserver
from nlsid_core.tracking_policy import TrackingPolicy


class TrackingController:
    """u_k = clip(u_k - K_k(x̂_k - x_k)), x̂ the estimate of the `StateObserver` that starts at y_0.

    The first sample in the tube's start is sample 0; until then, at most `settling` s, the plan's
    first input is held. `k` is the index of the next sample, -1 before sample 0. `ended` says
    why it is over, empty while it runs. `lead`: s from a sample to the stamp of its input.
    """

    lead = 0.0

    def __init__(
        self,
        model: MeasuredState,
        policy: TrackingPolicy,
        funnel: DiscreteFunnel,
        *,
        limits: Limits,
        settling: float,
    ) -> None:
        self.model, self.policy, self.funnel, self.limits = model, policy, funnel, limits
        self.ended = ""
        self.k = -1
        self.u: FloatArray = limits.clip(policy.u[0])
        self._settling = settling
        self._observer = StateObserver(model, policy.L)
        self._first_t = self._last_t = math.nan

    def update(self, t: float, y: FloatArray) -> FloatArray:
        """Take the sample y (n,) at t (s); the input (p,) from this sample on.

        Once `ended`, the input stays where it was: stopping is the caller's.
        """
        self.ended = self.ended or self._fault(t, y)
        if self.ended:
            return self.u
        self._last_t = t
        if self.k < 0:
            self._settle(t, y)
            return self.u
        x = self._observer.update(y, self.u)
        self.k += 1
        if self.k > len(self.policy):
            self.ended = "the plan is over"
        else:
            self.u = self.limits.clip(self.policy(self.k - 1, x))
        return self.u

    def _settle(self, t: float, y: FloatArray) -> None:
        """Wait for a state in the tube's start."""
        if math.isnan(self._first_t):
            self._first_t = t
        size = float(np.linalg.norm(self.funnel.S[0] @ (y - self.policy.x[0])))
        if size <= self.funnel.tube[0]:
            self.k = 1
            self.u = self.limits.clip(self.policy(0, self._observer.update(y, None)))
        elif t - self._first_t > self._settling:
            self.ended = (
                f"not at the start of the plan after {self._settling:g} s: {size:.3g} above the "
                f"tube's {self.funnel.tube[0]:.3g}"
            )

    def _fault(self, t: float, y: FloatArray) -> str:
        period = self.model.period
        if not (math.isfinite(t) and np.isfinite(y).all()):
            return f"the state is {y} at t = {t:g} s"
        step = t - self._last_t
        if math.isfinite(step) and abs(step - period) > GRID_TOLERANCE * period:
            return f"{step:g} s between samples; the policy's period is {period:g} s"
        return ""
