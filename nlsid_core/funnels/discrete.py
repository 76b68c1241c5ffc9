"""`design_tube`: a proved tube around the trajectories of an identified difference equation.

The observer's state obeys x̂⁺ = A x̂ + B u + f + L e by definition of the innovation e, so a bound
on Σ e² is all the tube rests on. The ellipsoid is the smallest (in the output) that satisfies
V(x̄⁺) ≤ V(x̄) + e² both with the nominal inputs played and with the policy engaged; the observer
gain is the one whose tube is narrowest on the training trials.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.tube import dissipates
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.funnel import EnergyAssumption, Funnel
from nlsid_core.funnels.observer import innovation_energies, kalman_gain
from nlsid_core.funnels.tracking import lqr_gain, track_profile
from nlsid_core.models import DifferenceEquation
from nlsid_core.policy import Policy
from nlsid_core.trajectory import Dataset

NOISE_RATIOS = np.logspace(-6, 3, 37)  # input noise over measurement noise: from trusting the model
# alone to trusting the measurement alone
DECREASE_ROOM = 1e-5  # relative room left in V's inequality, far above rounding, 1e-5 of the tube
REGULARISATION = 1e-7  # of the largest variance, so that P = W⁻¹ is well conditioned
LEVEL_ROOM = 1e-9  # relative room for the rounding of the stored nominal


@dataclass(frozen=True, eq=False)
class TubeDesign:
    """A policy, the funnel around its nominal, and the slack its proof states."""

    model: DifferenceEquation
    policy: Policy
    funnel: Funnel
    slack: float

    def proof_document(self, *, model: str, policy: str, funnel: str) -> Json:
        """The proof file's content; the arguments name the three files beside it."""
        about = {
            "model": {"file": model, "digest": _json.digest(self.model.document())},
            "policy": {"file": policy, "digest": _json.digest(self.policy.document())},
            "funnel": {"file": funnel, "digest": _json.digest(self.funnel.document())},
        }
        claim = {"kind": "energy_tube", "about": about}
        return proof_document(claim, {"slack": self.slack})


def design_tube(
    model: DifferenceEquation,
    train: Dataset,
    *,
    profile: Sequence[tuple[float, float]],
    horizon: float,
    safety_factor: float = 1.5,
    inlet: float = 0.0,
    lqr_weights: tuple[float, float] | None = (1.0, 1.0),
) -> TubeDesign:
    """Design policy, observer and tube for `model`; the disturbance bound is measured on `train`.

    profile: (s, output) corners of the nominal. horizon: s, how long the energy budget lasts.
    safety_factor: of the disturbance's amplitude over the largest measured. inlet: allowed initial
    error of the output, in its unit. lqr_weights: of output and input; None is K = 0, a prediction
    tube. Source: energy form of a disturbance bound, linear case.

    Raises DataError on options that make no sense, Infeasible if no ellipsoid exists.
    """
    samples = round(horizon / model.period)
    longest = max(len(trial) for trial in train) - len(model)
    if not 0 < samples <= longest:
        raise DataError(
            f"horizon {horizon} s is {samples} samples; the disturbance can be measured on the "
            f"training trials for 1 to {longest}"
        )
    if safety_factor < 1.0 or inlet < 0.0:
        raise DataError(f"safety factor {safety_factor} should be >= 1, inlet {inlet} >= 0")
    K: FloatArray = np.zeros(len(model))
    if lqr_weights is not None:
        K = lqr_gain(model, output_weight=lqr_weights[0], input_weight=lqr_weights[1])
    gains = np.array([kalman_gain(model, ratio) for ratio in NOISE_RATIOS])
    measured = innovation_energies(model, gains, train).max(axis=0)
    widths = [
        np.sqrt(energy * (1.0 + open_loop_covariance(model, L)[0, 0]))
        for L, energy in zip(gains, measured, strict=True)
    ]
    best = int(np.argmin(widths))
    L, energy = gains[best], float(measured[best])
    W = _smallest_ellipsoid(model, K, L)
    P = np.linalg.inv(W)
    P = (P + P.T) / 2.0
    slack = DECREASE_ROOM / 2.0
    refusal = dissipates(model, K, L, P, slack)
    if refusal is not None:
        raise Infeasible(f"no proved ellipsoid: {refusal}; try a larger input weight")
    budget = safety_factor**2 * energy
    inlet_level = inlet**2 / float(np.linalg.inv(P)[0, 0])
    x, u = track_profile(model, profile, samples)
    level = (budget + inlet_level) * (1.0 + LEVEL_ROOM)
    reach = max(float(c @ np.linalg.solve(P, c)) for c in _output_rows(model, K))
    policy = Policy(x=x, u=u, K=K, L=L, period=model.period, model=_json.digest(model.document()))
    funnel = Funnel(
        P=P,
        level=level,
        inlet=inlet_level,
        half_width=_rounded_up(float(np.sqrt(level * (1.0 + reach)))),
        assumption=EnergyAssumption(
            budget=budget,
            samples=samples,
            measured=energy,
            safety_factor=safety_factor,
            measured_on=tuple((trial.name, trial.digest) for trial in train),
        ),
        model=policy.model,
        policy=_json.digest(policy.document()),
    )
    return TubeDesign(model, policy, funnel, slack)


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
    """The next number of three significant digits, to be printed and proved as it is."""
    digits = 2 - int(np.floor(np.log10(width)))
    return float(np.round(np.ceil(width * 10.0**digits) / 10.0**digits, digits))
