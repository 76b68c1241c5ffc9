"""Cone programs and the only place that calls a solver.

    minimise ½x'Px + q'x   subject to   Ax + s = b,  s in a product of cones

Clarabel is called with a ladder of settings. Its status is a rumour: what is returned is judged by
the residuals computed here, and a caller that needs a proof takes the solution to the kernel.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Literal, TypeAlias

import clarabel
import numpy as np
import scipy.sparse as sp

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import DataError, Infeasible, ShapeError, SolverError
from nlsid_core.native import NativeStderr

ConeKind: TypeAlias = Literal["zero", "nonnegative", "second_order", "psd"]

# A solution is accepted with relative residuals below this; certificates keep a margin above it.
ACCEPTED_RESIDUAL = 1e-5
# Clarabel's own default; tighter stalls on problems whose optimum is not strictly feasible.
TOLERANCE = 1e-8
MAX_ITERATIONS = 200
SQRT2 = float(np.sqrt(2.0))
_STDERR: Final = NativeStderr()


@dataclass(frozen=True)
class Cone:
    """One block of s: `size` entries, or for `psd` the order n of an n×n matrix.

    A `psd` block holds the upper triangle column by column, off-diagonal entries times √2.
    """

    kind: ConeKind
    size: int

    @property
    def rows(self) -> int:
        """How many rows of A the block takes."""
        return self.size * (self.size + 1) // 2 if self.kind == "psd" else self.size


@dataclass(frozen=True, eq=False)
class ConeProgram:
    """P (n, n) symmetric, q (n,), A (m, n), b (m,), cones covering the m rows in order.

    Raises ShapeError if sizes do not fit, DataError on NaN or infinity.
    """

    P: sp.csc_matrix
    q: FloatArray
    A: sp.csc_matrix
    b: FloatArray
    cones: tuple[Cone, ...]

    def __post_init__(self) -> None:
        m, n = self.A.shape
        rows = sum(cone.rows for cone in self.cones)
        if self.P.shape != (n, n) or self.q.shape != (n,) or self.b.shape != (m,) or rows != m:
            raise ShapeError(
                f"A is {m}x{n}: P {self.P.shape}, q {self.q.shape}, b {self.b.shape}, "
                f"cones with {rows} rows do not fit"
            )
        for name in ("q", "b"):
            if not np.isfinite(getattr(self, name)).all():
                raise DataError(f"{name} of a cone program is not finite")
        if not (np.isfinite(self.A.data).all() and np.isfinite(self.P.data).all()):
            raise DataError("A or P of a cone program is not finite")


@dataclass(frozen=True, eq=False)
class ConeSolution:
    """x (n,) primal, s (m,) slack, z (m,) dual; `residual` the worst relative KKT residual.

    attempts: what was tried, in order, with the status each solver reported. seconds: wall clock.
    """

    x: FloatArray
    s: FloatArray
    z: FloatArray
    objective: float
    residual: float
    attempts: tuple[str, ...]
    seconds: float

    def __str__(self) -> str:
        return (
            f"objective {self.objective:.9g}, residual {self.residual:.1e}, "
            f"{self.seconds * 1e3:.1f} ms ({'; '.join(self.attempts)})"
        )


def solve(
    program: ConeProgram, *, tolerance: float = TOLERANCE, refined: bool = False
) -> ConeSolution:
    """Solve one cone program.

    Climbs a ladder until the residuals are acceptable: fast settings, iterative refinement on, data
    rescaled. refined: whether it starts with refinement on. Raises Infeasible if Clarabel certifies
    that there is no solution, SolverError if no rung finds one.
    """
    started = time.perf_counter()
    attempts: list[str] = []
    best: ConeSolution | None = None
    for rung, attempt in _LADDER[int(refined) :]:
        outcome = attempt(program, tolerance)
        attempts.append(f"{rung}: {outcome.status}")
        if "infeasible" in outcome.status.lower() or "unbounded" in outcome.status.lower():
            raise Infeasible(
                f"{'; '.join(attempts)}. Raise degrees, lower the level that is asked for, or "
                "bound the variables."
            )
        if outcome.x is None:
            continue
        residual = _residual(program, outcome.x, outcome.s, outcome.z)
        candidate = ConeSolution(
            x=outcome.x,
            s=outcome.s,
            z=outcome.z,
            objective=float(program.q @ outcome.x + outcome.x @ (program.P @ outcome.x) / 2),
            residual=residual,
            attempts=tuple(attempts),
            seconds=time.perf_counter() - started,
        )
        if best is None or residual < best.residual:
            best = candidate
        if residual <= ACCEPTED_RESIDUAL:
            return replace(best, attempts=tuple(attempts), seconds=time.perf_counter() - started)
    found = f" (best residual {best.residual:.1e})" if best else ""
    raise SolverError(f"no acceptable solution{found}: {'; '.join(attempts)}")


def svec(matrix: FloatArray) -> FloatArray:
    """Upper triangles of (…, n, n) column by column, off-diagonal entries times √2.

    Keeps inner products.
    """
    i, j = triangle(matrix.shape[-1])
    return np.asarray(matrix[..., i, j] * np.where(i == j, 1.0, SQRT2))


def smat(vector: FloatArray) -> FloatArray:
    """The symmetric matrix whose `svec` is `vector`."""
    n = int((np.sqrt(8 * len(vector) + 1) - 1) / 2 + 0.5)
    i, j = triangle(n)
    matrix = np.zeros((n, n))
    matrix[i, j] = matrix[j, i] = vector / np.where(i == j, 1.0, SQRT2)
    return matrix


def triangle(n: int) -> tuple[Any, Any]:
    """Row and column of each entry of `svec`."""
    j, i = np.tril_indices(n)
    return i, j


# -- the ladder ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Outcome:
    status: str
    x: Any = None
    s: Any = None
    z: Any = None


def _clarabel(program: ConeProgram, tolerance: float, *, refine: bool) -> _Outcome:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = MAX_ITERATIONS
    settings.max_threads = 1  # small problems: threads go to independent programs instead
    # Half the time of small programs is refinement that the next rung does if it is needed.
    settings.iterative_refinement_enable = refine
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    kinds = {
        "zero": clarabel.ZeroConeT,
        "nonnegative": clarabel.NonnegativeConeT,
        "second_order": clarabel.SecondOrderConeT,
        "psd": clarabel.PSDTriangleConeT,
    }
    cones = [kinds[cone.kind](cone.size) for cone in program.cones if cone.size]
    solver = clarabel.DefaultSolver(
        sp.triu(program.P, format="csc"), program.q, program.A, program.b, cones, settings
    )
    try:
        with _STDERR.without_panics():
            solution = solver.solve()
    except BaseException as panic:  # of the Rust library: neither an Exception nor exported
        if type(panic).__name__ != "PanicException":
            raise
        return _Outcome("panicked")
    status = str(solution.status)
    if status.startswith("Almost") and "Infeasible" in status:
        return _Outcome("stalled")  # no proof of infeasibility: a later rung decides
    return _Outcome(status, *(np.array(part) for part in (solution.x, solution.s, solution.z)))


def _clarabel_dual(program: ConeProgram, tolerance: float) -> _Outcome:
    """Solve the dual instead where it is smaller: few equalities, many unknowns.

    Columns V that only mirror a cone block (rows -x_V + s = 0) become slack. With the other rows G
    and columns F: minimise b_G'z with A_GF'z = -q_F, q_V + A_GV'z ∈ K, and z ∈ K where G has one.
    """
    split = _mirrored(program) if not program.P.nnz else None
    if split is None:
        return _clarabel(program, tolerance, refine=False)
    mirrored, columns, order, affine, cones = split
    others = np.setdiff1d(np.arange(len(program.b)), mirrored)
    free = np.setdiff1d(np.arange(len(program.q)), columns)
    G = program.A.tocsr()[others].tocsc()
    pick = np.searchsorted(others, affine)
    keep = sp.csc_matrix(
        (-np.ones(len(pick)), (np.arange(len(pick)), pick)), (len(pick), len(others))
    )
    dual = ConeProgram(
        P=sp.csc_matrix((len(others), len(others))),
        q=program.b[others],
        A=sp.vstack([G[:, free].T, -G[:, order].T, keep], format="csc"),
        b=np.concatenate([-program.q[free], program.q[order], np.zeros(len(pick))]),
        cones=(Cone("zero", len(free)), *cones),
    )
    outcome = _clarabel(dual, tolerance, refine=False)
    if outcome.x is None or "Infeasible" in outcome.status:
        swapped = {"PrimalInfeasible": "DualInfeasible", "DualInfeasible": "PrimalInfeasible"}
        return _Outcome(swapped.get(outcome.status, outcome.status))
    x, s, z = np.zeros(len(program.q)), np.zeros(len(program.b)), np.zeros(len(program.b))
    mirror = slice(len(free), len(free) + len(order))
    x[free], x[order] = -outcome.z[: len(free)], outcome.z[mirror]
    s[mirrored], s[affine] = x[order], outcome.z[mirror.stop :]
    z[others], z[mirrored] = outcome.x, outcome.s[mirror]
    return _Outcome(outcome.status, x, s, z)


def _mirrored(program: ConeProgram) -> tuple[Any, Any, Any, Any, list[Cone]] | None:
    """Rows and columns of cone blocks that are unknowns themselves; None if there are none.

    Returns the rows, the set of columns, the columns in row order, the rows of the other cones, and
    the cones: mirrored ones first, then the others.
    """
    A = program.A.tocsr()
    single = (np.diff(A.indptr) == 1) & (program.b == 0)
    single[single] = A.data[A.indptr[:-1][single]] == -1.0
    rows: list[IntArray] = []
    affine: list[IntArray] = []
    first: list[Cone] = []
    second: list[Cone] = []
    start = 0
    for cone in program.cones:
        block = np.arange(start, start + cone.rows)
        start += cone.rows
        if cone.kind == "zero":
            continue
        mirrors = bool(single[block].all())
        (rows if mirrors else affine).append(block)
        (first if mirrors else second).append(cone)
    if not rows:
        return None
    mirrored = np.concatenate(rows)
    order = A.indices[A.indptr[:-1][mirrored]]
    columns = np.unique(order)
    if len(columns) < len(order):  # one unknown in two cones: leave the program as it is
        return None
    other = np.concatenate([np.zeros(0, dtype=np.int64), *affine])
    return mirrored, columns, order, other, first + second


def _rescaled(program: ConeProgram, tolerance: float) -> _Outcome:
    """Columns of A to unit size, then b and q to unit size; undone afterwards."""
    size = np.sqrt(np.asarray(program.A.multiply(program.A).sum(axis=0)).ravel())
    D = 1.0 / np.where(size > 0, size, 1.0)
    primal = 1.0 / (float(np.abs(program.b).max(initial=0.0)) or 1.0)
    dual = 1.0 / (float(np.abs(D * program.q).max(initial=0.0)) or 1.0)
    scaled = ConeProgram(
        P=sp.csc_matrix(sp.diags(D) @ program.P @ sp.diags(D) * (dual / primal)),
        q=dual * D * program.q,
        A=sp.csc_matrix(program.A @ sp.diags(D)),
        b=primal * program.b,
        cones=program.cones,
    )
    outcome = _clarabel(scaled, tolerance, refine=True)
    if outcome.x is None:
        return outcome
    # Without an objective no multiplier is needed: zero ones are optimal for every feasible x.
    objective = program.q.any() or program.P.nnz
    z = outcome.z / dual if objective else np.zeros_like(outcome.z)
    return _Outcome(outcome.status, D * outcome.x / primal, outcome.s / primal, z)


_LADDER: tuple[tuple[str, Callable[[ConeProgram, float], _Outcome]], ...] = (
    ("clarabel", _clarabel_dual),
    ("clarabel refined", partial(_clarabel, refine=True)),
    ("clarabel rescaled", _rescaled),
)


def _residual(program: ConeProgram, x: FloatArray, s: FloatArray, z: FloatArray) -> float:
    """The worst of primal and dual residual and gap, each relative to the data it is made of."""
    Px = program.P @ x
    primal = np.abs(program.A @ x + s - program.b).max(initial=0.0)
    dual = np.abs(Px + program.q + program.A.T @ z).max(initial=0.0)
    gap = abs(float(x @ Px + program.q @ x + program.b @ z))
    worst = max(
        primal / (1 + np.abs(program.b).max(initial=0.0) + np.abs(s).max(initial=0.0)),
        dual / (1 + np.abs(program.q).max(initial=0.0) + np.abs(Px).max(initial=0.0)),
        gap / (1 + abs(float(program.q @ x))),
        -_smallest(program.cones, s) / (1 + np.abs(s).max(initial=0.0)),
        -_smallest(program.cones, z, dual=True) / (1 + np.abs(z).max(initial=0.0)),
    )
    return float(worst)


def _smallest(cones: Sequence[Cone], s: FloatArray, *, dual: bool = False) -> float:
    """How far inside its cone each block is; negative outside, 0 at most."""
    worst, start = 0.0, 0
    for cone in cones:
        block = s[start : start + cone.rows]
        start += cone.rows
        if not cone.size or (cone.kind == "zero" and dual):
            continue
        if cone.kind == "psd":
            worst = min(worst, float(np.linalg.eigvalsh(smat(block))[0]))
        elif cone.kind == "second_order":
            worst = min(worst, float(block[0] - np.linalg.norm(block[1:])))
        elif cone.kind == "nonnegative":
            worst = min(worst, float(np.min(block)))
        else:
            worst = min(worst, -float(np.abs(block).max()))
    return worst
