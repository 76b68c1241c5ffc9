"""Robust identification error through moments: one program, however long the data.

Minimise tr(R M) over the model, V = |x₁ - x₂|²_P and R, such that the model is stable and |Λ|²_R
dominates the robust identification error; then tr(R M) ≥ the mean squared simulation error. With
moments from repeated experiments the bias of measurement noise is gone.
Source: thesis (3.6)-(3.9), Claim 3.6, Section 3.5.2.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core._types import FloatArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.errors import DataError, Infeasible, ShapeError
from nlsid_core.identification.moment_inequalities import SPLITS, AffineMatrix, Layout
from nlsid_core.identification.moments import Moments, MonotoneClass, Offsets
from nlsid_core.identification.monotone_proof import MonotoneProof, prove_monotone_equation
from nlsid_core.models import MonotoneEquation, Signal
from nlsid_core.trajectory import Trajectory

DELTA = 1e-3  # δ of (3.8), V ≥ δ|Δ|² more than needed: what leaves the exact proof room
POWER_FLOOR = 1e-3  # an estimated mean square of yᵏ below this part of (mean square of y)ᵏ is noise


@dataclass(frozen=True, eq=False)
class MomentFit:
    """model; proof; bound: tr(R M), an upper bound of the mean squared simulation error (squared
    unit of y) as far as the moments are right; R of the solution; P in the scale of
    the model;
    negative: the most negative eigenvalue of the scaled moments before projection.
    """

    model: MonotoneEquation
    proof: MonotoneProof
    bound: float
    R: FloatArray
    P: FloatArray
    negative: float
    solution: conic.ConeSolution

    def __str__(self) -> str:
        unit = self.model.y.unit
        return (
            f"monotone equation of {len(self.model)} lags, proved stable at rate "
            f"{self.proof.rate:.4f}; rms simulation error at most {self.bound**0.5:.4g} {unit} on "
            f"its moments; {self.solution}"
        )


def minimise_moment_rie(
    moments: Moments,
    model_class: MonotoneClass,
    template: Trajectory,
    offsets: Offsets,
    *,
    kappa: float | None = None,
) -> MomentFit:
    """The stable model with the least bound on these moments, and its exact proof.

    template: names, units and sample time. kappa: bound on |R|_F in the model's units (None: none).
    Raises DataError if the moments are not those of a signal, Infeasible if the minimiser has no
    exact proof, SolverError if the solver gives up.
    """
    problem = _Problem.of(moments, model_class.lags)
    solution = problem.solve(kappa=kappa)
    x = problem.columns * solution.x
    layout = problem.layout
    scale = float(x[layout.c[0]])  # e'(0): the scale of e and f together means nothing
    model = equation(x[layout.c] / scale, model_class, template, offsets)
    P = x[layout.P] / scale
    proof = prove_monotone_equation(model, P)
    if proof is None:
        raise Infeasible(
            f"no exact proof for the minimiser ({solution}); try fewer lags, or give more data"
        )
    return MomentFit(
        model=model,
        proof=proof,
        bound=float(solution.objective * problem.unit**2),
        R=x[layout.R],
        P=P,
        negative=problem.negative,
        solution=solution,
    )


def moment_bound(model: MonotoneEquation, moments: Moments, *, kappa: float | None = None) -> float:
    """J(a, M): the least tr(R M) with this model, e and f scaled by a common factor; ≥ 0.

    The moments have to be about the model's offsets. Source: thesis (3.6), J_κ.
    Raises ShapeError or DataError on moments of another class, Infeasible if no V, R of this class
    prove the model stable.
    """
    if len(model) + len(model.window) != moments.mixed.shape[1]:
        raise ShapeError(
            f"moments of {moments.mixed.shape[1]} lags and window entries do not fit a model of "
            f"{len(model)} and {len(model.window)}"
        )
    if model.e[moments.degree :].any():
        raise DataError("moments for a linear e do not judge a model whose e is cubic")
    problem = _Problem.of(moments, len(model))
    coefficients = np.concatenate([model.e[: moments.degree], [-model.c], -model.a, -model.b])
    return float(problem.solve(fixed=coefficients, kappa=kappa).objective * problem.unit**2)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Scaled data: unknowns x = columns·x̄, moments of unit diagonal, errors in units of `unit`."""

    layout: Layout
    M: FloatArray
    unit: float
    columns: FloatArray
    stability: AffineMatrix
    error_bound: AffineMatrix
    negative: float

    @classmethod
    def of(cls, moments: Moments, n: int) -> "_Problem":
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
            stability=layout.stability(DELTA).scaled(rows8, columns),
            error_bound=layout.error_bound().scaled(rows9, columns),
            negative=float(min(values[0], 0.0)),
        )

    def solve(
        self, *, fixed: FloatArray | None = None, kappa: float | None = None
    ) -> conic.ConeSolution:
        """Minimise tr(R M); `fixed` gives c up to a nonnegative factor, in physical units."""
        layout = self.layout
        q = np.zeros(layout.unknowns)
        np.add.at(q, layout.R.ravel(), self.M.ravel())
        blocks = [self.stability, self.error_bound]
        A = [-block.slope for block in blocks]
        b = [block.constant for block in blocks]
        cones = [Cone("psd", block.order) for block in blocks]
        if kappa is not None:
            upper = layout.R[np.triu_indices(layout.monomials)]
            double = np.where(np.eye(layout.monomials)[np.triu_indices(layout.monomials)], 1, 2)
            weights = np.sqrt(double) * self.columns[upper]
            rows = np.arange(1, len(upper) + 1)
            shape = (len(upper) + 1, layout.unknowns)
            A.append(sp.csr_matrix((-weights, (rows, upper)), shape))
            b.append(np.concatenate([[kappa], np.zeros(len(upper))]))
            cones.append(Cone("second_order", len(upper) + 1))
        stacked = sp.vstack(A, format="csc")
        lift = sp.identity(layout.unknowns, format="csc")
        if fixed is not None:
            others = np.setdiff1d(np.arange(layout.unknowns), layout.c)
            direction = sp.csc_matrix(
                (fixed / self.columns[layout.c], (layout.c, np.zeros(len(fixed), dtype=int))),
                (layout.unknowns, 1),
            )
            lift = sp.hstack([lift[:, others], direction], format="csc")
        free = lift.shape[1]
        program = ConeProgram(
            P=sp.csc_matrix((free, free)),
            q=lift.T @ q,
            A=sp.csc_matrix(stacked @ lift),
            b=np.concatenate(b),
            cones=tuple(cones),
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


def equation(
    c: FloatArray, model_class: MonotoneClass, template: Trajectory, offsets: Offsets
) -> MonotoneEquation:
    """The model ε = c'Λ = 0."""
    D, n = model_class.degree, model_class.lags
    return MonotoneEquation(
        e=np.concatenate([c[:D], np.zeros(3 - D)]),
        a=-c[D + 1 : D + 1 + n],
        b=-c[D + 1 + n :],
        c=-float(c[D]),
        window=model_class.window(template.u.shape[1]),
        y_offset=offsets.y,
        u_offset=offsets.u,
        period=template.period,
        y=Signal(template.y_names[0], template.y_units[0], template.y_paths[0]),
        u=tuple(
            Signal(*labels)
            for labels in zip(template.u_names, template.u_units, template.u_paths, strict=True)
        ),
    )
