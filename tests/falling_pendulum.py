"""A pendulum that falls, swung and pushed: a small problem of everything a funnel may claim."""

from typing import Any

import numpy as np

from nlsid import ContinuousTracking, VectorField, integrate_nominal


def turning(x: Any, u: Any, w: Any) -> Any:
    """A push of either sign on a pendulum that falls, its sine a cubic."""
    return np.array([x[1] + w[0], 9.0 * x[0] - 1.5 * x[0] ** 3 + u[0]])


def tracking(**options: Any) -> ContinuousTracking:
    """A swing of 0.3 rad in a second."""
    field = VectorField.from_function(turning, 2, 1, uncertain=[[-0.01, 0.01]])
    nominal = integrate_nominal(
        field,
        lambda t: np.array([-9.0 * 0.3 * np.cos(2.0 * t)]),
        t=np.linspace(0, 1, 26),
        start=np.array([0.25, 0.0]),
    )
    return ContinuousTracking(
        field, nominal, goal=np.diag([25.0, 4.0]), Q=np.diag([500.0, 40.0]), R=[[1.0]], **options
    )
