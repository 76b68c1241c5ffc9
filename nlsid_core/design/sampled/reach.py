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

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design.sampled import closed_loop
from nlsid_core.kernel.polynomials import Polynomial as Exact
from nlsid_core.kernel.polynomials import Ring
from nlsid_core.polynomial import Gram, Polynomial, constant, monomials, variables
from nlsid_core.sos import Compiled, Program, SumOfSquares, compile_program, template

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


def bases(n: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """The monomials of the squares, and those of the ball's multiplier."""
    return monomials(n, range(degree + 1)), monomials(n, range(degree))


def reach(rows: Sequence[Exact], ring: Ring, radius: float, degree: int) -> Reach:
    """The least bound that sums of squares give; raises SolverError or Infeasible as the solver."""
    n = ring.count
    found = [closed_loop.scaled_terms(row, ring, [radius] * n) for row in rows]
    size = sum(value**2 for row in found for value in row.values())  # makes the solver's size one
    names = _names(n)
    total: Polynomial = constant(0.0, names=names)
    for row in found:
        exponents = np.array(list(row) or [(0,) * n], dtype=np.int64)
        p = Polynomial(exponents, np.array(list(row.values()) or [0.0]) / np.sqrt(size), names)
        total = total + p * p
    compiled, place = _program(n, degree)
    values = dict.fromkeys(compiled.program.parameters, 0.0)
    for exponent, coefficient in total.terms():
        values[place[exponent]] = float(coefficient)
    solution = compiled.solve(values)
    beta = max(solution.objective, 0.0)
    room = ROOM * max(beta, 1e-3)
    identity = solution["reach"]
    Q, sigma = _full(identity.gram, degree), _full(identity.multipliers[0], degree - 1)
    lift_Q, lift_sigma = _lift(n, degree)
    bound = float(np.sqrt(size * (beta + room))) * UP
    return Reach(radius, bound, size * (Q + room * lift_Q), size * (sigma + room * lift_sigma))


def _names(n: int) -> tuple[str, ...]:
    return tuple(f"z{i}" for i in range(n))


def _degree(order: int, n: int) -> int:
    return next(d for d in range(order) if len(monomials(n, range(d + 1))) == order)


@cache
def _program(n: int, degree: int) -> tuple[Compiled, dict[tuple[int, ...], str]]:
    """The program of one size; the coefficients of |g|² are its parameters."""
    names = _names(n)
    powers = monomials(n, range(2 * degree + 1))
    square = template("c", powers, names)
    parameters = tuple(name for name in square.names if name not in names)
    (beta,) = variables("beta")
    ball = constant(1.0, names=names) - sum(z * z for z in variables(names))
    constraint = SumOfSquares(
        beta - square,
        domain=(ball,),
        degree=2 * degree,
        basis=monomials(n, range(degree + 1)),
        name="reach",
    )
    program = Program(names, (constraint,), minimise=beta, parameters=parameters)
    place = {tuple(e): name for e, name in zip(powers.tolist(), parameters, strict=True)}
    return compile_program(program), place


def _full(gram: Gram, degree: int) -> FloatArray:
    """The Gram matrix over all monomials up to `degree`."""
    basis = monomials(gram.basis.shape[1], range(degree + 1))
    index = {tuple(row): i for i, row in enumerate(basis.tolist())}
    at = [index[tuple(row)] for row in gram.basis.tolist()]
    Q = np.zeros((len(basis), len(basis)))
    Q[np.ix_(at, at)] = gram.Q
    return Q


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
