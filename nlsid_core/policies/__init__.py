"""Policies: a plan and the feedback around it, of each kind of funnel."""

from typing import TypeAlias

from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.policies.tube import TubePolicy

AnyPolicy: TypeAlias = TubePolicy | SampledPolicy | ContinuousPolicy

__all__ = [
    "AnyPolicy",
    "ContinuousPolicy",
    "SampledPolicy",
    "TubePolicy",
]
