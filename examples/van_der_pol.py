"""The region of attraction of the reversed Van der Pol oscillator, V from its linearisation.

Source: Seiler and Balas, "Quasiconvex sum-of-squares programming", CDC 2010: level 2.30.
"""

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Polynomial, variables
from nlsid_core.sos.search import largest_level

PUBLISHED = 2.30

x, y = variables("x y")
FIELD: tuple[Polynomial, ...] = (-y, x - (1 - x**2) * y)
V: Polynomial = 1.5 * x**2 - x * y + y**2  # A'P + PA = -I


def example() -> tuple[float, float]:
    """(the level that is proved, the published level)."""
    level = largest_level(FIELD, V, upper=5.0).level
    assert level is not None  # `largest_level` always has one
    return level, PUBLISHED


def document() -> Json:
    """The proof for the largest level."""
    return largest_level(FIELD, V, upper=5.0).document
