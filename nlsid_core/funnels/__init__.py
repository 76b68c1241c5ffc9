"""Funnels: a model and a policy in, a funnel with its proof out (thesis Part II)."""

from nlsid_core.funnels.composition import compose_funnels
from nlsid_core.funnels.discrete import TubeDesign, design_tube
from nlsid_core.funnels.riccati import Feedback, discrete_tvlqr
from nlsid_core.funnels.sampled import Sampled, sample_funnel
from nlsid_core.funnels.setting import Goal
from nlsid_core.funnels.trajectory import FunnelDesign, design_funnel
from nlsid_core.funnels.tvlqr import (
    Tracking,
    integrate_nominal,
    lyapunov,
    nominal_through,
    tvlqr,
)

__all__ = [
    "Feedback",
    "FunnelDesign",
    "Goal",
    "Sampled",
    "Tracking",
    "TubeDesign",
    "compose_funnels",
    "design_funnel",
    "design_tube",
    "discrete_tvlqr",
    "integrate_nominal",
    "lyapunov",
    "nominal_through",
    "sample_funnel",
    "tvlqr",
]
