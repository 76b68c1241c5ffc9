"""Identified models: frozen numbers, a document form, and simulation."""

from nlsid_core.models.block_cascade import BlockCascade
from nlsid_core.models.difference_equation import DifferenceEquation
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.monotone_equation import MonotoneEquation
from nlsid_core.models.signal import Signal
from nlsid_core.models.spline import Spline
from nlsid_core.models.state_affine import StateAffineModel
from nlsid_core.models.state_map import StateModel
from nlsid_core.models.trapezoidal import TrapezoidalModel

__all__ = [
    "BlockCascade",
    "DifferenceEquation",
    "ImplicitModel",
    "MonotoneEquation",
    "Signal",
    "Spline",
    "StateAffineModel",
    "StateModel",
    "TrapezoidalModel",
]
