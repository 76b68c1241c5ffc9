"""β(a): how far one step takes an ellipsoid, the one semidefinite program of a sampled funnel.

    minimise β such that β - |g(s z)|² - σ(z)(1 - |z|²) is a sum of squares, σ too.

The solver's answer is made into a proof by raising β a little: with D = deg g,
    1 = Σ_d |z|^2d/(D + 1) + (1 - |z|²) Σ_j (D - j)/(D + 1) |z|^2j,
so that both Gram matrices gain a positive definite part that outweighs the solver's tolerance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial, prod

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.design.continuous.graded import positions
from nlsid_core.design.sampled import closed_loop
from nlsid_core.kernel.polynomials import Polynomial as Exact
from nlsid_core.kernel.polynomials import Ring
from nlsid_core.polynomial import monomials

UP = 1.0 + 1e-14  # more than the rounding of a square root
ROOM = 1e-6  # relative; what β is raised by, well above the solver's 1e-8


@dataclass(frozen=True, eq=False)
class Reach:
    """|z| ≤ radius implies |g(z)| ≤ bound, by Gram matrices in z/radius."""

    radius: float
    bound: float
    Q: FloatArray
    sigma: FloatArray

    def stated(self, rows: Sequence[Exact], size: Exact, ring: Ring) -> Json:
        """The proof of |rows| ≤ bound where size ≤ radius²; size is |z|² but for rounding."""
        n = ring.count
        basis, inner = bases(n, _degree(len(self.Q), n))
        scale = [self.radius] * n
        ball, sigma = closed_loop.stated_multiplier(inner, self.sigma / self.radius**2, scale, ring)
        b, s = closed_loop.exact([self.bound, self.radius])
        c = b**2 - ring.dot(rows, rows) + sigma * (size - s**2)
        squares = closed_loop.stated_squares(c, basis, self.Q, scale, ring)
        return {"reach": self.bound, **squares, "ball": ball}


def bases(n: int, degree: int) -> tuple[IntArray, IntArray]:
    """The monomials of the squares, and those of the ball's multiplier."""
    return monomials(n, range(degree + 1)), monomials(n, range(degree))


def reach(rows: Sequence[Exact], ring: Ring, radius: float, degree: int) -> Reach:
    """The least bound that sums of squares give; raises SolverError or Infeasible as the solver."""
    n = ring.count
    found = [closed_loop.scaled_terms(row, ring, [radius] * n) for row in rows]
    basis, inner = bases(n, degree)
    g = np.array([[row.get(tuple(v), 0.0) for v in basis.tolist()] for row in found])
    size = float(np.sum(g**2))  # makes the solver's size one
    places, A = _identity(n, degree)
    square = np.bincount(places.ravel(), (g.T @ g / size).ravel(), len(A))
    unknowns = A.shape[1]
    x = conic.solve(
        ConeProgram(
            P=sp.csc_matrix((unknowns, unknowns)),
            q=np.r_[1.0, np.zeros(unknowns - 1)],
            A=sp.vstack([A, -sp.eye(unknowns, format="csr")[1:]], "csc"),
            b=np.r_[square, np.zeros(unknowns - 1)],
            cones=(Cone("zero", len(A)), Cone("psd", len(basis)), Cone("psd", len(inner))),
        )
    ).x
    beta = max(float(x[0]), 0.0)
    room = ROOM * max(beta, 1e-3)
    first = 1 + len(basis) * (len(basis) + 1) // 2
    Q, sigma = conic.smat(x[1:first]), conic.smat(x[first:])
    lift_Q, lift_sigma = _lift(n, degree)
    bound = float(np.sqrt(size * (beta + room))) * UP
    return Reach(radius, bound, size * (Q + room * lift_Q), size * (sigma + room * lift_sigma))


def _degree(order: int, n: int) -> int:
    return next(d for d in range(order) if len(monomials(n, range(d + 1))) == order)


@cache
def _identity(n: int, degree: int) -> tuple[IntArray, FloatArray]:
    """Where each product of the basis is among the monomials up to 2·degree, and their coefficients
    in β - v'Qv - σ(1 - |z|²), by β, svec Q and svec σ.
    """
    basis, inner = bases(n, degree)
    every = monomials(n, range(2 * degree + 1))
    places = positions((basis[:, None] + basis).reshape(-1, n), every).reshape(len(basis), -1)
    i, j = conic.triangle(len(basis))
    a, b = conic.triangle(len(inner))
    coefficients = np.zeros((len(every), 1 + len(i) + len(a)))
    coefficients[0, 0] = 1.0
    weight = np.where(i == j, 1.0, conic.SQRT2)
    coefficients[places[i, j], 1 + np.arange(len(i))] = -weight
    columns = 1 + len(i) + np.arange(len(a))
    weight, products = np.where(a == b, 1.0, conic.SQRT2), inner[a] + inner[b]
    coefficients[positions(products, every), columns] = -weight
    for unit in np.eye(n, dtype=np.int64):
        coefficients[positions(products + 2 * unit, every), columns] = weight
    return places, coefficients


@cache
def _lift(n: int, degree: int) -> tuple[FloatArray, FloatArray]:
    """The positive definite parts of 1, diagonal: of the Gram matrix and of the multiplier."""
    parts = []
    for top, weight in (
        (degree, lambda _: 1.0 / (degree + 1)),
        (degree - 1, lambda j: (degree - j) / (degree + 1)),
    ):
        basis = monomials(n, range(top + 1)).tolist()
        diagonal = [weight(sum(e)) * factorial(sum(e)) / prod(map(factorial, e)) for e in basis]
        parts.append(np.diag(diagonal))
    return parts[0], parts[1]
