"""Funnels around a short motion of the trapezoidal pendulum."""

from functools import cache

import numpy as np

from nlsid_core.design import SampledTracking
from nlsid_core.design.sampled.design import TrackingDesign, design_state_funnel
from nlsid_core.design.sampled.motion import plan_motion, track, tvlqr
from nlsid_core.models import Signal
from nlsid_core.models.trapezoidal import TrapezoidalModel
from tests.implicit_pendulum import PERIOD, truth
from tests.tracked import assumption

STEPS, BOUND = 14, 0.02


@cache
def designed(goal: float = 0.1) -> TrackingDesign:
    """The funnel around a short motion of the trapezoidal pendulum."""
    model = truth()
    x, u = plan_motion(model, [0.0, 0.0], [goal, 0.0], steps=STEPS)
    feedback = tvlqr(model, x, u, input_weight=0.3)
    policy = track(model, x, u, feedback)
    return design_state_funnel(
        SampledTracking(model, policy, feedback, assumption=assumption(BOUND))
    )


@cache
def two_joints() -> TrackingDesign:
    """The funnel around two steps of rest of two coupled joints with a torque each."""
    exponents = [[1, 0, 0, 0], [0, 1, 0, 0], [3, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    pull = [[-9.8, 1.0], [1.0, -9.8], [1.6, 0.0], [-0.5, 0.0], [0.0, -0.5]]
    torques = np.hstack([np.zeros((2, 4), dtype=np.int64), np.eye(2, dtype=np.int64)])
    model = TrapezoidalModel(
        exponents=np.vstack([np.hstack([exponents, np.zeros((5, 2), dtype=np.int64)]), torques]),
        coefficients=np.array([*pull, [1.0, 0.0], [0.2, 1.0]]),
        period=PERIOD,
        x=tuple(Signal(name) for name in ("q1", "q2", "v1", "v2")),
        u=(Signal("t1"), Signal("t2")),
        x_range=np.array([[-2.0, 2.0]] * 2 + [[-9.0, 9.0]] * 2),
        u_range=np.array([[-10.0, 10.0]] * 2),
        noise=np.full(4, 1e-3),
        disturbance=np.full(4, 1e-3),
        bags=(("fit", f"sha256:{1:064x}"),),
    )
    x, u = np.zeros((3, 4)), np.zeros((2, 2))
    feedback = tvlqr(model, x, u, input_weight=0.3)
    policy = track(model, x, u, feedback)
    return design_state_funnel(
        SampledTracking(model, policy, feedback, assumption=assumption(BOUND))
    )
