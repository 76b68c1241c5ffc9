"""Motzkin's polynomial is nonnegative and not a sum of squares; times 1 + x² + y² it is one.

Source: Motzkin 1967; Reznick, "Some concrete aspects of Hilbert's 17th problem", 2000.
"""

from itertools import product

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Gram, Polynomial, variables
from nlsid_core.proofs import decide
from nlsid_core.sos.exact import exact_gram
from nlsid_core.sos.proofs import bound_document

x, y = variables("x y")
MOTZKIN: Polynomial = x**4 * y**2 + x**2 * y**4 - 3 * x**2 * y**2 + 1
ZEROS = list(product((1, -1), repeat=2))
FACTOR = Gram(np.array([[0, 0], [1, 0], [0, 1]]), np.eye(3), ("x", "y"))


def example() -> tuple[float, float]:
    """(the minimum that is proved, the published minimum)."""
    decide(document(), {})
    return 0.0, float(MOTZKIN([1.0, 1.0]))


def document() -> Json:
    """The proof that the minimum is 0."""
    gram = exact_gram(MOTZKIN * FACTOR.polynomial(), zeros=ZEROS)
    return bound_document(MOTZKIN, 0.0, gram, factor=FACTOR)
