"""`design_tube`: a proved tube around the trajectories of an identified difference equation.

The observer's state obeys x̂⁺ = A x̂ + B u + f + L e by definition of the innovation e, so a bound
on Σ e² is all the tube rests on. The ellipsoid is the smallest (in the output) that satisfies
V(x̄⁺) ≤ V(x̄) + e² both with the nominal inputs played and with the policy engaged; the observer
gain is the one whose tube is narrowest on the trials of the design, and the bound on Σ e² the
largest that the other trials, those of the calibration, reach over their whole length.
"""

import warnings
from collections.abc import Sequence
from fractions import Fraction
from typing import TypeAlias

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import lsq_linear

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.calibration import calibration_trials
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design.riccati import solve_riccati
from nlsid_core.designs import Design
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.factor import refuse_unmonitorable
from nlsid_core.funnels.linear import EnergyAssumption, LinearFunnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.policies.linear import LinearPolicy

NOISE_RATIOS = np.logspace(-6, 3, 37)  # input noise over measurement noise: from trusting the model
# alone to trusting the measurement alone
DECREASE_ROOM = 1e-5  # relative room left in V's inequality, far above rounding, 1e-5 of the tube
REGULARISATION = 1e-7  # of the largest variance, so that P = W⁻¹ is well conditioned
LEVEL_ROOM = 1e-9  # relative room for the rounding of the stored nominal
TAU_ROOM = 1e-6  # relative room left in the bound on the output
SMOOTHING = 0.1  # weight of a change of input between samples against an output error


TubeDesign: TypeAlias = Design[DifferenceEquation, LinearPolicy, LinearFunnel, None]


def design_tube(
    model: DifferenceEquation,
    train: Dataset,
    *,
    profile: Sequence[tuple[float, float]],
    horizon: float,
    safety_factor: float = 1.5,
    inlet: float = 0.0,
    lqr_weights: tuple[float, float] | None = (1.0, 1.0),
    calibration: Dataset | None = None,
) -> TubeDesign:
    """The policy, observer and tube that `LinearTube` describes; its options are these.

    Raises DataError on options that make no sense, Infeasible if no ellipsoid exists.
    """
    samples = round(horizon / model.period)
    trials = calibration_trials(train, calibration, least=samples + len(model))
    longest = max(len(trial) for trial in trials.calibration) - len(model)
    if not 0 < samples <= longest:
        raise DataError(
            f"horizon {horizon} s is {samples} samples; the disturbance can be measured on the "
            f"calibration trials for 1 to {longest}"
        )
    K: FloatArray = np.zeros(len(model))
    if lqr_weights is not None:
        K = lqr_gain(model, output_weight=lqr_weights[0], input_weight=lqr_weights[1])
    gains = np.array([kalman_gain(model, ratio) for ratio in NOISE_RATIOS])
    designed = innovation_energies(model, gains, trials.design).max(axis=0)
    reaches = np.array([float(open_loop_covariance(model, L)[0, 0]) for L in gains])
    levels = safety_factor**2 * designed + inlet**2 / reaches
    L = gains[int(np.argmin(levels * (1.0 + reaches)))]
    energy = float(innovation_energies(model, L[None, :], trials.calibration).max())
    W = _smallest_ellipsoid(model, K, L)
    P = np.linalg.inv(W)
    P = (P + P.T) / 2.0
    budget = _above(safety_factor**2 * energy)
    inlet_level = inlet**2 / float(np.linalg.inv(P)[0, 0])
    x, u = track_profile(model, profile, samples)
    level = (budget + inlet_level) * (1.0 + LEVEL_ROOM)
    reach = max(float(c @ np.linalg.solve(P, c)) for c in _output_rows(model, K))
    tau = (1.0 - TAU_ROOM) / (1.0 + reach)
    policy = LinearPolicy(
        x=x, u=u, K=K, L=L, period=model.period, model=files.digest(model.document())
    )
    funnel = LinearFunnel(
        P=P,
        level=level,
        inlet=inlet_level,
        tau=np.array([tau]),
        half_widths=np.array([_rounded_up(float(np.sqrt(level / tau)))]),
        assumption=EnergyAssumption(
            budget=budget,
            samples=samples,
            measured=energy,
            safety_factor=safety_factor,
            measured_on=trials.measured_on,
            designed_on=trials.designed_on,
        ),
        model=policy.model,
        policy=files.digest(policy.document()),
    )
    refuse_unmonitorable(funnel)
    try:
        return Design.proved(
            model, policy, funnel,
            claim={"kind": "tube"}, proof={"slack": DECREASE_ROOM / 2.0}, found=None,
        )  # fmt: skip
    except CertificateRejected as refusal:
        raise Infeasible(f"no proved tube: {refusal}; try a larger input weight") from refusal


def open_loop_covariance(model: DifferenceEquation, L: FloatArray) -> FloatArray:
    """W = A W A' + L L': {x̄'W⁻¹x̄ ≤ 1} is where innovations of unit energy can take x̄."""
    W: FloatArray = solve_discrete_lyapunov(model.A, np.outer(L, L))
    return W


def _smallest_ellipsoid(model: DifferenceEquation, K: FloatArray, L: FloatArray) -> FloatArray:
    """W of least reach max c_κ W c_κ' with W ⪰ (1 + room)(A_κ W A_κ' + L L') for κ = 0 and 1.

    A_κ = A - κBK, c_κ = C - κDK.
    """
    n = len(model)
    grow = 1.0 + DECREASE_ROOM
    floor = REGULARISATION * float(np.trace(open_loop_covariance(model, L))) * np.eye(n)
    noise = grow * np.outer(L, L) + floor
    if not K.any():
        W: FloatArray = solve_discrete_lyapunov(np.sqrt(grow) * model.A, noise)
        return W
    scale = float(np.trace(open_loop_covariance(model, L)))
    variable = cp.Variable((n, n), symmetric=True)
    reach = cp.Variable()
    constraints: list[cp.Constraint] = [(variable @ c) @ c <= reach for c in _output_rows(model, K)]
    for closed in (model.A, model.A - model.B @ K[None, :]):
        decrease = variable - grow * closed @ variable @ closed.T - noise / scale
        constraints.append(decrease >> 0)
    problem = cp.Problem(cp.Minimize(reach), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of accuracy: the kernel decides what is found
        problem.solve(solver=cp.CLARABEL)
    if variable.value is None:
        raise Infeasible(
            f"no ellipsoid serves both the played inputs and the policy ({problem.status}); "
            "try a larger input weight"
        )
    return np.asarray(variable.value) * scale


def _output_rows(model: DifferenceEquation, K: FloatArray) -> list[FloatArray]:
    """c_κ of y - y_k = c_κ x̄ + e for κ = 0 and 1: with the policy engaged, ū = -Kx̄ adds -DK."""
    return [model.C[0], model.C[0] - model.D * K]


def _rounded_up(width: float) -> float:
    """The next number of three significant digits, or the float64 just below that decimal number.

    Then the decimal number is a bound, and the kernel prints it as it is.
    """
    digits = 2 - int(np.floor(np.log10(width)))
    rounded = float(np.round(np.ceil(width * 10.0**digits) / 10.0**digits, digits))
    above = Fraction(rounded) > Fraction(repr(rounded))
    return float(np.nextafter(rounded, 0.0)) if above else rounded


def _above(value: float) -> float:
    """A float64 above the real number that `value` was rounded from."""
    return float(np.nextafter(value * (1.0 + 2.0 * np.finfo(float).eps), np.inf))


def kalman_gain(model: DifferenceEquation, noise_ratio: float) -> FloatArray:
    """L (n,) of x̂⁺ = A x̂ + B u + f + L (y - ŷ), by the Riccati equation.

    noise_ratio: variance of a disturbance of the input over the variance of the measurement.
    """
    A, B, C = model.A, model.B, model.C
    S = solve_riccati(A.T, C.T, noise_ratio * B @ B.T, np.eye(1))
    gain: FloatArray = (A @ S @ C.T)[:, 0] / (1.0 + (C @ S @ C.T)[0, 0])
    return gain


def innovations(model: DifferenceEquation, gains: FloatArray, trial: Trajectory) -> FloatArray:
    """Innovations e(t) = y(t) - ŷ(t), t = n …, of the observers with gains (m, n): (N - n, m).

    The first n samples give the state; from then on the observer runs on the recorded signals.
    """
    n, y, u = len(model), trial.y[:, 0], trial.u[:, 0]
    x = np.tile(model.state_after(y[:n], u[:n]), (len(gains), 1))
    e = np.empty((len(trial) - n, len(gains)))
    for t in range(n, len(trial)):
        e[t - n] = y[t] - (x[:, 0] + model.D * u[t] + model.c)
        x = x @ model.A.T + model.B[:, 0] * u[t] + model.offset + gains * e[t - n][:, None]
    return e


def innovation_energies(
    model: DifferenceEquation, gains: FloatArray, dataset: Dataset
) -> FloatArray:
    """Σ_t e(t)² of every trial for every gain: (trials, m), in the output's unit squared."""
    return np.array([(innovations(model, gains, trial) ** 2).sum(axis=0) for trial in dataset])


def lqr_gain(model: DifferenceEquation, *, output_weight: float, input_weight: float) -> FloatArray:
    """K (n,) minimising Σ output_weight·(C x̄)² + input_weight·ū², x̄⁺ = A x̄ + B ū, ū = -K x̄."""
    if output_weight <= 0 or input_weight <= 0:
        raise DataError(f"LQR weights should be positive; {output_weight} and {input_weight}")
    A, B, C = model.A, model.B, model.C
    S = solve_riccati(A, B, output_weight * C.T @ C, np.array([[input_weight]]))
    gain: FloatArray = (B.T @ S @ A)[0] / (input_weight + (B.T @ S @ B)[0, 0])
    return gain


def track_profile(
    model: DifferenceEquation, profile: Sequence[tuple[float, float]], samples: int
) -> tuple[FloatArray, FloatArray]:
    """Nominal states (samples, n) and inputs (samples,) that follow a piecewise-linear output.

    profile: (time in s, output) corner points. Starts at rest at the profile's first value; inputs
    stay in the range the model was fitted on. Least squares on output error and input changes.
    Raises DataError if the profile's times do not increase.
    """
    times, values = np.array(profile, dtype=np.float64).T
    if not (np.diff(times) > 0).all():
        raise DataError(f"profile: times should increase; they are {times.tolist()}")
    reference = np.interp(np.arange(samples) * model.period, times, values)
    lo, hi = model.u_range
    gain_at_rest = model.b.sum() / (1.0 - model.a.sum())
    rest = float(np.clip((values[0] - model.c / (1.0 - model.a.sum())) / gain_at_rest, lo, hi))
    start = np.linalg.solve(np.eye(len(model)) - model.A, model.B[:, 0] * rest + model.offset)
    A, B, f = model.A, model.B[:, 0], model.offset
    response = np.empty(samples)  # y_j to a unit input at sample 0
    response[0], x = model.D, B.copy()
    for k in range(1, samples):
        response[k], x = x[0], A @ x
    free, x = np.empty(samples), start.copy()
    for k in range(samples):
        free[k], x = x[0] + model.c, A @ x + f
    lower = np.arange(samples)[:, None] - np.arange(samples)
    toeplitz = np.where(lower >= 0, response[np.clip(lower, 0, None)], 0.0)
    changes = np.eye(samples) - np.eye(samples, k=-1)
    rows = np.vstack([toeplitz, SMOOTHING * changes])
    target = np.concatenate([reference - free, [SMOOTHING * rest], np.zeros(samples - 1)])
    u = np.clip(lsq_linear(rows, target, bounds=(lo, np.nextafter(hi, np.inf))).x, lo, hi)
    states = np.empty((samples, len(model)))
    states[0] = start
    for k in range(samples - 1):
        states[k + 1] = A @ states[k] + B * u[k] + f
    return states, u
