"""Continuous-time nouns: polynomial dynamics, policies and funnels around trajectories."""

from nlsid_core.continuous.funnel import Funnel
from nlsid_core.continuous.nominal import Nominal
from nlsid_core.continuous.piecewise import (
    PiecewisePolynomial,
    constant_on,
    cubic_through,
    linear_through,
)
from nlsid_core.continuous.policy import Policy
from nlsid_core.continuous.taylor import expand, taylor_field
from nlsid_core.continuous.vector_field import VectorField

__all__ = [
    "Funnel",
    "Nominal",
    "PiecewisePolynomial",
    "Policy",
    "VectorField",
    "constant_on",
    "cubic_through",
    "expand",
    "linear_through",
    "taylor_field",
]
