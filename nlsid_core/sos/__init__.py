"""Sums of squares: programs as data, compiled to cones, and a fast path on the sphere."""

from nlsid_core.sos.compiled import Compiled, Solution, compile_program, solve
from nlsid_core.sos.program import (
    Identity,
    NonNegative,
    NormBound,
    Program,
    SumOfSquares,
    Zero,
    forms_of,
    matrix_sum_of_squares,
    symmetric_template,
    template,
)

__all__ = [
    "Compiled",
    "Identity",
    "NonNegative",
    "NormBound",
    "Program",
    "Solution",
    "SumOfSquares",
    "Zero",
    "compile_program",
    "forms_of",
    "matrix_sum_of_squares",
    "solve",
    "symmetric_template",
    "template",
]
