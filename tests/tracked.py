"""A pendulum known exactly, with a cubic in the place of the sine, and a short motion of it."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from nlsid import SampledTracking, Trajectory
from nlsid_core.arrays import FloatArray
from nlsid_core.design.sampled.design import TrackingDesign, design_state_funnel
from nlsid_core.design.sampled.motion import Feedback, plan_motion, track, tvlqr
from nlsid_core.funnels.sampled import DisturbanceAssumption
from nlsid_core.models import Signal, StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.running.observer import StateObserver

PERIOD = 0.02
STEPS = 25
BOUND = 0.02
NOISE = np.array([1e-4, 1e-3])
EXPONENTS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 0]]


def pendulum() -> StateModel:
    """q⁺ = q + h v, v⁺ = v + h(u - 9.8(q - q³/6) - 0.5 v)."""
    h = PERIOD
    coefficients = [
        [0.0, 0.0],
        [1.0, -9.8 * h],
        [h, 1.0 - 0.5 * h],
        [0.0, h],
        [0.0, 9.8 * h / 6],
    ]
    return StateModel(
        exponents=np.array(EXPONENTS),
        coefficients=np.array(coefficients),
        period=PERIOD,
        x=(Signal("angle", "rad", "/arm:position[0]"), Signal("rate", "rad/s", "/arm:velocity[0]")),
        u=(Signal("torque", "N m", "/torque:effort[0]"),),
        x_range=np.array([[-1.2, 1.2], [-4.0, 4.0]]),
        u_range=np.array([[-10.0, 10.0]]),
        noise=np.array([1e-3, 1e-2]),
        disturbance=np.array([1e-4, 1e-3]),
        bags=(("fit", f"sha256:{1:064x}"),),
    )


@dataclass(frozen=True, eq=False)
class Tracked:
    """Model, motion and feedback before any funnel."""

    model: StateModel
    policy: SampledPolicy
    feedback: Feedback


@cache
def tracked(goal: float = 0.4) -> Tracked:
    """The motion from rest to `goal` in half a second."""
    model = pendulum()
    x, u = plan_motion(model, [0.0, 0.0], [goal, 0.0], steps=STEPS)
    feedback = tvlqr(model, x, u, input_weight=0.3)
    return Tracked(model, track(model, x, u, feedback), feedback)


def assumption(bound: float = BOUND) -> DisturbanceAssumption:
    """As measured on one commissioning run."""
    return DisturbanceAssumption(bound, 0.625 * bound, 1.5, (("drive", f"sha256:{2:064x}"),))


@cache
def designed(goal: float = 0.4) -> TrackingDesign:
    """The funnel around that motion."""
    base = tracked(goal)
    return design_state_funnel(
        SampledTracking(base.model, base.policy, base.feedback, assumption=assumption())
    )


def step(design: TrackingDesign, k: int, x: FloatArray) -> FloatArray:
    """One undisturbed step of the closed loop from x (..., n)."""
    u = design.policy.u[k] - (x - design.policy.x[k]) @ design.policy.K[k].T
    return design.model(x, u)


def run(
    *,
    seed: int = 0,
    kick: FloatArray | None = None,
    kick_at: int = 8,
    start: FloatArray | None = None,
) -> Trajectory:
    """The policy on its own model with a little noise; a kick moves the state once."""
    base = tracked()
    rng = np.random.default_rng(seed)
    observer = StateObserver(base.model, base.policy.L)
    x = base.policy.x[0] if start is None else start
    y, u = np.empty((STEPS + 1, 2)), np.zeros((STEPS + 1, 1))
    for k in range(STEPS + 1):
        y[k] = x + NOISE * rng.standard_normal(2)
        estimate = observer.update(y[k], u[k - 1] if k else None)
        if k < STEPS:
            u[k] = base.policy(k, estimate)
            x = base.model(x, u[k])
            if kick is not None and k == kick_at:
                x = x + kick
    t = np.arange(STEPS + 1) * PERIOD
    return Trajectory(t=t, y=y, u=u, name=f"run_{seed}", digest=f"sha256:run{seed}")
