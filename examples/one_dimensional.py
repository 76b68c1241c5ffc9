"""The example of thesis Section 7.1: ẋ = x - x²/2 + 2t - 2.4t³, goal [0, 1] at t = 1."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from nlsid import ContinuousTracking, Goal, Nominal, VectorField, design, integrate_nominal
from nlsid_core.arrays import FloatArray
from nlsid_core.design import FunnelDesign
from nlsid_core.funnels.continuous import ContinuousFunnel

KNOTS = 40
GOAL = Goal(np.array([0.5]), np.array([[4.0]]))
BEST_AREA = 0.872  # of the true backward reachable set, by the best symmetric funnel; integrated


def dynamics(t: Any, x: Any) -> Any:
    """ẋ; x (1,)."""
    return np.array([x[0] - x[0] ** 2 / 2 + 2 * t - 2.4 * t**3])


def problem(knots: int = KNOTS) -> tuple[VectorField, Nominal]:
    """The field and the motion that ends at ½."""
    field = VectorField.from_function(dynamics, 1, 0)
    t = np.linspace(-1.0, 1.0, knots)
    return field, integrate_nominal(field, lambda _: np.zeros(0), t=t, final=[0.5])


def designed(knots: int = KNOTS) -> FunnelDesign:
    """The funnel, with P(t) from the linearisation alone (Q = 0)."""
    return design(ContinuousTracking(*problem(knots), goal=GOAL, Q=np.zeros((1, 1))))


def radius(funnel: ContinuousFunnel, t: FloatArray) -> FloatArray:
    """Half the width of the funnel at times t."""
    return np.array([1 / np.sqrt(funnel.shape(float(s))[0, 0]) for s in t])


def true_sets(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """At times t: the width of the true backward reachable set, and the best symmetric radius."""

    def f(s: float, x: float) -> float:
        return float(dynamics(s, [x])[0])

    def rate(s: float, state: FloatArray) -> list[float]:
        low, middle, high, r = state
        outward = max(f(s, middle + r) - f(s, middle), f(s, middle) - f(s, middle - r))
        return [f(s, low), f(s, middle), f(s, high), outward]

    found = solve_ivp(rate, (1.0, -1.0), [0, 0.5, 1, 0.5], t_eval=t[::-1], rtol=1e-10, atol=1e-12)
    states = found.y[:, ::-1]
    return states[2] - states[0], states[3]


def main() -> tuple[float, float]:
    """(area fraction of the true backward reachable set, what the best symmetric funnel covers)."""
    t = np.linspace(-1.0, 1.0, 401)
    width, _ = true_sets(t)
    found = designed()
    print(found)
    return float(2 * radius(found.funnel, t).mean() / width.mean()), BEST_AREA


if __name__ == "__main__":
    print(main())
