"""What a robot runs and is held against: a model, a policy and a funnel that belong together."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core import _json, discrete_funnel
from nlsid_core._types import Json
from nlsid_core.controller import Controller, Limits
from nlsid_core.discrete_funnel import DiscreteFunnel
from nlsid_core.errors import CertificateMismatch
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.models.measured_state import MeasuredState, read_measured_state
from nlsid_core.monitor import Monitor, Nominal
from nlsid_core.policy import Policy
from nlsid_core.tracking_controller import TrackingController
from nlsid_core.tracking_monitor import TrackingMonitor
from nlsid_core.tracking_policy import TrackingPolicy


@dataclass(frozen=True, eq=False)
class LinearDesign:
    """A tube of a difference equation: one response, one excitation."""

    model: DifferenceEquation
    policy: Policy
    funnel: Funnel

    @property
    def name(self) -> str:
        """What is measured, in words."""
        return self.model.y.name

    @property
    def response(self) -> SignalPath:
        """Where the response is read."""
        return SignalPath.parse(self.model.y.path)

    @property
    def command(self) -> SignalPath:
        """Where the excitation is read and written."""
        return SignalPath.parse(self.model.u.path)

    def monitor(self, nominal: Nominal) -> Monitor:
        """A monitor for one run."""
        return Monitor(self.model, self.policy, self.funnel, nominal=nominal)

    def controller(self, limits: Limits, settling: float) -> Controller:
        """A controller for one run; `settling`: s to wait for a state in the inlet."""
        return Controller(self.model, self.policy, self.funnel, limits=limits, settling=settling)


@dataclass(frozen=True, eq=False)
class TrackingDesign:
    """A discrete funnel of a state model: the whole state measured, several inputs."""

    model: MeasuredState
    policy: TrackingPolicy
    funnel: DiscreteFunnel

    @property
    def name(self) -> str:
        """What is measured, in words."""
        return ", ".join(signal.name for signal in self.model.x)

    @property
    def response(self) -> SignalVector:
        """Where the state is read; BagError if not on one topic."""
        return SignalVector.parse(signal.path for signal in self.model.x)

    @property
    def command(self) -> SignalVector:
        """Where the inputs are read and written; BagError if not on one topic."""
        return SignalVector.parse(signal.path for signal in self.model.u)

    def monitor(self, _nominal: Nominal) -> TrackingMonitor:
        """A monitor for one run; the funnel is always around the policy's plan."""
        return TrackingMonitor(self.model, self.policy, self.funnel)

    def controller(self, limits: Limits, settling: float) -> TrackingController:
        """A controller for one run; `settling`: s to wait for a state in the inlet."""
        return TrackingController(
            self.model, self.policy, self.funnel, limits=limits, settling=settling
        )


Design: TypeAlias = LinearDesign | TrackingDesign


def read_design(documents: Mapping[str, Json]) -> Design:
    """The documents `model`, `policy` and `funnel` as what they are; the funnel's kind decides.

    Raises DocumentError if one is not what it should be, CertificateMismatch if they do not belong
    together.
    """
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    design: Design
    if funnel.get("kind") == discrete_funnel.KIND:
        design = TrackingDesign(
            read_measured_state(model),
            TrackingPolicy.from_document(policy),
            DiscreteFunnel.from_document(funnel),
        )
    else:
        design = LinearDesign(
            DifferenceEquation.from_document(model),
            Policy.from_document(policy),
            Funnel.from_document(funnel),
        )
    if _json.digest(policy) != design.funnel.policy:
        raise CertificateMismatch("the funnel was made for another policy")
    if _json.digest(model) != design.funnel.model:
        raise CertificateMismatch("the funnel was made for another model")
    return design
