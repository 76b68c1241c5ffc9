"""How monotone equations are identified from repeats, and what that is compared with.

Least squares and direct minimisation of the simulation error are the comparators.
Source: thesis Chapter 3, Section 3.6.3.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, solve_banded
from scipy.optimize import least_squares

from nlsid_core import conic
from nlsid_core.arrays import FloatArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.polynomial.moment_rie import MomentFit, equation, minimise_moment_rie
from nlsid_core.identification.polynomial.moments import (
    Moments,
    Offsets,
    offsets_of,
    repeated_moments,
)
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.repeats import refuse_false_repeats
from nlsid_core.models import MonotoneEquation
from nlsid_core.models.monotone_equation import is_increasing

SLOPE = 0.5  # e' ≥ SLOPE fixes the scale of the equation, which means nothing
NEWTON_STEPS = 50
NEWTON_TOLERANCE = 1e-12
LM_TOLERANCE = 1e-10
LM_EVALUATIONS = 100
DIVERGED = 1e6  # residual of a simulation that is not finite


def identify_from_repeats(
    data: Dataset,
    model_class: Polynomial,
    *,
    transient: int = 0,
    accept_untested_repeats: bool = False,
    slowest: float = 1.0,
    executor: Executor | None = None,
) -> MomentFit:
    """Identify a `MonotoneEquation` from the dataset's groups of repeats, proved stable.

    Trajectories without a repeat are not used. transient: samples at the start of each that the
    test of the repeats leaves out. accept_untested_repeats: skip that test; the bias of noise is
    then removed only if the trials repeat one excitation all the same. slowest: as of
    `minimise_moment_rie`. executor: for the moments.
    Raises DataError if there are no repeats or they are not repeats, ShapeError for several
    outputs, Infeasible or SolverError as `minimise_moment_rie`.
    """
    groups = tuple(data.repeats().values())
    if not groups:
        raise DataError(
            "no two trajectories share a `group`: bias removal needs repeated experiments; without "
            "them use plain_moments, or another method"
        )
    if not accept_untested_repeats:
        refuse_false_repeats(data, transient=transient)
    offsets = offsets_of([trial for group in groups for trial in group])
    moments = repeated_moments(groups, model_class, offsets, executor=executor)
    return minimise_moment_rie(moments, model_class, groups[0][0], offsets, slowest=slowest)


def least_squares_equation(
    moments: Moments, model_class: Polynomial, template: Trajectory, offsets: Offsets
) -> MonotoneEquation:
    """Minimise the mean squared equation error over increasing e; nothing makes the result stable.

    e' ≥ ½ is [[c₁ - ½, c₂], [c₂, 3c₃]] ⪰ 0. Raises SolverError if the solver gives up.
    """
    M = moments.matrix()
    size = len(M)
    D = np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))
    if moments.degree == 1:
        rows = sp.csc_matrix(([-1.0 / D[0]], ([0], [0])), (1, size))
        b, cone = np.array([-SLOPE]), Cone("nonnegative", 1)
    else:
        values = -np.array([1.0, conic.SQRT2, 3.0]) / D[:3]
        rows = sp.csc_matrix((values, ([0, 1, 2], [0, 1, 2])), (3, size))
        b, cone = np.array([-SLOPE, 0.0, 0.0]), Cone("psd", 2)
    values, vectors = np.linalg.eigh(M / np.outer(D, D))
    quadratic = (vectors * np.maximum(values, 0.0)) @ vectors.T
    program = ConeProgram(sp.csc_matrix(2.0 * quadratic), np.zeros(size), rows, b, (cone,))
    return equation(conic.solve(program).x / D, model_class, template, offsets)


def minimise_monotone_simulation_error(
    start: MonotoneEquation, trials: Sequence[Trajectory]
) -> MonotoneEquation:
    """Levenberg-Marquardt on Σ (y - ŷ)² with exact sensitivities, e'(0) = 1, from `start`.

    ŷ starts from the first measured outputs. Finds a local minimum; nothing makes it stable.
    Raises DataError if `start` cannot be simulated or the minimum is not increasing.
    """
    h, cubic = start.history, bool(start.e[1:].any())
    free = slice(0, None) if cubic else slice(2, None)
    first = start.e[0]
    theta = np.concatenate([start.e[1:], [start.c], start.a, start.b]) / first

    def model(values: FloatArray) -> MonotoneEquation | None:
        full = theta.copy()
        full[free] = values
        e = np.concatenate([[1.0], full[:2]])
        n = len(start)
        if not is_increasing(e):
            return None
        return replace(start, e=e, c=float(full[2]), a=full[3 : 3 + n], b=full[3 + n :])

    def residual(values: FloatArray) -> FloatArray:
        candidate = model(values)
        parts = []
        for trial in trials:
            simulated = None if candidate is None else simulate_banded(candidate, trial)
            if simulated is None:
                parts.append(np.full(len(trial) - h, DIVERGED))
            else:
                parts.append((simulated - trial.y[:, 0])[h:])
        return np.concatenate(parts)

    def jacobian(values: FloatArray) -> FloatArray:
        candidate = model(values)
        assert candidate is not None, "the minimiser accepts finite costs only"
        return np.concatenate([sensitivities(candidate, trial)[:, free] for trial in trials])

    if float(np.max(residual(theta[free]))) == DIVERGED:
        raise DataError("the simulation of the first model diverges; start from a stable one")
    found = least_squares(
        residual,
        theta[free],
        jac=jacobian,
        method="lm",
        x_scale="jac",
        ftol=LM_TOLERANCE,
        xtol=LM_TOLERANCE,
        max_nfev=LM_EVALUATIONS,
    )
    best = model(found.x)
    if best is None:
        raise DataError("the minimiser left the increasing e")
    return best


def simulate_banded(model: MonotoneEquation, trial: Trajectory) -> FloatArray | None:
    """`model.simulate` from the measured start, all samples at once: Newton's method with banded
    triangular solves; None if it does not settle.
    """
    h, n = model.history, len(model)
    start = trial.y[:h, 0] - model.y_offset
    forcing = model.forcing(trial.u)
    y = np.concatenate([start, trial.y[h:, 0] - model.y_offset])
    e1, e2, e3 = model.e
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            now = y[h:]
            past = sum(model.a[k - 1] * y[h - k : len(y) - k] for k in range(1, n + 1))
            error = ((e3 * now + e2) * now + e1) * now - past - forcing
            try:
                step = solve_banded((n, 0), _band(model, now), error)
            except (LinAlgError, ValueError):
                return None
            y[h:] = now - step
            size = float(np.abs(step).max(initial=0.0))
            if not np.isfinite(size):
                return None
            if size <= NEWTON_TOLERANCE * (1.0 + float(np.abs(now).max(initial=0.0))):
                return y + model.y_offset
    return None


def sensitivities(model: MonotoneEquation, trial: Trajectory) -> FloatArray:
    """(N - history, 2 + 1 + n + n_w): ∂ŷ/∂[e₂, e₃, c, a, b]."""
    h, n = model.history, len(model)
    simulated = simulate_banded(model, trial)
    assert simulated is not None, "called where the residual was finite"
    y, u = simulated - model.y_offset, trial.u - model.u_offset
    now, N = y[h:], len(y)
    columns = [-(now**2), -(now**3), np.ones_like(now)]
    columns += [y[h - k : N - k] for k in range(1, n + 1)]
    columns += [u[h - d : N - d, i] for i, d in model.window]
    return np.asarray(solve_banded((n, 0), _band(model, now), np.stack(columns, axis=1)))


def _band(model: MonotoneEquation, now: FloatArray) -> FloatArray:
    """(n + 1, T): e'(y(t)) on the diagonal, -a_k on the k-th below."""
    e1, e2, e3 = model.e
    band = np.empty((len(model) + 1, len(now)))
    band[0] = (3.0 * e3 * now + 2.0 * e2) * now + e1
    band[1:] = -model.a[:, None]
    return band
