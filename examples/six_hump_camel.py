"""The global minimum of the six-hump camel function, with a certificate.

Source: Dixon and Szegö 1978: minimum -1.0316284535 at (±0.08984, ∓0.71266).
"""

from fractions import Fraction

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Polynomial, variables
from nlsid_core.sos.search import lower_bound

PUBLISHED = -1.0316284535

x, y = variables("x y")
CAMEL: Polynomial = (
    4 * x**2 - Fraction(21, 10) * x**4 + Fraction(1, 3) * x**6 + x * y - 4 * y**2 + 4 * y**4
)


def example() -> tuple[float, float]:
    """(the bound that is proved, the published minimum)."""
    return lower_bound(CAMEL).value, PUBLISHED


def document() -> Json:
    """The proof of the bound, of the polynomial with its exact coefficients 21/10 and 1/3."""
    return lower_bound(CAMEL).document
