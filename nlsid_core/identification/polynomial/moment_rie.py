"""Robust identification error through moments: one program, however long the data.

Minimise tr(R M) over the model, V = |x₁ - x₂|²_P and R, such that the model is stable and |Λ|²_R
dominates the robust identification error; then tr(R M) ≥ the mean squared simulation error. With
moments from repeated experiments the bias of measurement noise is gone.

Unknowns: P (storage function, n × n), c (equation error ε = c'Λ, that is e = c[:D], f from -c[D:]),
R, and for D = 3 six numbers τ that say how a monomial is split over Gram entries. With
Δ = x - x̃, d = v - y, s = v + ṽ or the measured y, the two inequalities are affine in the unknowns:
    (3.8)  2d(e(v) - e(ṽ) + c_x'Δ) + |Δ|²_P - |[d; SΔ]|²_P - δ|Δ|²      = z₈'G₈z₈ + ½ c₃ d⁴,
    (3.9)  |Λ|²_R - Δ_1² + |Δ|²_P - |[d; SΔ]|²_P + 2d(e(v) - f(x, w))  = z₉'G₉z₉,
    z₈ = [Δ, d, sd] (the d⁴ stands alone by sign symmetry), z₉ = [Λ, Δ, d, yd, d²].
Source: thesis (3.6)-(3.9), Claim 3.6, Section 3.5.2, with V = |x₁ - x₂|²_P, Q = e₁e₁' and Lemmas
2.10, 2.16.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.identification.methods.inequalities import MatrixInequality
from nlsid_core.identification.polynomial.moments import (
    Moments,
    Offsets,
    offsets_of,
    repeated_moments,
)
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.identification.repeats import refuse_false_repeats
from nlsid_core.models import MonotoneEquation, signals_of

DELTA = 1e-3  # δ of (3.8), V ≥ δ|Δ|² more than needed: what leaves the exact proof room
SPLITS = 6  # τ: of y d, y²d, y³d, d², y² d², y²d²
POWER_FLOOR = 1e-3  # an estimated mean square of yᵏ below this part of (mean square of y)ᵏ is noise


@dataclass(frozen=True, eq=False)
class MomentFit:
    """model; proof; bound: tr(R M), an upper bound of the mean squared simulation error (squared
    unit of y) as far as the moments are right.
    """

    model: MonotoneEquation
    proof: StabilityProof
    bound: float


def identify_from_repeats(
    data: Dataset,
    model_class: Polynomial,
    *,
    transient: int = 0,
    accept_untested_repeats: bool = False,
    slowest: float = 1.0,
) -> MomentFit:
    """Identify a `MonotoneEquation` from the dataset's groups of repeats, proved stable.

    Trajectories without a repeat are not used. transient: samples at the start of each that the
    test of the repeats leaves out. accept_untested_repeats: skip that test; the bias of noise is
    then removed only if the trials repeat one excitation all the same. slowest: as of
    `minimise_moment_rie`.
    Raises DataError if there are no repeats or they are not repeats, ShapeError for several
    outputs, Infeasible or SolverError as `minimise_moment_rie`.
    """
    groups = tuple(data.repeats().values())
    if not groups:
        raise DataError(
            "no two trajectories share a `group`: bias removal needs repeated experiments; without "
            "them use another method"
        )
    if not accept_untested_repeats:
        refuse_false_repeats(data, transient=transient)
    used = Dataset(tuple(trial for group in groups for trial in group))
    offsets = offsets_of(used.trajectories)
    moments = repeated_moments(groups, model_class, offsets)
    return minimise_moment_rie(moments, model_class, used, offsets, slowest=slowest)


def minimise_moment_rie(
    moments: Moments,
    model_class: Polynomial,
    data: Dataset,
    offsets: Offsets,
    *,
    slowest: float = 1.0,
) -> MomentFit:
    """The stable model with the least bound on these moments, and its exact proof.

    data: what they are of. slowest: V shrinks by its square or more, a sample.
    Raises DataError if the moments are not those of a signal, Infeasible if the minimiser has no
    exact proof, SolverError if the solver gives up.
    """
    problem = Problem.of(moments, model_class.lags, slowest)
    solution = problem.solve()
    c = (problem.columns * solution.x)[problem.layout.c]
    model = equation(c / c[0], model_class, data, offsets)  # the scale of both sides is free
    proof = prove_stability(model)
    if proof is None:
        raise Infeasible(
            f"no exact proof for the minimiser ({solution}); try fewer lags, or give more data"
        )
    return MomentFit(model, proof, float(solution.objective * problem.unit**2))


def equation(
    c: FloatArray, model_class: Polynomial, data: Dataset, offsets: Offsets
) -> MonotoneEquation:
    """The model ε = c'Λ = 0."""
    D, n, first = model_class.degrees.left, model_class.lags, data.trajectories[0]
    return MonotoneEquation(
        e=np.concatenate([c[:D], np.zeros(3 - D)]),
        a=-c[D + 1 : D + 1 + n],
        b=-c[D + 1 + n :],
        c=-float(c[D]),
        window=model_class.window(first.u.shape[1]),
        y_offset=offsets.y,
        u_offset=offsets.u,
        period=data.period,
        y=signals_of(first, "y")[0],
        u=signals_of(first, "u"),
        bags=data.bags,
    )


@dataclass(frozen=True)
class Layout:
    """Where the unknowns are: lags n, window entries m, degree D of e."""

    lags: int
    window: int
    degree: int

    @property
    def monomials(self) -> int:
        """The length of Λ."""
        return self.degree + 1 + self.lags + self.window

    @cached_property
    def P(self) -> IntArray:
        """(n, n) column of each entry of P."""
        return _symmetric(0, self.lags)

    @cached_property
    def c(self) -> IntArray:
        """(length of Λ,) columns of the equation error's coefficients."""
        start = self.lags * (self.lags + 1) // 2
        return start + np.arange(self.monomials)

    @cached_property
    def R(self) -> IntArray:
        """(length of Λ, same) column of each entry of R."""
        return _symmetric(int(self.c[-1]) + 1, self.monomials)

    @property
    def unknowns(self) -> int:
        """How many columns there are."""
        return int(np.max(self.R)) + 1 + (SPLITS if self.degree == 3 else 0)

    @property
    def past(self) -> IntArray:
        """Columns of c that multiply y(t-1) … y(t-n)."""
        return self.c[self.degree + 1 : self.degree + 1 + self.lags]

    def stability(self, delta: float, rate: float = 1.0) -> MatrixInequality:
        """G₈, with rate² P in the place of the P of Δ."""
        n, d, sd = self.lags, self.lags, self.lags + 1
        size = n + 1 if self.degree == 1 else n + 2
        G = np.zeros((1 + self.unknowns, size, size))
        self._storage(G, 0, d, rate)
        for k in range(n):
            _add(G, k, k, None, -delta)
            _add(G, k, d, self.past[k], 1.0)
        _add(G, d, d, self.c[0], 2.0)
        if self.degree == 3:
            _add(G, d, sd, self.c[1], 1.0)
            _add(G, sd, sd, self.c[2], 1.5)
        return MatrixInequality(G)

    def error_bound(self) -> MatrixInequality:
        """G₉."""
        n, L, D = self.lags, self.monomials, self.degree
        d, yd, dd = L + n, L + n + 1, L + n + 2
        size = L + n + 1 if D == 1 else L + n + 3
        G = np.zeros((1 + self.unknowns, size, size))
        for i in range(L):
            for j in range(i, L):
                _add(G, i, j, self.R[i, j], 1.0)
            _add(G, i, d, self.c[i], 1.0)
        self._storage(G, L, d)
        _add(G, L, L, None, -1.0)
        for k in range(n):
            _add(G, L + k, d, self.past[k], 1.0)
        _add(G, d, d, self.c[0], 2.0)
        if D == 3:
            second, third = self.c[1], self.c[2]
            _add(G, d, yd, second, 2.0)
            _add(G, d, dd, second, 1.0)
            _add(G, yd, yd, third, 6.0)
            _add(G, yd, dd, third, 3.0)
            _add(G, dd, dd, third, 2.0)
            y, y2, y3, one = range(4)
            tau = self.unknowns - SPLITS
            # The same monomial twice: what one entry gives, the other takes.
            for k, (plus, minus, weight) in enumerate(
                (
                    ((one, yd), (y, d), 1.0),
                    ((y, yd), (y2, d), 1.0),
                    ((y2, yd), (y3, d), 1.0),
                    ((one, dd), (d, d), 2.0),
                    ((y, dd), (d, yd), 1.0),
                    ((y2, dd), (yd, yd), 2.0),
                )
            ):
                _add(G, *plus, tau + k, 1.0)
                _add(G, *minus, tau + k, -weight)
        return MatrixInequality(G)

    def _storage(self, G: FloatArray, start: int, d: int, rate: float = 1.0) -> None:
        """rate²|Δ|²_P - |[d; Δ_1 … Δ_{n-1}]|²_P, Δ from index `start` on."""
        place = [d, *range(start, start + self.lags - 1)]
        for k in range(self.lags):
            for j in range(k, self.lags):
                _add(G, start + k, start + j, self.P[k, j], rate**2)
                _add(G, place[k], place[j], self.P[k, j], -1.0)


@dataclass(frozen=True, eq=False)
class Problem:
    """Scaled data: unknowns x = columns·x̄, moments of unit diagonal, errors in units of `unit`."""

    layout: Layout
    M: FloatArray
    unit: float
    columns: FloatArray
    blocks: tuple[MatrixInequality, MatrixInequality]

    @classmethod
    def of(cls, moments: Moments, n: int, slowest: float = 1.0) -> "Problem":
        """The scaled problem for n lags."""
        raw = moments.matrix()
        layout = Layout(n, len(raw) - moments.degree - 1 - n, moments.degree)
        D = _sizes(raw, moments.degree)
        values, vectors = np.linalg.eigh(raw / np.outer(D, D))
        M = (vectors * np.maximum(values, 0.0)) @ vectors.T
        unit = float(D[0])
        columns = np.ones(layout.unknowns)
        columns[layout.c] = unit / D
        columns[layout.R] = unit**2 / np.outer(D, D)
        # Rows: Λ in units of D, Δ and d of `unit`, yd and d² of its square; all over `unit`.
        small = np.ones(n + 1)
        rows8, rows9 = small, np.concatenate([D / unit, small])
        if moments.degree == 3:
            rows8 = np.concatenate([small, [unit]])
            rows9 = np.concatenate([rows9, [unit, unit]])
            columns[-SPLITS:] = 1.0 / np.tile([1.0, D[0], D[1]], 2)
        return cls(
            layout=layout,
            M=M,
            unit=unit,
            columns=columns,
            blocks=(
                _scaled(layout.stability(DELTA, slowest), rows8, columns),
                _scaled(layout.error_bound(), rows9, columns),
            ),
        )

    def solve(self) -> conic.ConeSolution:
        """Minimise tr(R M)."""
        q = np.zeros(self.layout.unknowns)
        np.add.at(q, self.layout.R.ravel(), self.M.ravel())
        program = ConeProgram(
            P=sp.csc_matrix((len(q), len(q))),
            q=q,
            A=sp.csc_matrix(np.vstack([-conic.svec(block.F[1:]).T for block in self.blocks])),
            b=np.concatenate([conic.svec(block.F[0]) for block in self.blocks]),
            cones=tuple(Cone("psd", block.order) for block in self.blocks),
        )
        return conic.solve(program)


def _sizes(M: FloatArray, degree: int) -> FloatArray:
    """Root mean squares of Λ: positive where an estimate is not, so that M can be scaled.

    Raises DataError if the estimated mean square of y is not positive.
    """
    squares = np.diag(M).copy()
    if not squares[0] > 0:
        raise DataError(
            f"the responses have nothing in common: their estimated mean square is {squares[0]:g}; "
            "are they repeats, and is the noise smaller than the response?"
        )
    floors = np.zeros_like(squares)
    floors[:degree] = POWER_FLOOR * squares[0] ** np.arange(1, degree + 1)
    sizes = np.sqrt(np.maximum(squares, floors))
    return np.asarray(np.where(sizes > 0, sizes, 1.0))


def _add(G: FloatArray, i: int, j: int, column: int | None, value: float) -> None:
    """G[i, j] += value · x[column] (None: a constant), symmetric."""
    place = 0 if column is None else 1 + column
    G[place, i, j] += value
    if i != j:
        G[place, j, i] += value


def _scaled(G: MatrixInequality, rows: FloatArray, columns: FloatArray) -> MatrixInequality:
    """diag(rows) G(columns·x) diag(rows)."""
    unknowns = np.concatenate([[1.0], columns])
    return MatrixInequality(G.F * np.outer(rows, rows) * unknowns[:, None, None])


def _symmetric(start: int, size: int) -> IntArray:
    """(size, size) column numbers of a symmetric matrix of unknowns."""
    table = np.zeros((size, size), dtype=np.int64)
    upper = np.triu_indices(size)
    table[upper] = start + np.arange(len(upper[0]))
    return np.maximum(table, table.T)
