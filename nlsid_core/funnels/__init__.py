"""Funnels: a model and a policy in, a funnel with its proof out (thesis Part II)."""

from nlsid_core.funnels.discrete import TubeDesign, design_tube

__all__ = ["TubeDesign", "design_tube"]
