"""Identified models: frozen numbers, a document form, and simulation."""

from typing import TypeAlias

from nlsid_core.models.block_cascade import BlockCascade
from nlsid_core.models.cell_network import CellNetwork, PiecewiseLinear
from nlsid_core.models.difference_equation import DifferenceEquation
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.monotone_equation import MonotoneEquation
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.models.signal import Signal, signals_of
from nlsid_core.models.spline import Spline
from nlsid_core.models.state_affine import StateAffineModel
from nlsid_core.models.state_map import StateModel

# Models of recorded inputs and outputs that may be proved to forget their start.
StableModel: TypeAlias = (
    DifferenceEquation
    | StateAffineModel
    | BlockCascade
    | CellNetwork
    | MonotoneEquation
    | ImplicitModel
)

__all__ = [
    "BlockCascade",
    "CellNetwork",
    "DifferenceEquation",
    "ImplicitModel",
    "MonotoneEquation",
    "PiecewiseLinear",
    "Polynomials",
    "Signal",
    "Spline",
    "StableModel",
    "StateAffineModel",
    "StateModel",
    "signals_of",
]
