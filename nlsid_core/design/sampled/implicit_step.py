"""One step of an implicit model, h(z, w) = 0 with x̄⁺ linear in (z, w): its reach, with a proof.

    minimise β such that β - |x̄⁺|² - ν'h - σ₁(1 - |z|²) - σ₂(1 - |w|²) is a sum of squares,

z in units of the radius, w of the bound on the next rates. The bound is not for the solver's
comfort: an identified equation has spurious roots far away, which a step could as well take. The
claim holds for next rates within it, which a monitor has to check.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.design.sampled import closed_loop
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.kernel import Rejected
from nlsid_core.kernel.files import Node
from nlsid_core.kernel.polynomials import Polynomial as Exact
from nlsid_core.kernel.polynomials import Ring
from nlsid_core.kernel.positivity import positive, read_squares
from nlsid_core.polynomial import Gram, Polynomial, constant, monomials, variables
from nlsid_core.sos import Program, SumOfSquares, solve
from nlsid_core.sos.program import Identity

ROOM = 1e-5  # relative; β is raised by so much, so that the proof's matrices are definite
ATTEMPTS = 4  # each raising β ten times as much
EQUATION_BITS = 44  # of the largest coefficient of an equation's multiplier


@dataclass(frozen=True, eq=False)
class ImplicitStep:
    """|rows| where h = 0, size ≤ radius² and |w| ≤ far, in the kernel's polynomials of (z, w).

    size: |z|² but for rounding; z are the first variables. Raises DataError if far is no bound.
    """

    ring: Ring
    rows: Sequence[Exact]
    h: Sequence[Exact]
    size: Exact
    radius: float
    far: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.far) and self.far > 0):
            raise DataError(
                f"bound on the next state is {self.far}; without one a step can end at a "
                "spurious root of the equation"
            )

    @property
    def states(self) -> int:
        """How many of the variables are z."""
        return self.ring.count - len(self.h)

    @property
    def scale(self) -> list[float]:
        """The units of z and w."""
        return [self.radius] * self.states + [self.far] * len(self.h)

    def reach(self) -> float:
        """b with |rows| ≤ b, proved; raises as `proof`."""
        return float(self.proof()["reach"])

    def proof(self) -> Json:
        """The reach with its witnesses.

        Raises Infeasible if no proof of this degree is found, SolverError as the solver does.
        """
        names = tuple(f"y{i}" for i in range(self.ring.count))
        rows, unit = _floats(self.rows, self.ring, self.scale, names)
        pairs = [_floats([h], self.ring, self.scale, names) for h in self.h]
        equations = tuple(h[0] for h, _ in pairs)
        total: Polynomial = constant(0.0, names=names)
        for row in rows:
            total = total + row * row
        domain = tuple(
            constant(1.0, names=names) - sum(y * y for y in variables(names)[part])
            for part in (slice(self.states), slice(self.states, None))
        )
        degree = self.degree
        basis = monomials(len(names), range(degree // 2 + 1))

        def program(p: Polynomial, goal: Polynomial | None = None) -> Program:
            squares = SumOfSquares(p, domain, equations, degree=degree, basis=basis, name="reach")
            return Program(names, (squares,), minimise=goal)

        (beta,) = variables("beta")
        least, room = max(solve(program(beta - total, beta)).objective, 0.0), ROOM
        for _ in range(ATTEMPTS):
            bound = float(np.sqrt(least * (1.0 + room)) * unit)
            level = (bound / unit) ** 2
            identity = solve(program(constant(level, names=names) - total))["reach"]
            try:
                return self.stated(bound, identity, unit, [size for _, size in pairs])
            except Infeasible:
                room *= 10.0
        raise Infeasible("no exact proof of this step; use smaller radii or a smaller bound")

    @property
    def degree(self) -> int:
        """Of the identity: the least even degree that fits."""
        highest = max((h.degree for h in self.h), default=2)
        return max(2, highest + highest % 2)

    def bases(self) -> dict[str, IntArray]:
        """The monomials of the witnesses."""
        count, highest = self.ring.count, max(h.degree for h in self.h)
        inner = monomials(count, range(self.degree // 2))
        return {
            "basis": monomials(count, range(self.degree // 2 + 1)),
            "ball_basis": inner,
            "roots_basis": inner,
            "equation_basis": monomials(count, range(self.degree - highest + 1)),
        }

    def stated(self, bound: float, identity: Identity, unit: float, sizes: Sequence[float]) -> Json:
        """The witnesses of an identity whose rows are in `unit` and whose equations in `sizes`.

        Raises Infeasible if the identity leaves no room for its rounding.
        """
        ring, bases, parts = self.ring, self.bases(), []
        w = ring.variables[self.states :]
        balls = (("ball", self.radius, self.size), ("roots", self.far, ring.dot(w, w)))
        entry: Json = {"reach": bound}
        for (name, radius, size), gram in zip(balls, identity.multipliers, strict=True):
            basis = bases[f"{name}_basis"]
            Q = (unit / radius) ** 2 * _full(positive_semidefinite(gram), basis)
            entry[name], sigma = closed_loop.stated_multiplier(basis, Q, self.scale, ring)
            parts.append(sigma * (size - Fraction(radius) ** 2))
        entry["equations"], multiplied = self._equations(identity, unit, sizes)
        parts.append(Fraction(bound) ** 2 - ring.dot(self.rows, self.rows))
        c = ring.sum(parts + multiplied)
        Q = unit**2 * _full(identity.gram, bases["basis"])
        entry |= closed_loop.stated_squares(c, bases["basis"], Q, self.scale, ring)
        self._judge(c, entry)
        return entry

    def _equations(
        self, identity: Identity, unit: float, sizes: Sequence[float]
    ) -> tuple[Json, list[Exact]]:
        """ν as whole numbers over powers of two, one for each monomial; and -ν_i h_i."""
        basis = self.bases()["equation_basis"]
        lengths = np.prod(np.asarray(self.scale) ** basis, axis=1)
        values = []
        for nu, size in zip(identity.equality_multipliers, sizes, strict=True):
            found = {tuple(e): float(c) for e, c in nu.terms()}
            row = np.array([found.get(tuple(e), 0.0) for e in basis.tolist()])
            values.append(row * unit**2 / size / lengths)
        largest = np.maximum(np.abs(values).max(axis=0), np.finfo(np.float64).tiny)
        columns = np.ceil(np.log2(largest)).astype(np.int64) - EQUATION_BITS
        rows = np.round(np.ldexp(values, -columns)).astype(np.int64)
        products = []
        for row, h in zip(rows.tolist(), self.h, strict=True):
            terms = {
                tuple(e): -entry * Fraction(2) ** int(shift)
                for e, entry, shift in zip(basis.tolist(), row, columns, strict=True)
            }
            products.append(closed_loop.polynomial(terms, self.ring) * h)
        return {"columns": columns.tolist(), "rows": rows.tolist()}, products

    def _judge(self, c: Exact, entry: Json) -> None:
        """Raise Infeasible unless the kernel finds c >= 0 by the entry's squares."""
        stated = {**entry, "basis": self.bases()["basis"].tolist()}
        parts = {name: Node(stated[name], name) for name in ("basis", "columns", "squares")}
        try:
            squares = read_squares(parts, self.ring)
            positive(c, squares, self.ring, "reach", strict=False)
        except (Rejected, CertificateRejected) as refusal:
            raise Infeasible(str(refusal)) from refusal


def _floats(
    p: Sequence[Exact], ring: Ring, scale: Sequence[float], names: tuple[str, ...]
) -> tuple[list[Polynomial], float]:
    """p of y, x = scale * y, over a power of two near the largest coefficient; and that power."""
    found = [closed_loop.scaled_terms(q, ring, scale) for q in p]
    largest = max((abs(value) for q in found for value in q.values()), default=1.0)
    unit = float(2.0 ** np.round(np.log2(largest or 1.0)))
    zero = {(0,) * len(names): 0.0}
    return [
        Polynomial(np.array(list(q or zero)), np.array(list((q or zero).values())) / unit, names)
        for q in found
    ], unit


def _full(gram: Gram, basis: IntArray) -> FloatArray:
    """The Gram matrix over `basis`."""
    index = {tuple(row): i for i, row in enumerate(basis.tolist())}
    at = [index[tuple(row)] for row in gram.basis.tolist()]
    Q = np.zeros((len(basis), len(basis)))
    Q[np.ix_(at, at)] = gram.Q
    return Q


def positive_semidefinite(gram: Gram) -> Gram:
    """With its eigenvalues lifted just above zero; the identity takes the change."""
    if not len(gram):
        return gram
    lowest = float(np.linalg.eigvalsh(gram.Q)[0])
    size = float(np.abs(gram.Q).max()) or 1.0
    lift = max(0.0, -lowest) + 1e-13 * size
    return Gram(gram.basis, gram.Q + lift * np.eye(len(gram)), gram.names)
