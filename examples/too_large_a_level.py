"""A region of attraction where a solver's word is not enough.

ẋ = (U - 1) ∂U/∂x, U = (x'A₁'A₁x)(x'A₂'A₂x), A₁ = [1 2; 3 4], A₂ = A₁ diag(-1, 1), V = x'x. Then
V̇ = 8U(U - 1) < 0 exactly where 0 < U < 1, U ≤ 400 V² with equality on an axis, and the largest
level is 1/20. Source: Drake issue 12876, where 0.067 to 0.070 was returned.
"""

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.polynomial import Polynomial, variables
from nlsid_core.sos.search import attraction

EXACT = 0.05
PROVED = EXACT * (1 - 1e-6)

x, y = variables("x y")
A1 = np.array([[1, 2], [3, 4]])
A2 = A1 @ np.diag([-1, 1])
STATE = np.array([x, y])
U: Polynomial = (STATE @ (A1.T @ A1) @ STATE) * (STATE @ (A2.T @ A2) @ STATE)
FIELD: tuple[Polynomial, ...] = tuple((U - 1) * U.derivative(name) for name in ("x", "y"))
V: Polynomial = x**2 + y**2


def example() -> tuple[float, float]:
    """(the level that is proved, the exact level)."""
    level = attraction(FIELD, V, PROVED).level
    assert level is not None  # it is the one that was asked for
    return level, EXACT


def document(level: float = PROVED) -> Json:
    """The proof for a level; Infeasible for one that is too large."""
    return attraction(FIELD, V, level).document
