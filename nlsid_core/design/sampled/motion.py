"""A motion to track and what follows it: direct transcription, time-varying LQR, observer."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic, files
from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.design.riccati import Feedback, discrete_tvlqr, solve_riccati
from nlsid_core.errors import DataError, Infeasible, ShapeError, SolverError
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy

__all__ = ["Feedback", "observer_gain", "plan_motion", "track", "tvlqr"]

ITERATIONS = 30  # of linearising the model around the last motion
SETTLED = 1e-6  # largest defect of a motion, in half-widths of the data box, when it is done
RESERVE = 0.1  # of the box's half-width, kept free for feedback and funnel
SMOOTHNESS = 10.0  # weight of changes of the input against the input itself
NEARNESS = 1e-3  # weight of the state against the input


def plan_motion(
    model: StateModel,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    steps: int,
) -> tuple[FloatArray, FloatArray]:
    """States (N + 1, n) and inputs (N, p) from `start` to `goal`, smooth and within the data box.

    Direct transcription: least Σ|u|² and changes of u, in units of the box, subject to
    x_{k+1} = f(x_k, u_k), solved by sequential quadratic programs. RESERVE, relative to half the
    box, stays free. Raises Infeasible if the goal cannot be reached so, DataError if an end is
    outside the box.
    """
    n = len(model)
    ends = [np.asarray(end, dtype=np.float64) for end in (start, goal)]
    for end in ends:
        if end.shape != (n,):
            raise ShapeError(f"start and goal should have shape ({n},), one has {end.shape}")
        outside = (end < model.x_range[:, 0]) | (end > model.x_range[:, 1])
        if outside.any():
            i = int(np.argmax(outside))
            raise DataError(
                f"{model.x[i].name} {end[i]:g} is outside {model.x_range[i].tolist()}, where the "
                "model has data"
            )
    half = np.diff(model.x_range, axis=1)[:, 0] / 2
    way = np.linspace(0.0, 1.0, steps + 1)[:, None]
    x: FloatArray = ends[0] + way * (ends[1] - ends[0])
    u: FloatArray = np.tile(model.u_range.mean(axis=1), (steps, 1))
    for _ in range(ITERATIONS):
        x, u = _subproblem(model, x, u, ends)
        defect = float(np.abs((x[1:] - model(x[:-1], u)) / half).max())
        if defect < SETTLED:
            return _rolled_out(model, x, u), u
    raise Infeasible(f"no motion found after {ITERATIONS} linearisations (defect {defect:.2g})")


def tvlqr(
    model: StateModel,
    x: FloatArray,
    u: FloatArray,
    *,
    state_weight: float = 1.0,
    input_weight: float = 1.0,
) -> Feedback:
    """Time-varying LQR around a motion, weights relative to half the data box squared."""
    half_x, half_u = (np.diff(r, axis=1)[:, 0] / 2 for r in (model.x_range, model.u_range))
    Q, R = np.diag(state_weight / half_x**2), np.diag(input_weight / half_u**2)
    P_final = solve_riccati(*model.linearised(x[-1], u[-1]), Q, R)
    linear = [model.linearised(x_k, u_k) for x_k, u_k in zip(x[:-1], u, strict=True)]
    A, B = (np.array(part) for part in zip(*linear, strict=True))
    return discrete_tvlqr(A, B, Q=Q, R=R, P_final=(P_final + P_final.T) / 2)


def observer_gain(model: StateModel) -> FloatArray:
    """L (n, n) of x̂⁺ = f + L(y⁺ - f), Kalman's for the model's noise and disturbance.

    Linearised at the middle of the data box.
    """
    A, _ = model.linearised(model.x_range.mean(axis=1), model.u_range.mean(axis=1))
    Q, R = np.diag(model.disturbance**2), np.diag(model.noise**2)
    prior = solve_riccati(A.T, np.eye(len(model)), Q, R)
    return np.asarray(np.linalg.solve(prior + R, prior).T)


def track(model: StateModel, x: FloatArray, u: FloatArray, feedback: Feedback) -> SampledPolicy:
    """The policy that follows a motion with this feedback and the model's observer."""
    return SampledPolicy(
        x=x,
        u=u,
        K=feedback.K,
        L=observer_gain(model),
        period=model.period,
        model=files.digest(model.document()),
    )


def _rolled_out(model: StateModel, x: FloatArray, u: FloatArray) -> FloatArray:
    """The model's own motion under u, so that no defect is left but rounding."""
    states = model.simulate(x[0], u)
    return states if np.isfinite(states).all() else x


def _subproblem(
    model: StateModel,
    x: FloatArray,
    u: FloatArray,
    ends: Sequence[FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """The quadratic program linearised at (x, u), in unit variables of the box."""
    N, n, p = len(u), len(model), len(model.u)
    mid_x, mid_u = model.x_range.mean(axis=1), model.u_range.mean(axis=1)
    half_x, half_u = (np.diff(r, axis=1)[:, 0] / 2 for r in (model.x_range, model.u_range))
    rows, right = [], []
    for k in range(N):
        A, B = model.linearised(x[k], u[k])
        block = sp.lil_matrix((n, (N + 1) * n + N * p))
        block[:, k * n : (k + 1) * n] = A * half_x / half_x[:, None]
        block[:, (k + 1) * n : (k + 2) * n] = -np.eye(n)
        first = (N + 1) * n + k * p
        block[:, first : first + p] = B * half_u / half_x[:, None]
        rows.append(block.tocsr())
        affine = model(x[k], u[k]) + A @ (mid_x - x[k]) + B @ (mid_u - u[k]) - mid_x
        right.append(-affine / half_x)
    size = (N + 1) * n + N * p
    pick = sp.eye(size, format="csr")
    for end, first in zip(ends, (0, N * n), strict=True):
        rows.append(pick[first : first + n])
        right.append((end - mid_x) / half_x)
    bound = np.full(size, 1.0 - RESERVE)
    free = np.r_[0:n, N * n : (N + 1) * n]  # the ends are given, whatever is kept in reserve
    bound[free] = 2.0
    changes = sp.eye(N * p, format="csr")[p:] - sp.eye(N * p, format="csr")[:-p]
    cost = sp.eye(N * p) + SMOOTHNESS * N * (changes.T @ changes)
    P = sp.block_diag([NEARNESS * sp.eye((N + 1) * n), cost], format="csc")
    program = ConeProgram(
        P=sp.csc_matrix(P),
        q=np.concatenate([np.zeros((N + 1) * n), np.tile(mid_u / half_u, N)]),
        A=sp.vstack([*rows, pick, -pick], format="csc"),
        b=np.concatenate([*right, bound, bound]),
        cones=(Cone("zero", (N + 2) * n), Cone("nonnegative", 2 * size)),
    )
    try:
        z = conic.solve(program).x
    except SolverError as error:
        raise Infeasible(
            "the goal is out of reach within the data box in this time; allow more steps, a "
            f"nearer goal, or record with larger inputs ({error})"
        ) from error
    states = z[: (N + 1) * n].reshape(N + 1, n) * half_x + mid_x
    return states, z[(N + 1) * n :].reshape(N, p) * half_u + mid_u
