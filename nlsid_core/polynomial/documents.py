"""Polynomials as JSON. Source of the format: docs/certificate.md, "Polynomials"."""

from fractions import Fraction

from nlsid_core.arrays import Json
from nlsid_core.polynomial.algebra import Polynomial

WHOLE = 2**53  # beyond it a JSON number is not a float64


def write_polynomial(p: Polynomial) -> Json:
    """A polynomial without its variable names, which a claim states once."""
    return {
        "exponents": p.exponents.tolist(),
        "coefficients": [write_number(c) for c in p.coefficients.tolist()],
    }


def write_number(value: float | Fraction) -> float | str:
    """A float64 as a JSON number; a rational too if it is one, else as a text p/q."""
    if isinstance(value, Fraction):
        try:
            rounded = float(value)
        except OverflowError:
            return str(value)
        return rounded if Fraction(rounded) == value else str(value)
    return float(value)


def write_whole(value: int) -> int | str:
    """A whole number as a JSON number, or as a text of digits beyond 2^53."""
    return value if abs(value) <= WHOLE else str(value)
