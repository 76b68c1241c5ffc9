"""β(a): how far one step takes an ellipsoid, the one semidefinite program of a discrete funnel.

    minimise β such that β - |g(s z)|² - σ(z)(1 - |z|²) is a sum of squares, σ too.

The solver's answer is made into a proof by raising β a little: with D = deg g,
    1 = Σ_d |z|^2d/(D + 1) + (1 - |z|²) Σ_j (D - j)/(D + 1) |z|^2j,
so that both Gram matrices gain a positive definite part that outweighs the solver's tolerance.
"""

from dataclasses import dataclass
from functools import cache
from math import factorial, prod

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.certificate.discrete_funnel import StepProof
from nlsid_core.certificate.reach import Rational, degree_of, names_of, rounded
from nlsid_core.polynomial import Gram, Polynomial, constant, monomials, variables
from nlsid_core.sos import Compiled, Program, SumOfSquares, compile_program, template

UP = 2.0  # more than the roundings of a square root and a sum
ROOM = 1e-6  # relative; what β is raised by, well above the solver's 1e-8


@dataclass(frozen=True, eq=False)
class Step:
    """The exact g(z) of one step, as `certificate.reach.closed_loop` gives it."""

    g: Rational

    def reach(self, radius: float) -> StepProof:
        """b with |z| ≤ radius ⇒ |g(z)| ≤ b, with its proof.

        Raises SolverError or Infeasible as the solver does.
        """
        n, degree = self.g.shape[1], degree_of(self.g)
        outputs, off = rounded(self.g, radius)
        size = float((outputs**2).sum())  # so that the solver sees numbers of size one
        names, basis = names_of(n), monomials(n, range(degree + 1))
        square: Polynomial = constant(0.0, names=names)
        for column in outputs.T:
            p = Polynomial(basis, column / np.sqrt(size), names)
            square = square + p * p
        compiled, place = _program(n, degree)
        values = dict.fromkeys(compiled.program.parameters, 0.0)
        for exponent, coefficient in square.terms():
            values[place[exponent]] = float(coefficient)
        solution = compiled.solve(values)
        beta = max(solution.objective, 0.0)
        room = ROOM * max(beta, 1e-3)
        identity = solution["reach"]
        Q, sigma = _full(identity.gram, degree), _full(identity.multipliers[0], degree - 1)
        lift_Q, lift_sigma = _lift(n, degree)
        reach = float(np.sqrt(size * (beta + room))) + UP * float(off)
        return StepProof(reach, size * (Q + room * lift_Q), size * (sigma + room * lift_sigma))


@cache
def _program(n: int, degree: int) -> tuple[Compiled, dict[tuple[int, ...], str]]:
    """The program of one size; the coefficients of |g|² are its parameters."""
    names = names_of(n)
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
