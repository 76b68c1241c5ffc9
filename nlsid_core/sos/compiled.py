"""From a program to cone data: compiled once, solved again with other parameter values."""

from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray
from nlsid_core.conic import ConeProgram
from nlsid_core.errors import DataError
from nlsid_core.sos.builder import Builder, Layout, Values
from nlsid_core.sos.program import Program, Solution


@dataclass(frozen=True, eq=False)
class Compiled:
    """Cone data of a program; `solve` fills in parameter values and solves it."""

    program: Program
    builder: Builder
    layout: Layout

    def cone_program(self, parameters: Values | None = None) -> ConeProgram:
        """The cone data for these parameter values."""
        phi = self._features(parameters or {})
        layout = self.layout
        A = sp.csc_matrix(
            (layout.A_map @ phi, layout.pattern.indices, layout.pattern.indptr),
            layout.pattern.shape,
        )
        n = len(layout.q)
        P = sp.csc_matrix((n, n))
        return ConeProgram(P, layout.q, A, layout.b_map @ phi, layout.cones)

    def solve(
        self,
        parameters: Values | None = None,
        *,
        solver: str = "clarabel",
        tolerance: float = conic.TOLERANCE,
    ) -> Solution:
        """Solve for these parameter values. Raises Infeasible or SolverError, as `conic.solve`."""
        parameters = parameters or {}
        cone = conic.solve(self.cone_program(parameters), solver, tolerance=tolerance)
        return self.builder.solution(cone, parameters)

    def solve_all(
        self, cases: Iterable[Values], *, executor: Executor | None = None, solver: str = "clarabel"
    ) -> list[Solution]:
        """Solve for many parameter values, in order; threads unless an executor is given."""
        cases = list(cases)
        programs = [self.cone_program(case) for case in cases]
        cones = conic.solve_all(programs, executor=executor, solver=solver)
        return [self.builder.solution(c, case) for c, case in zip(cones, cases, strict=True)]

    def _features(self, parameters: Values) -> FloatArray:
        names = self.program.parameters
        missing = [name for name in names if name not in parameters]
        if missing:
            raise DataError(f"no value for the parameter {', '.join(missing)}")
        point = np.array([parameters[name] for name in names], dtype=np.float64)
        monomial, which = np.nonzero(self.layout.features)
        phi = np.ones(len(self.layout.features))
        np.multiply.at(phi, monomial, point[which] ** self.layout.features[monomial, which])
        return phi


def compile_program(program: Program) -> Compiled:
    """Choose bases and multipliers and lay out the cone data.

    Raises DataError if an unknown occurs nonlinearly.
    """
    builder = Builder(program)
    for constraint in program.constraints:
        builder.add(constraint)
    return Compiled(program, builder, builder.finish())


def solve(
    program: Program,
    *,
    parameters: Values | None = None,
    solver: str = "clarabel",
    tolerance: float = conic.TOLERANCE,
) -> Solution:
    """Compile and solve once."""
    return compile_program(program).solve(parameters, solver=solver, tolerance=tolerance)
