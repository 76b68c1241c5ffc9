"""Rows, columns and cones of a sums-of-squares program.

Unknowns are x = [decisions; svec of every Gram block]; each monomial of each identity is one
equality row, each Gram block one semidefinite cone.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram, ConeSolution
from nlsid_core.errors import DataError
from nlsid_core.polynomial import Polynomial
from nlsid_core.sos.basis import drop_inconsistent, gram_basis, sign_blocks
from nlsid_core.sos.program import (
    Constraint,
    Identity,
    NonNegative,
    NormBound,
    Program,
    Solution,
    SumOfSquares,
    scaling,
)
from nlsid_core.sos.terms import Block, candidates, gram_terms, inner_degree


@dataclass(eq=False)
class _Solved:
    """Where the pieces of one SumOfSquares sit in x."""

    constraint: SumOfSquares
    main: Block
    multipliers: list[Block]


@dataclass(eq=False)
class _Entries:
    """Values at (row, column); column -1 is the right-hand side."""

    row: list[IntArray] = field(default_factory=list)
    column: list[IntArray] = field(default_factory=list)
    value: list[FloatArray] = field(default_factory=list)

    def append(self, row: Any, column: Any, value: FloatArray) -> None:
        for store, part in ((self.row, row), (self.column, column)):
            store.append(np.broadcast_to(np.asarray(part, dtype=np.int64), value.shape))
        self.value.append(value)


class Builder:
    """Reads the constraints of a program one by one and lays out rows, columns and cones.

    Raises DataError if an unknown occurs nonlinearly.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self.size = scaling(program)
        self.decisions: dict[str, int] = {}
        self.equality, self.cone = _Entries(), _Entries()
        self.equality_rows = self.cone_rows = 0
        self.cones: list[Cone] = []
        self.solved: list[_Solved] = []
        for constraint in program.constraints:
            for p in _polynomials(constraint):
                self._register(p)
        if program.minimise is not None:
            self._register(program.minimise)
        self.columns = len(self.decisions)
        for constraint in program.constraints:
            self._add(constraint)

    # -- reading polynomials -----------------------------------------------------------------

    def _register(self, p: Polynomial) -> None:
        for j, name in enumerate(p.names):
            if name not in self.program.indeterminates and p.exponents[:, j].any():
                self.decisions.setdefault(name, len(self.decisions))

    def _split(self, p: Polynomial) -> tuple[IntArray, IntArray, FloatArray]:
        """Per term: exponents in the indeterminates, decision (-1: none), value."""
        names = self.program.indeterminates
        decision = np.full(len(p), -1, dtype=np.int64)
        degree = np.zeros(len(p), dtype=np.int64)
        exponents = np.zeros((len(p), len(names)), dtype=np.int64)
        for name, column in zip(p.names, p.exponents.T, strict=True):
            if name in self.decisions:
                decision[column > 0] = self.decisions[name]
                degree += column
            elif name in names:
                exponents[:, names.index(name)] = column
        if (degree > 1).any():
            bad = Polynomial(p.exponents[degree > 1], p.coefficients[degree > 1], p.names)
            raise DataError(f"decisions should occur linearly; found {bad}")
        return exponents, decision, np.asarray(p.coefficients, dtype=np.float64)

    # -- constraints -------------------------------------------------------------------------

    def _add(self, constraint: Constraint) -> None:
        if isinstance(constraint, SumOfSquares):
            self._add_squares(constraint)
        elif isinstance(constraint, NonNegative):
            self._affine_rows((constraint.p,), Cone("nonnegative", 1))
        else:
            entries = (constraint.bound, *constraint.entries)
            self._affine_rows(entries, Cone("second_order", len(entries)))

    def _add_squares(self, constraint: SumOfSquares) -> None:
        names, forms = self.program.indeterminates, constraint.forms
        exponents, decision, value = self._split(constraint.p)
        domain = [g.over(names) for g in constraint.domain]
        inner = np.array([name not in forms for name in names])
        given = [exponents, *(g.exponents for g in domain)]
        least = max(inner_degree(rows, inner) for rows in given)
        degree = least + least % 2

        symmetry = np.concatenate(given)
        pieces = [(exponents, decision, value)]
        blocks = []
        for g in domain:
            room = max(degree - inner_degree(g.exponents, inner), 0)
            block = self._block(candidates(names, forms, room // 2), symmetry)
            blocks.append(block)
            pieces.append(gram_terms(block, g))
        support = np.unique(np.concatenate([piece[0] for piece in pieces]), axis=0)
        basis = gram_basis(support)
        if forms:
            basis = drop_inconsistent(candidates(names, forms, degree // 2), support)
        main = self._block(basis, symmetry)
        unit = Polynomial(np.zeros((1, len(names)), dtype=np.int64), np.ones(1), names)
        pieces.append(gram_terms(main, unit))
        rows, columns, values = zip(*pieces, strict=True)
        self._rows(
            np.concatenate(rows),
            np.concatenate(columns),
            np.concatenate([values[0], *(-part for part in values[1:])]),
        )
        self.solved.append(_Solved(constraint, main, blocks))

    def _block(self, basis: IntArray, symmetry: IntArray) -> Block:
        parts = [part for part in sign_blocks(basis, symmetry) if len(part)]
        starts = []
        for part in parts:
            starts.append(self.columns)
            cone = Cone("psd", len(part)) if len(part) > 1 else Cone("nonnegative", 1)
            rows = np.arange(cone.rows)
            # s = svec(X) ⪰ 0, as -x + s = 0.
            self.cone.append(self.cone_rows + rows, self.columns + rows, np.full(cone.rows, -1.0))
            self.cone_rows += cone.rows
            self.columns += cone.rows
            self.cones.append(cone)
        return Block(basis, tuple(parts), tuple(starts))

    def _rows(self, exponents: IntArray, column: IntArray, value: FloatArray) -> None:
        """One equality row per monomial: Σ value·x[column] = 0, constants to the right."""
        monomials_used, row = np.unique(exponents, axis=0, return_inverse=True)
        # Row of x^α in variables of size 1: times size^α.
        value = value * np.prod(self.size**exponents, axis=1)
        self.equality.append(self.equality_rows + row.ravel(), column, value)
        self.equality_rows += len(monomials_used)

    def _affine_rows(self, entries: tuple[Polynomial, ...], cone: Cone) -> None:
        """s = entries, as -entries(x) + s = constant."""
        for k, p in enumerate(entries):
            exponents, decision, value = self._split(p)
            if exponents.any():
                raise DataError(
                    f"{p} should not depend on {', '.join(self.program.indeterminates)}"
                )
            self.cone.append(self.cone_rows + k, decision, -value)
        self.cone_rows += cone.rows
        self.cones.append(cone)

    # -- assembly ----------------------------------------------------------------------------

    def cone_program(self) -> ConeProgram:
        """The cone data."""
        sizes = self._column_sizes()
        value: list[FloatArray] = [
            np.asarray(values * sizes[column])
            for values, column in zip(self.equality.value, self.equality.column, strict=True)
        ]
        value += self.cone.value
        shifted = [row + self.equality_rows for row in self.cone.row]
        row = np.concatenate([*self.equality.row, *shifted])
        column = np.concatenate([*self.equality.column, *self.cone.column])
        values, known = np.concatenate(value), column < 0
        rows = self.equality_rows + self.cone_rows
        A = sp.csc_matrix(
            (values[~known], (row[~known], column[~known])), shape=(rows, self.columns)
        )
        b = np.zeros(rows)
        np.subtract.at(b, row[known], values[known])
        q = np.zeros(self.columns)
        objective = self.program.minimise
        if objective is not None:
            exponents, decision, weight = self._split(objective)
            if exponents.any():
                raise DataError(f"the objective {objective} should be affine in the decisions")
            np.add.at(q, decision[decision >= 0], weight[decision >= 0])
        cones = (Cone("zero", self.equality_rows), *self.cones)
        return ConeProgram(sp.csc_matrix((self.columns, self.columns)), q, A, b, cones)

    def _column_sizes(self) -> FloatArray:
        """What each unknown is when the solver's is 1; the last entry is the right-hand side."""
        sizes = np.ones(self.columns + 1)
        for solved in self.solved:
            for block in [solved.main, *solved.multipliers]:
                power = np.prod(self.size**block.basis, axis=1)
                for part, start in zip(block.parts, block.starts, strict=True):
                    i, j = conic.triangle(len(part))
                    sizes[start : start + len(i)] = 1 / (power[part][i] * power[part][j])
        return sizes

    def solution(self, cone: ConeSolution) -> Solution:
        """Decisions, Gram matrices and multipliers out of a cone solution."""
        x = cone.x * self._column_sizes()[:-1]
        values = {name: float(x[k]) for name, k in self.decisions.items()}
        found = Solution(values, (), 0.0, cone)
        names, goal = self.program.indeterminates, self.program.minimise
        identities = tuple(
            Identity(
                p=found.value(solved.constraint.p).over(names),
                gram=solved.main.gram(x, names),
                multipliers=tuple(block.gram(x, names) for block in solved.multipliers),
                name=solved.constraint.name,
            )
            for solved in self.solved
        )
        reached = 0.0 if goal is None else float(found.value(goal))
        return Solution(values, identities, reached, cone)


def solve(program: Program) -> Solution:
    """Choose bases and multipliers, lay out the cone data and solve it.

    Raises DataError if an unknown occurs nonlinearly, Infeasible or SolverError as `conic.solve`.
    """
    builder = Builder(program)
    return builder.solution(conic.solve(builder.cone_program()))


def _polynomials(constraint: Constraint) -> tuple[Polynomial, ...]:
    if isinstance(constraint, NormBound):
        return (constraint.bound, *constraint.entries)
    return (constraint.p,)
