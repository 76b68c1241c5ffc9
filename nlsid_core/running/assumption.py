"""What a funnel's proof assumes, measured sample by sample: which part of it is used, 1 = all."""

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.running.observer import StateObserver


class DisturbanceMeter:
    """What an assumption bounds, sample by sample; see `DisturbanceAssumption`.

    S: (N + 1, n, n) and A: (N, n, n) of the funnel.
    """

    def __init__(self, S: FloatArray, A: FloatArray) -> None:
        self._S, self._A = S, A
        self.restart()

    def restart(self) -> None:
        """A new run: nothing is used."""
        self._r: FloatArray = np.zeros(self._S.shape[1])

    def update(self, k: int, d: FloatArray) -> float:
        """The quantity at sample k > 0, d (n,) being the observer's correction there."""
        self._r = self._A[k - 1] @ self._r + d
        return float(np.linalg.norm(self._S[k] @ self._r))


def disturbance_of(
    model: StateModel,
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
