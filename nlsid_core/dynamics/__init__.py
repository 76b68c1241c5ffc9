"""Continuous time: polynomial dynamics, motions, and functions of time in pieces."""

from nlsid_core.dynamics.nominal import Nominal
from nlsid_core.dynamics.piecewise import (
    PiecewisePolynomial,
    constant_on,
    cubic_through,
    linear_through,
)
from nlsid_core.dynamics.taylor import expand, taylor_field
from nlsid_core.dynamics.vector_field import VectorField

__all__ = [
    "Nominal",
    "PiecewisePolynomial",
    "VectorField",
    "constant_on",
    "cubic_through",
    "expand",
    "linear_through",
    "taylor_field",
]
