"""A rimless wheel that walks down a slope: every step from a range of speeds comes nearer.

A hub on spokes 2α apart rolls over its stance spoke, ω = dθ/dt, dω/dt = (g/l) sin θ, from θ = γ - α
to γ + α; there the next spoke strikes, and ω⁺ = ω cos 2α. θ takes the part of time, so the step is
dω/dθ = (g/l) sin θ / ω, the impact a linear map. It starts at ω* = cot 2α √(4 (g/l) sin α sin γ).
Source: McGeer, "Passive dynamic walking", IJRR 9(2) (1990); R. Tedrake, Underactuated Robotics,
"Simple models of walking and running".
"""

from typing import Any

import numpy as np

from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    closed_cycle,
    design,
    integrate_nominal,
)

GRAVITY = 9.81  # m/s² over a spoke of 1 m
ALPHA, SLOPE = np.pi / 8, 0.2  # rad
PUBLISHED = float(np.sqrt(4 * GRAVITY * np.sin(ALPHA) * np.sin(SLOPE)) / np.tan(2 * ALPHA))
KNOTS = 41
NEAR = 0.4  # rad/s, before the impact


def rate(t: Any, x: Any) -> list[Any]:
    """dω/dθ, θ being t."""
    return [GRAVITY * np.sin(t) / x[0]]


def designed() -> FunnelDesign:
    """The funnel around the steady step, proved to be inside its start after the impact."""
    angles = np.linspace(SLOPE - ALPHA, SLOPE + ALPHA, KNOTS)
    step = integrate_nominal(rate, lambda _: np.zeros(0), t=angles, start=[PUBLISHED])
    found = design(ContinuousTracking(rate, step, goal=[NEAR]))
    return closed_cycle(found, reset=[[np.cos(2 * ALPHA)]])


def main() -> tuple[float, float]:
    """(the speed after the impact that the steady step comes to, the published one)."""
    funnel = designed().funnel
    return float(np.cos(2 * ALPHA) * funnel.nominal(funnel.tf)[0]), PUBLISHED


if __name__ == "__main__":
    print(designed())
    print(main())
