"""Funnels: what a proof is about and a monitor holds a robot against."""

from typing import TypeAlias

from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside
from nlsid_core.funnels.sampled import DisturbanceAssumption, SampledFunnel
from nlsid_core.funnels.tube import Measured, Peak, Tube, TubeFunnel

AnyFunnel: TypeAlias = SampledFunnel | ContinuousFunnel | TubeFunnel

__all__ = [
    "AnyFunnel",
    "ContinuousFunnel",
    "DisturbanceAssumption",
    "Measured",
    "Peak",
    "SampledFunnel",
    "Tube",
    "TubeFunnel",
    "ellipsoid_inside",
]
