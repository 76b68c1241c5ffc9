"""Multivariate polynomials: exponents and coefficients, float64 or exactly rational."""

from nlsid_core.polynomial.algebra import Polynomial, constant, variables
from nlsid_core.polynomial.gram import Gram
from nlsid_core.polynomial.maps import jacobian, monomials, trace
from nlsid_core.polynomial.values import monomial_values

__all__ = [
    "Gram",
    "Polynomial",
    "constant",
    "jacobian",
    "monomial_values",
    "monomials",
    "trace",
    "variables",
]
