"""A stable model that is no contraction: e(x⁺) = f(x), e = v + v⁵/5, f = x³/3 (Example 2.3.1).

With P = 1 the stability condition of Lemma 2.13 is 2E - P - F² - δ = 1 + x⁴ - δ > 0, so the model
forgets its start; yet the slope of a = e⁻¹∘f at x = 5/4 is larger than one.
Source: M. Tobenkin, PhD thesis, MIT, 2014, Example 2.3.1.
"""

import numpy as np

from nlsid_core.identification.proofs.stable_sets import ImplicitProof, prove_implicit
from nlsid_core.models import ImplicitModel
from nlsid_core.models.polynomials import Polynomials

KNOWN = 1.819  # |∂a(5/4)|², computed by hand; the thesis says that it is larger than 1
DELTA = 0.5  # any 0 < δ < 1

model = ImplicitModel.separable(
    e=Polynomials(np.array([[1], [5]]), np.array([[1.0], [1.0 / 5.0]])),
    f=Polynomials(np.array([[3]]), np.array([[1.0 / 3.0]])),
    monotonicity=1.0,
    period=1.0,
    states=("x",),
    inputs=(),
)


def example() -> tuple[float, float]:
    """(|∂a(5/4)|², what is known): larger than one, so a is not a contraction."""
    x, no_input = np.array([[1.25]]), np.zeros((1, 0))
    slope = model.jacobian(model.step(x, no_input), x, no_input)
    return float(slope[0, 0, 0]) ** 2, KNOWN


def proof() -> ImplicitProof:
    """That the model is stable, by Lemma 2.13 for every x."""
    found = prove_implicit(model, delta=DELTA, set="2.13")
    assert found is not None
    return found


if __name__ == "__main__":
    print("|da(5/4)|^2 = {:.4f}, by hand {:.3f}".format(*example()))
    print(f"proved stable by Lemma {proof().set}, delta = {proof().delta:g}")
