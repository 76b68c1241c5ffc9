"""L-steps of many states by small Gram matrices, where few states are nonlinear together.

A clique is what occurs in the nonlinear terms of one rate. Ẇ's terms of degree 3 and 4 then have
two factors of a clique each, which is what `sos.cliques` is for. φ is a little smaller than that
of the sphere program, whose Gram matrix has every product.
Source: docs/theory-funnels.md, "Many states".
"""

from functools import cached_property
from itertools import product
from math import comb
from typing import Any

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design.continuous.lstep import TOLERANCE, LSteps, Section
from nlsid_core.design.continuous.pieces import substitution
from nlsid_core.dynamics import VectorField
from nlsid_core.polynomial.maps import monomials
from nlsid_core.sos.cliques import CliqueProgram
from nlsid_core.sos.sphere import SphereSolution, weights_of

LARGE = 12  # states: below, a sphere program takes a second or so
CHEAPER = 1 / 16  # of a sphere program's work: with more, small matrices take as long
MAX_DEGREE = 3  # of f
FINER = 0.1  # of the tolerance of sphere programs: their unit is the spread of g


def cliques_of(field: VectorField) -> tuple[tuple[int, ...], ...]:
    """States in the nonlinear terms of each rate; () if these have inputs."""
    n, last = field.n, 1 + field.n + field.m
    found: set[tuple[int, ...]] = set()
    for equations in field.pieces:
        for p in equations:
            high = p.exponents[p.exponents[:, 1:last].sum(axis=1) > 1]
            if high[:, 1 + n : last].any():
                return ()
            states = tuple(np.flatnonzero(high[:, 1 : 1 + n].any(axis=0)).tolist())
            if states:
                found.add(states)
    return tuple(sorted(S for S in found if not any(set(S) < set(other) for other in found)))


def share_of_work(n: int, nonlinear: int, cliques: tuple[tuple[int, ...], ...]) -> float:
    """Σ (pairs of a clique's products)³ over (monomials of the sphere program)³.

    nonlinear: how many states are. A monomial of degree 4 has two of them, of degree 3 one, and of
    degree 2 not two: the sphere gives those by others.
    """
    linear = n - nonlinear
    squares = comb(linear + 1, 2) + linear * nonlinear
    cubics = comb(n + 2, 3) - comb(linear + 2, 3)
    quartics = comb(n + 3, 4) - comb(linear + 3, 4) - nonlinear * comb(linear + 2, 3)
    rows = [len(S) * (n + 1) - comb(len(S), 2) for S in cliques]
    return sum(comb(k + 1, 2) ** 3 for k in rows) / (squares + cubics + quartics) ** 3


class Cliques:
    """What `SphereProgram` is to pieces of a proof; its Gram matrix is a sum of small ones.

    order: of the states in z and in the small program; nonlinear ones come last. exponents:
    (M, n) of the monomials of a rate.
    """

    half, constant = 2, True

    def __init__(
        self, n: int, nonlinear: tuple[int, ...], cliques: tuple[tuple[int, ...], ...]
    ) -> None:
        self.n, self.chosen = n, tuple(range(n - len(nonlinear), n))
        self.order = [j for j in range(n) if j not in nonlinear] + list(nonlinear)
        self.place = 1 + np.argsort(self.order)  # of each state in y = (1, x)
        linear, products = monomials(n, [0, 1]), monomials(n, [2])
        curved = products[:, list(self.chosen)].any(axis=1)
        self.basis: IntArray = np.vstack([linear, products[curved]])
        self.weight = weights_of(self.basis, np.isin(np.arange(n), self.chosen))
        points = np.random.default_rng(n).normal(size=(4 * n, n))
        self.points: FloatArray = points / np.linalg.norm(points, axis=1)[:, None]
        self.small = CliqueProgram(n, [tuple(int(self.place[j]) - 1 for j in S) for S in cliques])
        rows = {tuple(row): place for place, row in enumerate(self.basis.tolist())}
        unit = np.vstack([np.zeros((1, n), dtype=np.int64), np.eye(n, dtype=np.int64)])
        # Where the products of each small Gram matrix are in `basis`.
        self.at = [
            [rows[tuple(row)] for row in unit[block.products].sum(axis=1).tolist()]
            for block in self.small.blocks
        ]
        used = {tuple(row) for row in linear.tolist()}
        for S in cliques:
            inside = monomials(len(S), [2, 3])
            wide = np.zeros((len(inside), n), dtype=np.int64)
            wide[:, list(S)] = inside
            used |= {tuple(row) for row in wide.tolist()}
        self.exponents: IntArray = np.array(sorted(used))
        # A polynomial with these exponents is known by its values at the same points.
        values = np.prod(self.exponents[:, None].astype(np.float64) ** self.exponents, axis=2)
        self._inverse = np.linalg.inv(values)

    def fitted(self, rates: FloatArray, forms: FloatArray) -> dict[Any, float]:
        """-2 Σ_i rate_i (forms x)_i in products of four entries of y; rates (M, n) at exponents."""
        coefficients = -2 * (self._inverse @ rates) @ forms
        found: dict[Any, float] = {}
        for row, exponent in zip(coefficients, self.exponents, strict=True):
            factors = self.place[np.repeat(np.arange(self.n), exponent)].tolist()
            for j in np.flatnonzero(row).tolist():
                used = sorted([*factors, int(self.place[j])])
                key = (*[0] * (4 - len(used)), *used)
                found[key] = found.get(key, 0.0) + float(row[j])
        return found

    def gram(self, solution: SphereSolution) -> FloatArray:
        """Gram matrix of the solution in the monomials `basis` of z."""
        return solution.X


class CliqueSteps(LSteps):
    """L-steps whose programs are `Cliques`; there are no limits, no w and no hold."""

    carries = False

    @classmethod
    def of(cls, steps: LSteps) -> "CliqueSteps | None":
        """The same L-steps by cliques, where that is possible and takes less time."""
        field = steps.field
        plain = not (len(steps.limits) or len(field.uncertain) or steps.pushed)
        if not plain or steps.widths is not None or field.n < LARGE or field.degree > MAX_DEGREE:
            return None
        cliques = cliques_of(field)
        if not cliques or share_of_work(field.n, len(steps.nonlinear), cliques) > CHEAPER:
            return None
        return cls(steps, cliques)

    def __init__(self, steps: LSteps, cliques: tuple[tuple[int, ...], ...]) -> None:
        super().__init__(steps.field, nonlinear=steps.nonlinear)
        self.cliques = Cliques(self.field.n, self.nonlinear, cliques)

    @cached_property
    def program(self) -> Any:
        """The cliques."""
        return self.cliques

    def solved_case(
        self,
        section: Section,
        rho: float,
        case: int,
        start: SphereSolution | None,
        enough: float = np.inf,
    ) -> SphereSolution:
        """φ, of the only case; `start` and `enough` change nothing."""
        del case, start, enough
        P, g = self._posed(section, rho)
        found = self.cliques.small.solve(P, g, tolerance=FINER * TOLERANCE)
        basis = self.cliques.basis
        Q = np.zeros((len(basis), len(basis)))
        for at, gram in zip(self.cliques.at, found.grams, strict=True):
            Q[np.ix_(at, at)] += gram
        order = self.cliques.order
        size = np.sqrt(np.diag(section.P))[order]
        M = substitution(basis, size[:, None] * section.base[order])
        X = M.T @ Q @ M
        gap = (found.upper - found.m) / float(np.abs(g).max())
        warm = X, found.moments, found.m
        return SphereSolution(found.m, found.upper, X, found.moments, gap, found.iterations, warm)

    def bounds(
        self, section: Section, rho: float, duals: list[SphereSolution], cases: Any
    ) -> list[float]:
        """φ's upper bound in the only case; an estimate where the dual is of another P."""
        del cases
        return [float(self._posed(section, rho)[1] @ duals[0].y)]

    def weights(self, solution: SphereSolution) -> FloatArray:
        """(N,) all points alike: moments have no weights at points."""
        del solution
        return np.full(len(self.program.points), 1 / len(self.program.points))

    def _posed(self, section: Section, rho: float) -> tuple[FloatArray, FloatArray]:
        """P of unit diagonal, and g = -Ẇ/ρ in the small program's monomials of x̄/√ρ, scaled."""
        cliques, order = self.cliques, self.cliques.order
        size = np.sqrt(np.diag(section.P))
        x_bar = np.sqrt(rho) * cliques.exponents / size
        u = section.u - x_bar @ section.K.T
        none = np.zeros((len(x_bar), 0))
        rates = self.rate(section, section.x + x_bar, u, none) - section.x_rate
        g = cliques.fitted(rates, section.P / size / np.sqrt(rho))
        turning = section.P_rate / size / size[:, None]
        for i, j in product(range(self.field.n), repeat=2):
            key = (0, 0, *sorted((int(cliques.place[i]), int(cliques.place[j]))))
            g[key] = g.get(key, 0.0) - turning[i, j]
        P = section.P / size / size[:, None]
        return P[np.ix_(order, order)], cliques.small.vector(g)
