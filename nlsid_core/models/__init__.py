"""Identified models: frozen numbers, a document form, and simulation."""

from nlsid_core.models.difference_equation import DifferenceEquation
from nlsid_core.models.signal import Signal
from nlsid_core.models.state_affine import StateAffineModel

__all__ = ["DifferenceEquation", "Signal", "StateAffineModel"]
