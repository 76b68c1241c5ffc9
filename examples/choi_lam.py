"""The Choi-Lam form at z = 1: nonnegative, not a sum of squares; times 1 + x² + y² it is one.

Source: Choi and Lam, "Extremal positive semidefinite forms", Math. Ann. 231 (1977).
"""

from itertools import product

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Gram, Polynomial, variables
from nlsid_core.sos.exact import exact_gram
from nlsid_core.sos.proofs import bound_document

x, y = variables("x y")
CHOI_LAM: Polynomial = x**4 * y**2 + y**4 + x**2 - 3 * x**2 * y**2
ZEROS = [*product((1, -1), repeat=2), (0, 0)]
FACTOR = Gram(np.array([[0, 0], [1, 0], [0, 1]]), np.eye(3), ("x", "y"))


def example() -> tuple[float, float]:
    """(the minimum that is proved, the published minimum)."""
    claim = document()["claim"]
    return float(claim["bound"]), float(CHOI_LAM([1.0, 1.0]))


def document() -> Json:
    """The proof that the minimum is 0, exact and checked while it is made."""
    gram = exact_gram(CHOI_LAM * FACTOR.polynomial(), zeros=ZEROS)
    return bound_document(CHOI_LAM, 0.0, gram, factor=FACTOR)
