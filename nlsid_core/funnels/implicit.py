"""One step of an implicit model, h(z, w) = 0 with x̄⁺ linear in (z, w): its reach, with a proof.

    minimise β such that β - |x̄⁺|² - ν'h - σ₁(1 - |z|²) - σ₂(R² - |w|²) is a sum of squares.

w is the next state in units of its size. The bound |w| ≤ R is not for the solver's comfort: an
identified equation has spurious roots far away, which a step could as well take. The claim
holds for next states within R, which a monitor has to check.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from nlsid_core.certificate.implicit_reach import ImplicitStepProof
from nlsid_core.certificate.nonnegative import prove_lower_bound
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.polynomial import Polynomial, constant, variables
from nlsid_core.sos import Program, SumOfSquares, solve
from nlsid_core.sos.search import positive_semidefinite

ROOM = 1e-5  # relative; β is raised by so much, so that the proof's matrices are definite
ATTEMPTS = 4  # each raising β ten times as much


@dataclass(frozen=True, eq=False)
class ImplicitStep:
    """x̄⁺ (rows, linear in z and w) and the equations h = 0, in the same variables.

    rows: S⁺x̄⁺, so that |rows| is the norm of the next state. current, following: the names of z and
    w. bound: R > 0. Raises DataError if there is no bound.
    """

    rows: tuple[Polynomial, ...]
    equations: tuple[Polynomial, ...]
    current: tuple[str, ...]
    following: tuple[str, ...]
    bound: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.bound) and self.bound > 0):
            raise DataError(
                f"bound on the next state is {self.bound}; without one a step can end at a "
                "spurious root of the equation"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """All variables, z first."""
        return self.current + self.following

    @property
    def domain(self) -> tuple[Polynomial, Polynomial]:
        """1 - |z|² and R² - |w|², both ≥ 0."""
        return _ball(self.names, self.current, 1.0), _ball(self.names, self.following, self.bound)

    @property
    def square(self) -> Polynomial:
        """|rows|²."""
        total: Polynomial = constant(0.0, names=self.names)
        for row in self.rows:
            wide = row.over(self.names)
            total = total + wide * wide
        return total

    def reach(self) -> float:
        """b with h(z, w) = 0, |z| ≤ 1 and |w| ≤ R ⇒ |x̄⁺| ≤ b, proved exactly; raises as `proof`."""
        return self.proof().reach

    def proof(self) -> ImplicitStepProof:
        """The reach b with its proof.

        Raises Infeasible if no proof of this degree is found, SolverError as the solver does.
        """
        (beta,) = variables("beta")
        square = self.square.rounded()
        found = solve(self._program(beta - square, minimise=beta))
        room = ROOM
        for _ in range(ATTEMPTS):
            reach = float(np.sqrt(max(found.objective, 0.0) * (1.0 + room)))
            identity = solve(self._program(constant(reach**2, names=self.names) - square))["reach"]
            first, second = (positive_semidefinite(gram) for gram in identity.multipliers)
            proof = ImplicitStepProof(
                reach, identity.gram, (first, second), tuple(identity.equality_multipliers)
            )
            try:
                self.prove(proof)
            except CertificateRejected:
                room *= 10.0
                continue
            return proof
        raise Infeasible("no exact proof of this step; use smaller radii or a smaller bound R")

    def prove(self, identity: ImplicitStepProof) -> float:
        """Prove |rows| ≤ reach on the domain from an identity; raises CertificateRejected."""
        return prove_lower_bound(
            -self.square,
            -(Fraction(identity.reach) ** 2),
            identity.gram,
            domain=self.domain,
            multipliers=identity.multipliers,
            equalities=[h.over(self.names) for h in self.equations],
            equality_multipliers=identity.equality_multipliers,
        )

    def _program(self, p: Polynomial, *, minimise: Polynomial | None = None) -> Program:
        equations = tuple(h.rounded() for h in self.equations)
        constraint = SumOfSquares(p, domain=self.domain, equalities=equations, name="reach")
        return Program(self.names, (constraint,), minimise=minimise)


def _ball(names: Sequence[str], members: Sequence[str], radius: float) -> Polynomial:
    total: Polynomial = constant(radius**2, names=tuple(names))
    for z in variables(names):
        if any(name in members for name, used in zip(z.names, z.exponents[0], strict=True) if used):
            total = total - z * z
    return total
