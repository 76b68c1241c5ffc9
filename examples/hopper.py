"""A hopper that stays on its spot: every hop from near the steady one starts the next one there.

A body flies up and down under gravity, lands with speed -e, and leaves the ground with 0.8 e + j:
a fifth of its speed is lost, and a kick of its leg gives the same j each time. A thruster steers
it sideways, against gusts, and each landing takes a tenth of its speed sideways. How long it flies
depends on how it took off. So not time is the phase but φ = -v/e, with v the speed upwards and e
the speed that it has on the ground, e² = v² + 2gy: φ is -1 on leaving the ground and 1 on landing,
whatever e is, and dφ/dt = g/e. In flight e stays what it is. Across φ, with e - e₀, x and dx/dt,
the landing is the linear map diag(0.8, 1, 0.9), since the steady hop has j = 0.2 e₀.
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

GRAVITY = 9.81  # m/s²
SPEED = 3.0  # m/s, e₀
LANDING = np.diag([0.8, 1.0, 0.9])
LIMITS = [[-4.0, 4.0]]  # m/s², of the thruster
GUST = 0.2  # m/s²
GOAL = [1.0, 0.15, 0.6]  # m/s, m, m/s, before landing
WEIGHTS = np.diag([0.05, 10.0, 1.0])  # little on e, which nothing but the landing changes
KNOTS = 21


def rate(x: Any, u: Any, w: Any) -> list[Any]:
    """d(e - e₀, x, dx/dt)/dφ."""
    lasts = (SPEED + x[0]) / GRAVITY  # dt/dφ
    return [0.0 * x[0], lasts * x[2], lasts * (u[0] + w[0])]


def designed() -> FunnelDesign:
    """The funnel around the steady hop, proved to be inside its start after the landing."""
    hop = integrate_nominal(
        lambda x, u: rate(x, u, [0.0]), lambda _: np.zeros(1), t=np.linspace(-1, 1, KNOTS),
        start=np.zeros(3),
    )  # fmt: skip
    found = design(
        ContinuousTracking(
            rate, hop, goal=GOAL, limits=LIMITS, uncertain=[[-GUST, GUST]], Q=WEIGHTS
        )
    )
    return closed_cycle(found, reset=LANDING)


if __name__ == "__main__":
    print(designed())
