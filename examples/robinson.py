"""Robinson's form at z = 1: nonnegative, not a sum of squares; times 1 + x² + y² it is one.

Source: Robinson 1973; Reznick, "Some concrete aspects of Hilbert's 17th problem", 2000.
"""

from itertools import product

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Gram, Polynomial, variables
from nlsid_core.sos.exact import exact_gram
from nlsid_core.sos.proofs import bound_document

x, y = variables("x y")
ROBINSON: Polynomial = (
    x**6 + y**6 + 1 - (x**4 * y**2 + x**2 * y**4 + x**4 + x**2 + y**4 + y**2) + 3 * x**2 * y**2
)
ZEROS = [*product((1, -1), repeat=2), (1, 0), (-1, 0), (0, 1), (0, -1)]
AT_INFINITY = [(1, 1), (1, -1)]
FACTOR = Gram(np.array([[0, 0], [1, 0], [0, 1]]), np.eye(3), ("x", "y"))


def example() -> tuple[float, float]:
    """(the minimum that is proved, the published minimum)."""
    claim = document()["claim"]
    return float(claim["bound"]), float(ROBINSON([1.0, 1.0]))


def document() -> Json:
    """The proof that the minimum is 0, exact and checked while it is made."""
    gram = exact_gram(ROBINSON * FACTOR.polynomial(), zeros=ZEROS, directions=AT_INFINITY)
    return bound_document(ROBINSON, 0.0, gram, factor=FACTOR)
