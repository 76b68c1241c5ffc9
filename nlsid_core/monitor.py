"""`Monitor`: where is the running robot relative to its funnel, and is the assumption still kept?

One sample in, one `Reading` out; offline replay and the live node call the same code on the same
numbers, so their margins are equal bit for bit. A positive margin is good. Missing, stale or NaN
state reads as unknown, never as inside.
"""

from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.monitor_bank import COMMAND_TOLERANCE, GRID_TOLERANCE, MonitorBank
from nlsid_core.policy import Policy
from nlsid_core.reading import Nominal, Reading, Status

__all__ = [
    "COMMAND_TOLERANCE",
    "GRID_TOLERANCE",
    "Monitor",
    "MonitorBank",
    "Nominal",
    "Reading",
    "Status",
]


class Monitor:
    """Holds samples (t, y, u) of one run against a funnel: a `MonitorBank` of one.

    Raises CertificateMismatch if model, policy and funnel do not belong together.
    """

    def __init__(
        self,
        model: DifferenceEquation,
        policy: Policy,
        funnel: Funnel,
        *,
        nominal: Nominal = Nominal.COMMAND,
    ) -> None:
        self._bank = MonitorBank(model, [(policy, funnel)], nominal=nominal)
        self.model, self.policy, self.funnel, self.nominal = model, policy, funnel, nominal

    @property
    def lags(self) -> int:
        """Samples before an announced start that give the observer its state."""
        return len(self.model)

    def waiting(self, t: float, y: float, reason: str) -> Reading:
        """The reading at t (s) of a sample y before the run's start."""
        return Reading(t, Status.UNKNOWN, measured=y, reason=reason)

    def restart(self) -> None:
        """Begin a new run: forget lags, budget and why the last run ended."""
        self._bank.restart()

    def missing(self, t: float, reason: str) -> Reading:
        """End the run because the state is missing or stale at time t (s): unknown from here on."""
        return self._bank.missing(t, reason)[0]

    def update(self, t: float, y: float, u: float) -> Reading:
        """The reading at stamp t (s) for output y and the input u applied from t on."""
        return self._bank.update(t, y, u)[0]
