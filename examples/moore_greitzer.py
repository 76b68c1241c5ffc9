"""A quartic Lyapunov function for the Moore-Greitzer jet engine, a cubic system.

Source: Krstić, Kanellakopoulos and Kokotović 1995; a quartic V was first found by sums of squares
in Papachristodoulou and Prajna, "On the construction of Lyapunov functions using the sum of
squares decomposition", CDC 2002.
"""

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Polynomial, variables
from nlsid_core.sos.search import lyapunov

PUBLISHED_DEGREE = 4

x, y = variables("x y")
FIELD: tuple[Polynomial, ...] = (-y - 1.5 * x**2 - 0.5 * x**3, 3 * x - y)


def example() -> tuple[float, float]:
    """(the degree of the V that is proved, the published degree)."""
    return lyapunov(FIELD, degree=4).V.degree, PUBLISHED_DEGREE


def document() -> Json:
    """The proof that the origin attracts every solution."""
    return lyapunov(FIELD, degree=4).document
