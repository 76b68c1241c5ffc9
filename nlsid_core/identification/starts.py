"""Where the searches for linear difference equations start: stable models that are found directly.

A search that goes downhill ends at the minimum of the valley it begins in, so it begins in several.
A model of more lags, fitted by least squares, has an impulse response h; with the Hankel matrix
H_ij = h_{i+j+1} ≈ U S V' of the n largest singular values, S^(-1/2) U' H↑ V S^(-1/2) has the poles
of n lags that explain it best, H↑ being H one sample later (Kung 1978); with several outputs h and
H have blocks, and the first block row of U S^(1/2) is the output matrix. Poles outside the circle
are reflected into it, by their eigenvectors. Nonlinear classes begin at a linear model of the same
signals, too.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import LinAlgError, eig, svd

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, SolverError
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.polynomial.implicit_rows import ImplicitRows
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.regressors import lagged, signal_scale
from nlsid_core.models import StateAffineModel

SLOWEST_POLE = 1.0 - 1e-7  # slower, and rounding may take the proof away
LINEAR_ITERATES = 10  # of the robust simulation error, for the linear model of other classes
LONGER = 4  # times the lags, of the model that is reduced
WELL_CONDITIONED = 1e8  # G_0 of a model that determines its outputs
LONGEST_RESPONSE = 400  # samples of its impulse response
SHOWN = 1e-8  # relative singular value of a state that the impulse response shows


def stable_starts(
    train: Dataset, lags: int, radius: float = SLOWEST_POLE
) -> Iterator[tuple[str, FloatArray]]:
    """Left parameters ((n+1) n_y²,) of linear models whose poles are within the radius, named."""
    y = signal_scale(train, "y")
    u = signal_scale(train, "u")
    scaled = [((trial.y - y[0]) / y[1], (trial.u - u[0]) / u[1]) for trial in train]
    n_y = len(y[0])
    for name, size in (("from least squares", lags), ("from a longer model", LONGER * lags)):
        found = autoregression(scaled, size)
        if found is None:  # too few rows
            return
        a, b = found
        try:
            start = a if size == lags else reduced(a, b, lags)
            theta = reflected(np.concatenate([np.eye(n_y)[None], -start]).ravel(), radius, n_y)
        except LinAlgError:
            continue
        yield name, theta


def autoregression(
    trials: Sequence[tuple[FloatArray, FloatArray]], lags: int
) -> tuple[FloatArray, FloatArray] | None:
    """(a (n, n_y, n_y), b (n+1, n_y, n_u)) of y = Σ aₖ y(t-k) + Σ bₖ u(t-k) + c by least squares.

    Of all that fit equally well the smallest; None if there are fewer equations than unknowns.
    """
    long = [(lagged(y, lags), lagged(u, lags)) for y, u in trials if len(y) > lags]
    if not long:
        return None
    Y, U = (np.concatenate(part) for part in zip(*long, strict=True))
    columns = np.column_stack(
        [Y[:, 1:].reshape(len(Y), -1), U.reshape(len(U), -1), np.ones(len(U))]
    )
    if columns.shape[0] < columns.shape[1]:
        return None
    n_y, n_u = Y.shape[2], U.shape[2]
    found = np.linalg.lstsq(columns, Y[:, 0], rcond=None)[0]
    a, b = found[: lags * n_y].reshape(lags, n_y, n_y), found[lags * n_y : -1].reshape(-1, n_u, n_y)
    return a.transpose(0, 2, 1), b.transpose(0, 2, 1)


def reflected(theta: FloatArray, radius: float = SLOWEST_POLE, outputs: int = 1) -> FloatArray:
    """θ ((n+1) n_y²,) with every pole outside the circle at the place that is as far inside, 1/z̄,
    and what is slower than the radius on it; θ itself if every pole is within the radius.
    """
    G = theta.reshape(-1, outputs, outputs)
    A = companion(-np.linalg.solve(G[0], G[1:]))
    poles, left, right = eig(A, left=True, right=True)
    moved, radius = poles.copy(), min(radius, SLOWEST_POLE)
    outside = np.abs(poles) > 1.0
    moved[outside] = 1.0 / poles[outside].conj()
    slow = np.abs(moved) > radius
    moved[slow] *= radius / np.abs(moved[slow])
    changed = np.flatnonzero(outside | slow)
    if not len(changed):
        return theta
    if outputs == 1:
        return np.poly(moved).real
    for i in changed:  # only these: others, as poles at 0, may have too few eigenvectors
        weight = (moved[i] - poles[i]) / np.vdot(left[:, i], right[:, i])
        A = A + (weight * np.outer(right[:, i], left[:, i].conj()))
    a = lags_of(A.real, np.eye(outputs, len(A)), len(G) - 1)
    return np.concatenate([np.eye(outputs)[None], -a]).ravel()


def poles_of(theta: FloatArray, outputs: int) -> FloatArray:
    """Poles of the linear model with left parameters θ ((n+1) n_y²,)."""
    G = theta.reshape(-1, outputs, outputs)
    return np.asarray(np.linalg.eigvals(companion(-np.linalg.solve(G[0], G[1:]))))


def companion(a: FloatArray) -> FloatArray:
    """A of x⁺ = A x, y the first n_y states, for a (n, n_y, n_y): outputs always tell x."""
    n, n_y, _ = a.shape
    return np.hstack([np.vstack(list(a)), np.eye(n * n_y, (n - 1) * n_y)])


def lags_of(A: FloatArray, C: FloatArray, lags: int) -> FloatArray:
    """a (n, n_y, n_y) of the outputs y = C x, x⁺ = A x with n·n_y states.

    LinAlgError if n outputs do not tell the state.
    """
    if len(C) == 1:
        return -np.poly(np.linalg.eigvals(A)).real[1:, None, None]
    powers = [C]
    for _ in range(lags):
        powers.append(powers[-1] @ A)
    newest_first = np.vstack(powers[-2::-1])
    wide = np.linalg.solve(newest_first.T, powers[-1].T).T
    if not np.isfinite(wide).all():
        raise LinAlgError("the outputs do not tell the state")
    return wide.reshape(len(C), lags, len(C)).transpose(1, 0, 2)


def reduced(a: FloatArray, b: FloatArray, lags: int) -> FloatArray:
    """a (n, n_y, n_y) of fewer lags by the Hankel matrix of the impulse response.

    LinAlgError if the response diverges, or shows fewer states than that.
    """
    (n_y, n_u), states = b.shape[1:], lags * b.shape[1]
    half = LONGEST_RESPONSE // 2 // max(1, max(n_y, n_u) // 2)
    h = np.zeros((2 * half + 1, n_y, n_u))
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(len(h)):
            h[t] = b[t] if t < len(b) else 0.0
            for k in range(min(t, len(a))):
                h[t] += a[k] @ h[t - 1 - k]
        if not np.isfinite(np.square(h)).all():
            raise LinAlgError("the impulse response diverges")
    index = np.arange(half)[:, None] + np.arange(half) + 1
    now, later = (
        h[index + d].transpose(0, 2, 1, 3).reshape(half * n_y, half * n_u) for d in (0, 1)
    )
    U, s, Vt = svd(now, full_matrices=False)
    if len(s) < states or s[states - 1] <= SHOWN * s[0]:
        raise LinAlgError("the impulse response shows fewer states")
    root = np.sqrt(s[:states])
    A = (U[:, :states].T @ later @ Vt[:states].T) / np.outer(root, root)
    return lags_of(A, U[:n_y, :states] * root, lags)


def linear_start(
    train: Dataset, lags: int, delays: tuple[int, ...] | None
) -> StateAffineModel | None:
    """A linear model of the same lags and delays by the robust simulation error; None if none.

    Of the iterates from the identity and from the stable starts those that simulate best.
    """
    try:
        problem = build_state_affine_rows(train, Polynomial(lags, delays or tuple(range(lags + 1))))
    except DataError:  # delays or excitation that linear models have not
        return None
    error, found = SimulationError(problem.rows), []
    for theta in (None, *(theta for _, theta in stable_starts(train, lags))):
        try:
            *_, last = robust_simulation_error(
                problem.rows, start=theta, iterations=LINEAR_ITERATES
            )
            found.append((error.at(last.theta).J, last))
        except (SolverError, LinAlgError):
            continue
    if not found:
        return None
    _, last = min(found, key=lambda one: one[0])
    model = problem.model(last.theta, last.p)
    assert isinstance(model, StateAffineModel), "delays are given"
    return model if np.linalg.cond(model.G[0].coefficients[0]) < WELL_CONDITIONED else None


def as_implicit(model: StateAffineModel, rows: ImplicitRows) -> tuple[FloatArray, FloatArray]:
    """The linear model as scaled coefficients e (m_e, n_v) and f (m_f, n_v) of the rows' class."""
    n_v, states = len(model.y), rows.states
    inverse = np.linalg.inv(model.G[0].coefficients[0])
    e, f = np.zeros((len(rows.left), n_v)), np.zeros((len(rows.right), n_v))
    for row, target in zip(rows.left.tolist(), e, strict=True):
        if sum(row) == 1:
            target[row.index(1)] = 1.0
    monomials = zip(map(tuple, model.p.exponents.tolist()), model.p.coefficients, strict=True)
    p = {monomial: -inverse @ value for monomial, value in monomials}
    lagged = np.hstack([-inverse @ g.coefficients[0] for g in model.G[1:]])  # (n_v, states)
    for row, target in zip(rows.right.tolist(), f, strict=True):
        if sum(row) == 1 and any(row[:states]):
            target[:] = lagged[:, row.index(1)]
        elif not any(row[:states]) and tuple(row[states:]) in p:
            target[:] = p[tuple(row[states:])]
    return e, f
