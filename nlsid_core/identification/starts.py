"""Where the searches for linear difference equations start: stable models that are found directly.

A search that goes downhill ends at the minimum of the valley it begins in, so it begins in several.
A model of more lags, fitted by least squares, has an impulse response h; with the Hankel matrix
H_ij = h_{i+j+1} ≈ U S V' of the n largest singular values, S^(-1/2) U' H↑ V S^(-1/2) has the poles
of n lags that explain it best, H↑ being H one sample later (Kung 1978). Poles outside the circle
are reflected into it. Nonlinear classes begin at a linear model of the same signals, too.
"""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import hankel, svd
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, SolverError
from nlsid_core.identification.implicit_class import ImplicitRows
from nlsid_core.identification.linear import (
    SLOWEST_POLE,
    Regression,
    build_regression,
    least_squares,
)
from nlsid_core.identification.moments import MonotoneClass
from nlsid_core.identification.rse import robust_simulation_error
from nlsid_core.identification.state_affine import StateAffineClass, build_state_affine_rows
from nlsid_core.models import DifferenceEquation, MonotoneEquation, StateAffineModel

LINEAR_ITERATES = 10  # of the robust simulation error, for the linear model of other classes
LONGER = 4  # times the lags, of the model that is reduced
BEND = 1e-3  # the cubic part, at one spread, of the equation that a linear model begins as
WELL_CONDITIONED = 1e8  # G_0 of a model that determines its outputs
LONGEST_RESPONSE = 400  # samples of its impulse response


def stable_starts(
    regression: Regression, radius: float = SLOWEST_POLE
) -> Iterator[tuple[str, FloatArray]]:
    """Left parameters (n+1,) of models whose poles are within the radius, with their names."""
    direct = np.concatenate([[1.0], -least_squares(regression).a])
    yield "from least squares", reflected(direct, radius)
    try:
        longer = build_regression(regression.dataset, LONGER * regression.lags)
    except DataError:  # too few rows, or too little excitation for as many lags
        return
    poles = reduced_poles(least_squares(longer), regression.lags)
    if np.isfinite(poles).all():
        yield "from a longer model", reflected(np.poly(poles).real, radius)


def reflected(theta: FloatArray, radius: float = SLOWEST_POLE) -> FloatArray:
    """θ (n+1,) with every pole outside the circle at the place that is as far inside, 1/z̄, and
    what is slower than the radius on it; θ itself if every pole is within the radius.
    """
    poles, radius = np.roots(theta), min(radius, SLOWEST_POLE)
    outside = np.abs(poles) > 1.0
    slow = np.abs(poles) > radius
    if not slow.any():
        return theta
    poles[outside] = 1.0 / poles[outside].conj()
    slow = np.abs(poles) > radius
    poles[slow] *= radius / np.abs(poles[slow])
    lags = len(theta) - 1  # np.roots leaves out poles at 0
    return np.concatenate([np.poly(poles).real, np.zeros(lags - len(poles))])


def reduced_poles(model: DifferenceEquation, lags: int) -> FloatArray:
    """Poles (lags,) by the Hankel matrix of the model's impulse response; NaN if it diverges."""
    half = LONGEST_RESPONSE // 2
    impulse = np.eye(1, 2 * half + 1)[0]
    with np.errstate(over="ignore", invalid="ignore"):
        h = lfilter(model.b, np.concatenate([[1.0], -model.a]), impulse)[1:]
        if not np.isfinite(np.square(h)).all():
            return np.full(lags, np.nan)
    U, s, Vt = svd(hankel(h[:half], h[half - 1 : 2 * half - 1]))
    root = np.sqrt(s[:lags])
    if root[-1] <= 1e-8 * root[0]:
        return np.full(lags, np.nan)
    later = hankel(h[1 : half + 1], h[half : 2 * half])
    A = (U[:, :lags].T @ later @ Vt[:lags].T) / np.outer(root, root)
    return np.asarray(np.linalg.eigvals(A))


def linear_start(
    train: Dataset, lags: int, delays: tuple[int, ...] | None
) -> StateAffineModel | None:
    """A linear model of the same lags and delays by the robust simulation error; None if none."""
    try:
        problem = build_state_affine_rows(train, StateAffineClass(lags, delays))
        *_, last = robust_simulation_error(problem.rows, iterations=LINEAR_ITERATES)
    except (DataError, SolverError):  # delays, excitation or a search that linear models have not
        return None
    model = problem.model(last.theta, last.p)
    return model if np.linalg.cond(model.G[0].coefficients[0]) < WELL_CONDITIONED else None


def as_monotone(model: StateAffineModel, model_class: MonotoneClass) -> MonotoneEquation:
    """The linear model of one output as an equation of the class."""
    first = float(model.G[0].coefficients.ravel()[0])
    p = _by_monomial(model)
    degree, scale = len(model.window), float(model.y_scale[0])
    units = np.eye(degree, dtype=np.int64)
    b = [-p.get(tuple(unit), np.zeros(1))[0] / first * scale for unit in units.tolist()]
    return MonotoneEquation(
        e=np.array([1.0, 0.0, BEND / scale**2 if model_class.degree == 3 else 0.0]),
        a=np.array([-float(g.coefficients.ravel()[0]) / first for g in model.G[1:]]),
        b=np.array(b) / model.u_scale[[i for i, _ in model.window]],
        c=float(-p.get((0,) * degree, np.zeros(1))[0] / first * scale),
        window=model_class.window(len(model.u)),
        y_offset=float(model.y_offset[0]),
        u_offset=model.u_offset,
        period=model.period,
        y=model.y[0],
        u=model.u,
    )


def as_implicit(model: StateAffineModel, rows: ImplicitRows) -> tuple[FloatArray, FloatArray]:
    """The linear model as scaled coefficients e (m_e, n_v) and f (m_f, n_v) of the rows' class."""
    n_v, states = len(model.y), rows.states
    inverse = np.linalg.inv(model.G[0].coefficients[0])
    e, f = np.zeros((len(rows.left), n_v)), np.zeros((len(rows.right), n_v))
    for row, target in zip(rows.left.tolist(), e, strict=True):
        if sum(row) == 1:
            target[row.index(1)] = 1.0
    p = {key: -inverse @ value for key, value in _by_monomial(model).items()}
    lagged = np.hstack([-inverse @ g.coefficients[0] for g in model.G[1:]])  # (n_v, states)
    for row, target in zip(rows.right.tolist(), f, strict=True):
        if sum(row) == 1 and any(row[:states]):
            target[:] = lagged[:, row.index(1)]
        elif not any(row[:states]) and tuple(row[states:]) in p:
            target[:] = p[tuple(row[states:])]
    return e, f


def _by_monomial(model: StateAffineModel) -> dict[tuple[int, ...], FloatArray]:
    return dict(zip(map(tuple, model.p.exponents.tolist()), model.p.coefficients, strict=True))
