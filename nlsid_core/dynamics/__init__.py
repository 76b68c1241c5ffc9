"""Continuous time: polynomial dynamics, motions, and functions of time in pieces."""

from nlsid_core.dynamics.measured import MeasuredPush, measured_push
from nlsid_core.dynamics.nominal import Nominal
from nlsid_core.dynamics.piecewise import (
    PiecewisePolynomial,
    constant_on,
    cubic_through,
    linear_through,
)
from nlsid_core.dynamics.taylor import Rates, taylor_field
from nlsid_core.dynamics.taylor_model import TaylorModel, solve
from nlsid_core.dynamics.vector_field import VectorField

__all__ = [
    "MeasuredPush",
    "Nominal",
    "PiecewisePolynomial",
    "Rates",
    "TaylorModel",
    "VectorField",
    "constant_on",
    "cubic_through",
    "linear_through",
    "measured_push",
    "solve",
    "taylor_field",
]
