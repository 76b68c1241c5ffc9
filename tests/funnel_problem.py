"""Problems of funnels as files have them (docs/howto-funnels.md)."""

from functools import cache
from typing import Any

import numpy as np

from examples import satellite_funnel
from nlsid import ContinuousTracking, Goal, Nominal, VectorField, integrate_nominal
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.design import FunnelDesign, design_funnel
from nlsid_core.design.continuous.problem import Shape


def hanging(knots: int = 9) -> tuple[VectorField, Nominal]:
    """A pendulum to third order, with torque, at rest for 2 s."""

    def pendulum(x: Any, u: Any) -> Any:
        return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0]])

    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(0, 2, knots)
    return field, integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))


@cache
def hung(shape: Shape = "rho") -> FunnelDesign:
    """The funnel around it, with 9 knots."""
    return design_funnel(ContinuousTracking(*hanging(), goal=20 * np.eye(2), shape=shape))


@cache
def satellite() -> FunnelDesign:
    """The example's, with half of its knots."""
    field, nominal, weights = satellite_funnel.problem(25)
    goal = satellite_funnel.goal_matrix()
    return design_funnel(ContinuousTracking(field, nominal, goal=goal, **weights))


def document(field: VectorField, nominal: Nominal, goal: Goal, **options: Any) -> Json:
    """The JSON form of a problem; every number round-trips exactly."""
    return {
        "format": "nlsid/funnel_problem",
        "version": files.VERSION,
        "vector_field": field.document(),
        "nominal": {
            "t": nominal.t.tolist(),
            "x": nominal.x.control.tolist(),
            "u": nominal.u.control.tolist(),
        },
        "goal": {"centre": goal.centre.tolist(), "P": goal.P.tolist()},
        **{name: np.asarray(value).tolist() for name, value in options.items()},
    }
