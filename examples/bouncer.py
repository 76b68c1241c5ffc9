"""A body that bounces for ever: its height and speed at every landing stay within a proved range.

It falls under gravity, lands with some of its speed lost, and a thruster gives back what a landing
takes. The landing is not at a known time: the guard is the height, the reset reverses the speed
times the restitution. The funnel of one flight jumps into its own start, so the claim is for ever.
The steady flight has a thrust that falls linearly, so that height and speed are polynomials.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    Goal,
    compose_jumps,
    design,
    goal_before,
    integrate_nominal,
    tvlqr,
)
from nlsid_core.dynamics import Jump, Nominal, VectorField
from nlsid_core.kernel import Verdict
from nlsid_core.proofs import check

GRAVITY, RESTITUTION = 9.81, 0.8
SPEED, SECONDS, BEYOND = 3.0, 1.0, 0.1  # m/s on leaving the ground; s of flight, and past landing
KNOTS, WATCHED = 12, 5  # the ground is looked for from the fifth knot on
LIMITS = [[0, 0.0, 6.0]]  # m/s², of the thruster
Q, R = 4.0 * np.eye(2), np.array([[1.2]])
ROUNDS = 8  # until the cost-to-go of one flight is that of the next


def rate(x: Any, u: Any) -> list[Any]:
    """d(height, speed)/dt."""
    return [x[1], u[0] - GRAVITY]


def landed(x: Any) -> list[Any]:
    """(height, speed) after the landing."""
    return [x[0], -RESTITUTION * x[1]]


def flight() -> tuple[VectorField, Nominal]:
    """The steady flight, as if there were no ground at its end."""
    lost = SPEED / RESTITUTION - SPEED
    slope = 6 * lost / SECONDS**2
    fall = 2 * (SPEED - lost) / SECONDS
    field = VectorField.from_function(rate, 2, 1)
    t = np.linspace(0.0, SECONDS + BEYOND, KNOTS)
    thrust = lambda s: [GRAVITY - fall - slope * s]  # noqa: E731
    return field, integrate_nominal(field, thrust, t=t, start=[0.0, SPEED])


def designed() -> tuple[FunnelDesign, Jump]:
    """The funnel of a flight, whose end is what jumps into its start, and the landing."""
    field, nominal = flight()
    landing = Jump.of(lambda x: [x[0]], landed, 2, start=float(nominal.t[WATCHED]))
    inlet = Goal(np.array([0.0, SPEED]), Q)
    for _ in range(ROUNDS):
        goal = goal_before(landing, field, nominal, inlet)
        inlet = Goal(inlet.centre, tvlqr(field, nominal, Q=Q, R=R, S_final=goal.P).S[0])
    goal = goal_before(landing, field, nominal, inlet)
    return design(ContinuousTracking(field, nominal, goal=goal, Q=Q, R=R, limits=LIMITS)), landing


def proved(folder: Path | str) -> Verdict:
    """That every flight from the funnel's start lands in it again, in `folder`."""
    found, landing = designed()
    path = found.save(Path(folder) / "flight")[-1]
    return check(compose_jumps([path], [landing], Path(folder) / "bounces"))


def main() -> tuple[float, float]:
    """(the speed of the steady flight after its landing, at its start)."""
    with TemporaryDirectory() as folder:
        print(proved(folder))
    _, nominal = flight()
    return -RESTITUTION * float(nominal.x(SECONDS)[1]), SPEED


if __name__ == "__main__":
    print(main())
