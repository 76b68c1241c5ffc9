"""Rows, columns and cones of a sums-of-squares program.

Unknowns are x = [decisions; free multipliers; svec of every Gram block]; each monomial of each
identity is one equality row, each Gram block one semidefinite cone.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeSolution
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
    Zero,
    scaling,
)
from nlsid_core.sos.terms import (
    Block,
    candidates,
    free_candidates,
    free_terms,
    gram_terms,
    inner_degree,
)

Values: TypeAlias = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Layout:
    """Entries of A (in the order of `pattern`) and of b, as maps from parameter monomials.

    features: (k, number of parameters) exponents of those monomials. q, cones: as in `conic`.
    """

    features: IntArray
    pattern: sp.csc_matrix
    A_map: sp.csr_matrix
    b_map: sp.csr_matrix
    q: FloatArray
    cones: tuple[Cone, ...]


@dataclass(eq=False)
class _Solved:
    """Where the pieces of one SumOfSquares sit in x."""

    constraint: SumOfSquares
    main: Block
    multipliers: list[Block]
    free: list[tuple[IntArray, int]]


@dataclass(eq=False)
class _Entries:
    """Values at (row, column, parameter monomial); column -1 is the right-hand side."""

    row: list[IntArray] = field(default_factory=list)
    column: list[IntArray] = field(default_factory=list)
    feature: list[IntArray] = field(default_factory=list)
    value: list[FloatArray] = field(default_factory=list)

    def append(self, row: Any, column: Any, feature: Any, value: FloatArray) -> None:
        for store, part in (
            (self.row, row),
            (self.column, column),
            (self.feature, feature),
        ):
            store.append(np.broadcast_to(np.asarray(part, dtype=np.int64), value.shape))
        self.value.append(value)


class Builder:
    """Reads the constraints of a program one by one and lays out rows, columns and cones."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.size = scaling(program)
        self.decisions: dict[str, int] = {}
        self._features: dict[tuple[int, ...], int] = {(0,) * len(program.parameters): 0}
        self.columns = 0
        self.equality, self.cone = _Entries(), _Entries()
        self.equality_rows = self.cone_rows = 0
        self.cones: list[Cone] = []
        self.solved: list[_Solved] = []
        for constraint in program.constraints:
            for p in _polynomials(constraint):
                self._register(p)
        for objective in (program.maximise, program.minimise):
            if objective is not None:
                self._register(objective)
        self.columns = len(self.decisions)

    def features(self) -> IntArray:
        """(k, number of parameters) exponents of the parameter monomials in use."""
        rows = np.array(list(self._features), dtype=np.int64)
        return rows.reshape(len(self._features), len(self.program.parameters))

    # -- reading polynomials -----------------------------------------------------------------

    def _register(self, p: Polynomial) -> None:
        known = {*self.program.indeterminates, *self.program.parameters}
        for j, name in enumerate(p.names):
            if name not in known and p.exponents[:, j].any():
                self.decisions.setdefault(name, len(self.decisions))

    def _split(self, p: Polynomial) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        """Per term: exponents in the indeterminates, decision (-1: none), parameters, value."""
        program = self.program
        at = {name: j for j, name in enumerate(p.names)}
        zero = np.zeros(len(p), dtype=np.int64)

        def columns(names: tuple[str, ...]) -> IntArray:
            picked = [p.exponents[:, at[name]] if name in at else zero for name in names]
            return np.array(picked, dtype=np.int64).reshape(len(names), len(p)).T

        decision = np.full(len(p), -1, dtype=np.int64)
        degree = zero.copy()
        for name, j in at.items():
            if name in self.decisions:
                used = p.exponents[:, j] > 0
                decision[used] = self.decisions[name]
                degree += p.exponents[:, j]
        if (degree > 1).any():
            bad = Polynomial(p.exponents[degree > 1], p.coefficients[degree > 1], p.names)
            raise DataError(f"decisions should occur linearly; found {bad}")
        keys = map(tuple, columns(program.parameters).tolist())
        feature = np.array(
            [self._features.setdefault(key, len(self._features)) for key in keys], dtype=np.int64
        )
        coefficients = np.asarray(p.coefficients, dtype=np.float64)
        return columns(program.indeterminates), decision, feature, coefficients

    # -- constraints -------------------------------------------------------------------------

    def add(self, constraint: Constraint) -> None:
        """Append one constraint."""
        if isinstance(constraint, SumOfSquares):
            self._add_squares(constraint)
        elif isinstance(constraint, Zero):
            exponents, decision, feature, value = self._split(constraint.p)
            self._rows(exponents, decision, feature, value)
        elif isinstance(constraint, NonNegative):
            self._affine_rows((constraint.p,), Cone("nonnegative", 1))
        else:
            entries = (constraint.bound, *constraint.entries)
            self._affine_rows(entries, Cone("second_order", len(entries)))

    def _add_squares(self, constraint: SumOfSquares) -> None:
        names = self.program.indeterminates
        exponents, decision, feature, value = self._split(constraint.p)
        domain = [g.over(names) for g in constraint.domain]
        equalities = [h.over(names) for h in constraint.equalities]
        inner = np.array([name not in constraint.forms for name in names])
        given = [exponents, *(g.exponents for g in domain + equalities)]
        least = max(inner_degree(rows, inner) for rows in given)
        degree = least + least % 2 if constraint.degree is None else constraint.degree

        parts = [g.exponents for g in domain + equalities]
        symmetry = np.concatenate([exponents, *parts])
        pieces = [(exponents, decision, feature, value)]
        support = [exponents]
        blocks, free = [], []
        for g in domain:
            room = max(degree - inner_degree(g.exponents, inner), 0)
            basis = candidates(names, constraint.forms, room // 2)
            if constraint.vanishing:
                basis = basis[
                    basis[:, [name in constraint.vanishing for name in names]].any(axis=1)
                ]
            block = self._block(basis, symmetry)
            blocks.append(block)
            pieces.append(gram_terms(block, g))
            support.append(pieces[-1][0])
        for h in equalities:
            room = max(degree - inner_degree(h.exponents, inner), 0)
            basis = free_candidates(names, constraint.forms, room, symmetry)
            start, self.columns = self.columns, self.columns + len(basis)
            free.append((basis, start))
            pieces.append(free_terms(basis, start, h))
            support.append(pieces[-1][0])
        everything = np.unique(np.concatenate(support), axis=0)
        main = self._block(self._main_basis(constraint, everything, degree), symmetry)
        unit = Polynomial(np.zeros((1, len(names)), dtype=np.int64), np.ones(1), names)
        pieces.append(gram_terms(main, unit))
        columns = [np.concatenate([piece[k] for piece in pieces]) for k in range(4)]
        columns[3] = np.concatenate([pieces[0][3], *(-piece[3] for piece in pieces[1:])])
        self._rows(columns[0], columns[1], columns[2], columns[3])
        self.solved.append(_Solved(constraint, main, blocks, free))

    def _main_basis(self, constraint: SumOfSquares, support: IntArray, degree: int) -> IntArray:
        if constraint.basis is not None:
            return np.asarray(constraint.basis, dtype=np.int64)
        if not constraint.forms:
            return gram_basis(support)
        everything = candidates(self.program.indeterminates, constraint.forms, degree // 2)
        return drop_inconsistent(everything, support)

    def _block(self, basis: IntArray, symmetry: IntArray) -> Block:
        parts = [part for part in sign_blocks(basis, symmetry) if len(part)]
        starts = []
        for part in parts:
            starts.append(self.columns)
            cone = Cone("psd", len(part)) if len(part) > 1 else Cone("nonnegative", 1)
            rows = np.arange(cone.rows)
            # s = svec(X) ⪰ 0, as -x + s = 0.
            self.cone.append(
                self.cone_rows + rows, self.columns + rows, 0, np.full(cone.rows, -1.0)
            )
            self.cone_rows += cone.rows
            self.columns += cone.rows
            self.cones.append(cone)
        return Block(basis, tuple(parts), tuple(starts))

    def _rows(
        self,
        exponents: IntArray,
        column: IntArray,
        feature: IntArray,
        value: FloatArray,
    ) -> None:
        """One equality row per monomial: Σ value·x[column] = 0, constants to the right."""
        monomials_used, row = np.unique(exponents, axis=0, return_inverse=True)
        # Row of x^α in variables of size 1: times size^α.
        value = value * np.prod(self.size**exponents, axis=1)
        self.equality.append(self.equality_rows + row.ravel(), column, feature, value)
        self.equality_rows += len(monomials_used)

    def _affine_rows(self, entries: tuple[Polynomial, ...], cone: Cone) -> None:
        """s = entries, as -entries(x) + s = constant."""
        for k, p in enumerate(entries):
            exponents, decision, feature, value = self._split(p)
            if exponents.any():
                raise DataError(
                    f"{p} should not depend on {', '.join(self.program.indeterminates)}"
                )
            self.cone.append(self.cone_rows + k, decision, feature, -value)
        self.cone_rows += cone.rows
        self.cones.append(cone)

    # -- assembly ----------------------------------------------------------------------------

    def finish(self) -> "Layout":
        """The cone data as a function of the parameters."""
        sizes = self._column_sizes()
        self.equality.value = [
            v * sizes[c] for v, c in zip(self.equality.value, self.equality.column, strict=True)
        ]
        shift = _Entries(
            [row + self.equality_rows for row in self.cone.row],
            self.cone.column,
            self.cone.feature,
            self.cone.value,
        )
        row, column, feature, value = (
            np.concatenate([np.zeros(0), *getattr(self.equality, k), *getattr(shift, k)])
            for k in ("row", "column", "feature", "value")
        )
        row, column, feature = (part.astype(np.int64) for part in (row, column, feature))
        rows, features = self.equality_rows + self.cone_rows, len(self._features)
        constant = column < 0
        b_map = sp.csr_matrix(
            (-value[constant], (row[constant], feature[constant])), (rows, features)
        )
        key = column[~constant] * rows + row[~constant]
        place, slot = np.unique(key, return_inverse=True)
        A_map = sp.csr_matrix(
            (value[~constant], (slot.ravel(), feature[~constant])), (len(place), features)
        )
        indptr = np.searchsorted(place, np.arange(self.columns + 1) * rows)
        pattern = sp.csc_matrix((np.ones(len(place)), place % rows, indptr), (rows, self.columns))
        q = np.zeros(self.columns)
        objective = self.program.minimise
        if self.program.maximise is not None:
            objective = -self.program.maximise
        if objective is not None:
            exponents, decision, feature, weight = self._split(objective)
            if exponents.any() or feature.any():
                raise DataError(f"the objective {objective} should be affine in the decisions")
            np.add.at(q, decision[decision >= 0], weight[decision >= 0])
        cones = (Cone("zero", self.equality_rows), *self.cones)
        return Layout(self.features(), pattern, A_map, b_map, q, cones)

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

    def solution(self, cone: ConeSolution, parameters: Values) -> Solution:
        """Decisions, Gram matrices and multipliers out of a cone solution."""
        x = cone.x * self._column_sizes()[:-1]
        values = {name: float(x[k]) for name, k in self.decisions.items()}
        given = {name: float(parameters[name]) for name in self.program.parameters}
        names = self.program.indeterminates
        identities = []
        for solved in self.solved:
            p = solved.constraint.p
            known = {k: v for k, v in (values | given).items() if k in p.names}
            identities.append(
                Identity(
                    p=p.substitute(known).over(names),
                    gram=solved.main.gram(x, names),
                    multipliers=tuple(block.gram(x, names) for block in solved.multipliers),
                    equality_multipliers=tuple(
                        Polynomial(basis, x[start : start + len(basis)], names)
                        for basis, start in solved.free
                    ),
                    name=solved.constraint.name,
                )
            )
        maximise, minimise = self.program.maximise, self.program.minimise
        goal = minimise if maximise is None else maximise
        reached = 0.0
        if goal is not None:
            reached = float(goal.substitute({k: v for k, v in values.items() if k in goal.names}))
        return Solution(values, tuple(identities), reached, cone)


def _polynomials(constraint: Constraint) -> tuple[Polynomial, ...]:
    if isinstance(constraint, NormBound):
        return (constraint.bound, *constraint.entries)
    return (constraint.p,)
