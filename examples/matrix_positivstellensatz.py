"""The least eigenvalue of a polynomial matrix on an interval, with matrix multipliers.

M(x) = [3 + x, x²; x², 3 - x] on x² ≤ 1 has eigenvalues 3 ± √(x² + x⁴), so the least is 3 - √2.
On an interval matrix sums of squares lose nothing.
Source: Scherer and Hol, "Matrix sum-of-squares relaxations", Math. Programming 107 (2006).
"""

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Polynomial, variables
from nlsid_core.sos import Identity, Program, forms_of, matrix_sum_of_squares, solve
from nlsid_core.sos.proofs import matrix_document

PUBLISHED = 3 - 2**0.5
BACK_OFF = 1e-6  # below the optimum, where the Gram matrices are positive definite

(x,) = variables("x")
M = np.array([[3 + x, x**2], [x**2, 3 - x]])
INTERVAL: Polynomial = 1 - x**2


def example() -> tuple[float, float]:
    """(the bound that is found, the exact least eigenvalue)."""
    (level,) = variables("level")
    return _solved(level, maximise=level)[0], PUBLISHED


def document() -> Json:
    """The proof of M ⪰ level·I on the interval, `BACK_OFF` below the optimum."""
    level = example()[0] - BACK_OFF
    identity = _solved(level, maximise=None)[1]
    return matrix_document(
        M - level * np.eye(2),
        identity.gram,
        names=("x",),
        domain=[INTERVAL],
        multipliers=identity.multipliers,
    )


def _solved(level: Polynomial | float, *, maximise: Polynomial | None) -> tuple[float, Identity]:
    identity = M - np.array([[level, 0 * x], [0 * x, level]], dtype=object)
    constraint = matrix_sum_of_squares(identity, domain=(INTERVAL,), name="M")
    found = solve(Program(("x", *forms_of(2)), (constraint,), maximise=maximise))
    return found.objective, found["M"]
