"""Multivariate polynomials: exponents and coefficients, float64 or exactly rational."""

from nlsid_core.polynomial.algebra import Polynomial, constant, variables
from nlsid_core.polynomial.gram import Gram
from nlsid_core.polynomial.maps import compose_affine, evaluate, jacobian, monomials, trace

__all__ = [
    "Gram",
    "Polynomial",
    "compose_affine",
    "constant",
    "evaluate",
    "jacobian",
    "monomials",
    "trace",
    "variables",
]
