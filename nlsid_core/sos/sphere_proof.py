"""From a solved sphere program to an identity that the kernel decides.

With h = 1 - |z|² and d = g - m - v'Xv = μh, a small part η of the bound is turned into a strictly
positive definite Gram matrix of (1, v):
    η = ¼η + ¾η·(Σ (w_i v_i)² + h(1 + ½|z_nl|²)),   w_i² = 1 or ½ as in `SphereProgram`,
so that rounding has room: g - (m - η) = (1, v)'Q(1, v) + (μ + ¾η(1 + ½|z_nl|²)) h.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core.errors import ShapeError
from nlsid_core.polynomial import Gram, Polynomial, constant
from nlsid_core.sos.sphere import SphereProgram, SphereSolution

# η over the trace of X: the residual of the identity is 1e-15 of it, and the Cholesky factorisation
# of `rigorous` takes about 1e-13 more.
ROUNDING_ROOM = 4e-12


@dataclass(frozen=True, eq=False)
class SphereProof:
    """g ≥ bound on |z| = 1: g - bound = gram + multiplier·sphere, up to rounding."""

    bound: float
    gram: Gram
    multiplier: Polynomial
    sphere: Polynomial


def sphere_proof(program: SphereProgram, solution: SphereSolution, g: Polynomial) -> SphereProof:
    """The proof of `solution.m` minus a rounding allowance, for g in `program.n` variables.

    g has to be the polynomial whose values were given to `solve`, of degree ≤ 4 (half = 2).
    """
    n, names = program.n, g.names
    if len(names) != n or g.degree > 4 or program.half != 2:
        raise ShapeError(f"g has {len(names)} variables and degree {g.degree}: expected {n}, <= 4")
    X = program.gram(solution)
    eta = ROUNDING_ROOM * float(np.trace(X)) + 4 * np.finfo(float).eps * abs(solution.m)
    basis = np.vstack([np.zeros((1, n), dtype=np.int64), program.basis])
    Q = np.zeros((len(basis), len(basis)))
    Q[1:, 1:] = X
    d = g - solution.m - Gram(program.basis, X, names).polynomial()
    Q[np.diag_indices(len(basis))] += eta * np.r_[0.25, 0.75 * program.weight**2]

    squares = Polynomial(2 * np.eye(n, dtype=np.int64), np.ones(n), names)
    inside = np.array([j in program.chosen for j in range(n)])
    slack = constant(1.0, names=names) + Polynomial(
        squares.exponents, 0.5 * inside[squares.exponents.argmax(axis=1)], names
    )
    # By degree, d_k = μ_k - |z|²μ_(k-2). Degrees 3 and 4 leave room for nonlinear variables only.
    low = d.homogeneous(0)
    multiplier = low + _in_only(d.homogeneous(1), inside)
    multiplier = multiplier + _in_only(d.homogeneous(2) + squares * low, inside)
    return SphereProof(
        bound=solution.m - eta,
        gram=Gram(basis, Q, names),
        multiplier=multiplier + 0.75 * eta * slack,
        sphere=1 - squares,
    )


def _in_only(p: Polynomial, inside: NDArray[np.bool_]) -> Polynomial:
    """The terms in the variables `inside`; the others are rounding, left to the Gram matrix."""
    keep = ~p.exponents[:, ~inside].any(axis=1)
    return Polynomial(p.exponents[keep], p.coefficients[keep], p.names)
