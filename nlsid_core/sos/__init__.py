"""Sums of squares: programs as data, compiled to cones, and a fast path on the sphere."""

from nlsid_core.sos.builder import Builder, solve
from nlsid_core.sos.program import (
    Identity,
    NonNegative,
    NormBound,
    Program,
    Solution,
    SumOfSquares,
    forms_of,
    matrix_sum_of_squares,
    symmetric_template,
    template,
)
from nlsid_core.sos.sphere import SphereProgram, SphereSolution

__all__ = [
    "Builder",
    "Identity",
    "NonNegative",
    "NormBound",
    "Program",
    "Solution",
    "SphereProgram",
    "SphereSolution",
    "SumOfSquares",
    "forms_of",
    "matrix_sum_of_squares",
    "solve",
    "symmetric_template",
    "template",
]
