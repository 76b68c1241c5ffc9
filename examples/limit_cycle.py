"""The limit cycle of the Van der Pol oscillator: all starts in a ring come to it, for ever.

In Liénard's plane, x = r cos φ and y = -r sin φ with ẋ = y - (x³/3 - x) and ẏ = -x, the phase φ
always grows, so r is the one coordinate across the cycle and φ takes the part of time. The
oscillator is odd, so half a turn is a whole cycle of r.
Amplitude for μ = 1: P. Amore, "Computing the solutions of the van der Pol equation to arbitrary
precision", arXiv:2111.12198.
"""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    closed_cycle,
    design,
    integrate_nominal,
)
from nlsid_core.funnels.continuous import ContinuousFunnel

PUBLISHED = 2.0086198609
TURN = np.pi
KNOTS = 61
NEAR = 0.05  # of r, after half a turn


def rate(t: Any, x: Any) -> list[Any]:
    """dr/dφ, φ being t."""
    c, s = np.cos(t), np.sin(t)
    bend = c * ((x[0] * c) ** 2 / 3 - 1)  # (x³/3 - x)/r
    return [-x[0] * bend * c / (1 + s * bend)]


def after_half_a_turn(r: float) -> float:
    """What r becomes."""
    solved = solve_ivp(rate, (0.0, TURN), [r], rtol=1e-11, atol=1e-12)
    return float(solved.y[0, -1])


def designed() -> FunnelDesign:
    """The funnel around the limit cycle, proved to end inside its start."""
    r = brentq(lambda r: after_half_a_turn(r) - r, 1.5, 2.5, xtol=1e-13)
    times = np.linspace(0.0, TURN, KNOTS)
    cycle = integrate_nominal(rate, lambda _: np.zeros(0), t=times, start=[r])
    return closed_cycle(design(ContinuousTracking(rate, cycle, goal=[NEAR])))


def amplitude(funnel: ContinuousFunnel) -> float:
    """The largest |x| of the cycle that the funnel is around."""
    phases = np.linspace(0.0, TURN, 2001)
    r = np.array([funnel.nominal(float(phase))[0] for phase in phases])
    return float(np.abs(r * np.cos(phases)).max())


def main() -> tuple[float, float]:
    """(the cycle's amplitude in x, the published one)."""
    return amplitude(designed().funnel), PUBLISHED


if __name__ == "__main__":
    print(designed())
    print(main())
