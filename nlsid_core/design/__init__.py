"""Funnels: a model and a policy in, a funnel with its proof out (thesis Part II)."""

from nlsid_core.design.compose import compose_funnels
from nlsid_core.design.continuous.design import FunnelDesign, design_funnel
from nlsid_core.design.continuous.motion import plan_motion
from nlsid_core.design.continuous.problem import ContinuousTracking, Goal
from nlsid_core.design.continuous.tvlqr import (
    Tracking,
    integrate_nominal,
    lyapunov,
    nominal_through,
    tvlqr,
)
from nlsid_core.design.design import design
from nlsid_core.design.problems import OutputTube, SampledTracking
from nlsid_core.design.riccati import Feedback, discrete_tvlqr
from nlsid_core.design.tube import OutputTubeDesign, design_output_tube

__all__ = [
    "ContinuousTracking",
    "Feedback",
    "FunnelDesign",
    "Goal",
    "OutputTube",
    "OutputTubeDesign",
    "SampledTracking",
    "Tracking",
    "compose_funnels",
    "design",
    "design_funnel",
    "design_output_tube",
    "discrete_tvlqr",
    "integrate_nominal",
    "lyapunov",
    "nominal_through",
    "plan_motion",
    "tvlqr",
]
