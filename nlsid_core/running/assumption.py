"""What a funnel's proof assumes, measured sample by sample: which part of it is used, 1 = all."""

import math

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.running.observer import StateObserver


class DisturbanceMeter:
    """What an assumption bounds, sample by sample; see `DisturbanceAssumption`."""

    def __init__(
        self, S: FloatArray, A: FloatArray, form: str, rate: float = 1.0, gain: float = 1.0
    ) -> None:
        self._S, self._A, self._form, self._rate, self._gain = S, A, form, rate, gain
        self.restart()

    def restart(self) -> None:
        """A new run: nothing is used."""
        self._r: FloatArray = np.zeros(self._S.shape[1])
        self._energy = 0.0

    def update(self, k: int, d: FloatArray) -> float:
        """The quantity at sample k > 0, d (n,) being the observer's correction there."""
        size = float(np.linalg.norm(self._S[k] @ d))
        if self._form == "peak":
            return size
        if self._form == "response":
            self._r = self._A[k - 1] @ self._r + d
            return float(np.linalg.norm(self._S[k] @ self._r))
        self._energy = self._rate * self._energy + self._gain * size**2
        return math.sqrt(self._energy)


def meter_of(funnel: SampledFunnel) -> DisturbanceMeter:
    """The meter of what this funnel assumes."""
    a = funnel.assumption
    return DisturbanceMeter(funnel.S, funnel.A, a.form, a.rate, a.gain)


def disturbance_of(
    model: MeasuredState,
    policy: SampledPolicy,
    run: Trajectory,
    meter: DisturbanceMeter,
) -> FloatArray:
    """(N + 1,) what the meter's assumption bounds, along a run of the policy.

    The run starts with sample 0 of the nominal; y is the measured state, u what was applied.
    Raises DataError if it is shorter than the policy.
    """
    if len(run) < len(policy):
        raise DataError(f"{run.name}: {len(run)} samples, the policy has {len(policy)} steps")
    observer = StateObserver(model, policy.L)
    meter.restart()
    sizes = np.zeros(len(policy) + 1)
    last = min(len(run) - 1, len(policy))
    for k in range(last + 1):
        observer.update(run.y[k], run.u[k - 1] if k else None)
        if k:
            sizes[k] = meter.update(k, observer.d)
    return sizes
