"""A stable model that is no contraction: e(x⁺) = f(x), e = v + v⁵/5, f = x³/3 (Example 2.3.1).

With P = 1 the stability condition of Lemma 2.13 is 2E - P - F² - δ = 1 + x⁴ - δ > 0, so the model
forgets its start; yet the slope of a = e⁻¹∘f at x = 5/4 is larger than one.
Source: M. Tobenkin, PhD thesis, MIT, 2014, Example 2.3.1.
"""

from fractions import Fraction

import numpy as np

from nlsid_core._types import Json
from nlsid_core.certificate.documents import matrix_document
from nlsid_core.identification.stable_sets import derivatives_matrix
from nlsid_core.polynomial import variables
from nlsid_core.sos import Program, forms_of, matrix_sum_of_squares, solve

PUBLISHED = 1.819  # |∂a(5/4)|²
DELTA = 0.5  # any 0 < δ < 1

(x,) = variables("x")
e = np.array([x + x**5 * Fraction(1, 5)])
f = np.array([x**3 * Fraction(1, 3)])
M = derivatives_matrix(e, f, np.eye(1), ["x"], delta=DELTA)


def example() -> tuple[float, float]:
    """(|∂a(5/4)|², what is published): larger than one, so a is not a contraction."""
    return float(f[0].derivative("x")([1.25])) ** 2 / _slope_of_e() ** 2, PUBLISHED


def document() -> Json:
    """The proof of Lemma 2.13's inequality, for every x."""
    found = solve(Program(("x", *forms_of(2)), (matrix_sum_of_squares(M, name="stable"),)))
    return matrix_document(M, found["stable"].gram, names=("x",))


def _slope_of_e() -> float:
    """∂e at the v that solves e(v) = f(5/4), by bisection: e increases."""
    target, low, high = float(f[0]([1.25])), 0.0, 1.25
    while high - low > 1e-15:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if float(e[0]([middle])) < target else (low, middle)
    return float(e[0].derivative("x")([low]))


if __name__ == "__main__":
    print("|da(5/4)|^2 = {:.4f}, published {:.3f}".format(*example()))
