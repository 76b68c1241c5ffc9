"""Sums of squares: programs as data, compiled to cones, and a fast path on the sphere."""

from nlsid_core.sos.compiled import Compiled, compile_program, solve
from nlsid_core.sos.program import (
    Identity,
    NonNegative,
    NormBound,
    Program,
    Solution,
    SumOfSquares,
    Zero,
    forms_of,
    matrix_sum_of_squares,
    symmetric_template,
    template,
)
from nlsid_core.sos.sphere import SphereProgram, SphereSolution

__all__ = [
    "Compiled",
    "Identity",
    "NonNegative",
    "NormBound",
    "Program",
    "Solution",
    "SphereProgram",
    "SphereSolution",
    "SumOfSquares",
    "Zero",
    "compile_program",
    "forms_of",
    "matrix_sum_of_squares",
    "solve",
    "symmetric_template",
    "template",
]
