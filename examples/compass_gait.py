"""A compass gait that walks down a slope for ever: each step from a funnel ends in it, proved.

Two legs with a mass each and one at the hip walk down a slope of 3 degrees, passively but for a hip
torque that corrects. θ = (swing leg, stance leg) from the vertical. Where the swing foot strikes,
θ_sw + θ_st = -2 SLOPE, the legs exchange their parts and lose speed. The foot passes the ground
once before, while the legs are together, which is ignored, as is usual: the guard is watched from a
time on at which the swing leg is ahead.

The passive step that repeats itself is found by shooting. States are y = SHAPE (θ, dθ/dt), SHAPE a
matrix of short binary fractions and determinant 1, in which the ellipsoids before the strike are
nearly round: a strike multiplies some deviations by ten.
Source: A. Goswami, B. Thuilot, B. Espiau, "Compass-like biped robot, part I: stability and
bifurcation of passive gaits", INRIA RR-2996, 1996: masses, equations, strike, and passive gait.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from nlsid_core.arrays import FloatArray
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
from nlsid_core.dynamics import Jump, Nominal, PiecewisePolynomial, taylor_field
from nlsid_core.kernel import Verdict
from nlsid_core.proofs import check

HIP, LEG, A, B, GRAVITY = 10.0, 5.0, 0.5, 0.5, 9.81  # kg, kg; m from foot and hip to a leg's mass
LENGTH = A + B
SLOPE = np.pi / 60  # rad
GUESS = np.array([-0.32, -0.38, -1.09])  # rad, rad/s: swing leg, and both rates, after a strike
PUBLISHED = 0.271, 0.735  # rad, half of what is between the legs at the strike; s of a step
APART = 0.5  # s: from then on the swing leg is ahead
WATCHED = 0.015  # s before the strike of the steady step, about
SHAPE = np.array([
    [1.0, -2.875, -0.109375, 0.65625],
    [0.0, 1.0, 0.03125, -0.3125],
    [0.0, 0.0, 1.0, -0.390625],
    [0.0, 0.0, 0.0, 1.0],
])  # fmt: skip
BACK = np.linalg.inv(SHAPE)  # exact: binary fractions
SIZE = 0.002  # of the funnel, in the cost-to-go's unit
Q = np.diag([10.0, 1.0, 10.0, 0.1])  # of angles and rates
R = np.array([[0.03]])
STABILITY = 4.0  # 1/s
LAYER = 0.02  # s, before the strike: what it takes off the goal lets P change more slowly there
KNOTS = 64
BEFORE_END = (0.112, 0.104, 0.096, 0.088, 0.08, 0.072, 0.064, 0.056, 0.049, 0.042, 0.035, 0.03,
              0.025, 0.02, 0.017, 0.014, 0.011, 0.0085, 0.0065, 0.005, 0.0038, 0.0025, 0.0015,
              0.0007, 0.0)  # fmt: skip
BEYOND = 0.015  # s, for which the steady step goes on past the strike
ROOM = 1.5  # of the boxes of the Taylor models, in widths of the funnel
WIDER = 1.1  # of the box of the reset, in widths of the funnel at knots
NEAR = 1e-3  # of boxes of which only the middle matters
ROUNDS = 12
BITS = 30  # of the steady step behind the point: short numbers are decided faster


def rate(x: Any, u: Any) -> list[Any]:
    """d(θ, dθ/dt)/dt."""
    s, c = np.sin(x[1] - x[0]), np.cos(x[1] - x[0])
    swing, both = LEG * B * B, -LEG * LENGTH * B * c
    stance = (HIP + LEG) * LENGTH**2 + LEG * A * A
    of_swing = u[0] - LEG * LENGTH * B * x[3] * x[3] * s - LEG * B * GRAVITY * np.sin(x[0])
    weight = (HIP * LENGTH + LEG * A + LEG * LENGTH) * GRAVITY
    of_stance = weight * np.sin(x[1]) - u[0] + LEG * LENGTH * B * x[2] * x[2] * s
    det = swing * stance - both * both
    return [
        x[2],
        x[3],
        (stance * of_swing - both * of_stance) / det,
        (swing * of_stance - both * of_swing) / det,
    ]


def struck(x: Any) -> list[Any]:
    """(θ, dθ/dt) after the strike: angular momentum about the new foot, and of the old leg."""
    c = np.cos(x[1] - x[0])
    first = (
        -LEG * A * B * x[2] + ((HIP * LENGTH**2 + 2 * LEG * A * LENGTH) * c - LEG * A * B) * x[3]
    )
    second = -LEG * A * B * x[3]
    a = LEG * B * (B - LENGTH * c)
    b = LEG * LENGTH * (LENGTH - B * c) + LEG * A * A + HIP * LENGTH**2
    d, e = LEG * B * B, -LEG * B * LENGTH * c
    det = a * e - b * d
    return [x[1], x[0], (e * first - b * second) / det, (a * second - d * first) / det]


def height(x: Any) -> Any:
    """θ_sw + θ_st + 2 SLOPE: with the swing leg ahead, above 0 while its foot is in the air."""
    return x[0] + x[1] + 2 * SLOPE


def product(M: FloatArray, x: Any) -> list[Any]:
    """M x, of numbers or of Taylor models."""
    return [sum(m * e for m, e in zip(row, x, strict=True) if m) for row in M.tolist()]


def shaped(x: Any, u: Any) -> list[Any]:
    """dy/dt at y = x."""
    return product(SHAPE, rate(product(BACK, x), u))


def shaped_height(x: Any) -> list[Any]:
    """The height at y = x."""
    return [height(product(BACK, x))]


def shaped_struck(x: Any) -> list[Any]:
    """(θ, dθ/dt) after the strike, at y = x."""
    return struck(product(BACK, x))


def striking() -> tuple[FloatArray, float]:
    """The start of the passive step that repeats itself, and how long it takes, by shooting."""

    def step(z: FloatArray) -> tuple[FloatArray, float]:
        start = np.array([z[0], -2 * SLOPE - z[0], z[1], z[2]])

        def strikes(t: float, x: FloatArray) -> float:
            return float(height(x)) if t > APART else 1.0

        strikes.terminal = True  # type: ignore[attr-defined]
        strikes.direction = -1.0  # type: ignore[attr-defined]
        solved = solve_ivp(lambda _, x: rate(x, [0.0]), (0.0, 2.0), start, events=strikes,
                           rtol=1e-10, atol=1e-12)  # fmt: skip
        return np.array(struck(solved.y_events[0][0]))[[0, 2, 3]], float(solved.t_events[0][0])

    z = fsolve(lambda z: step(z)[0] - z, GUESS, xtol=1e-11)
    return np.array([z[0], -2 * SLOPE - z[0], z[1], z[2]]), step(z)[1]


def steady() -> Nominal:
    """The passive step in y, past the strike as if there were no ground.

    Parabolas through short numbers: what is decided about a jump has six times their degree in s.
    """
    start, seconds = striking()
    end = seconds + BEYOND
    t = np.concatenate([np.linspace(0.0, end - 0.12, KNOTS), end - np.array(BEFORE_END)])
    motion = integrate_nominal(shaped, lambda _: np.zeros(1), t=t, start=SHAPE @ start)
    ends, middle = motion.x.ends(), motion.x((t[:-1] + t[1:]) / 2)
    control = np.stack([ends[:-1], 2 * middle - (ends[:-1] + ends[1:]) / 2, ends[1:]], axis=1)
    short = np.ldexp(np.round(np.ldexp(control, BITS)), -BITS)
    return Nominal(PiecewisePolynomial(t, short), motion.u)


def watched(t: FloatArray) -> int:
    """The knot from which the guard is watched."""
    return int(np.abs(t - t[-1] + BEYOND + WATCHED).argmin())


def strike(nominal: Nominal, wide: FloatArray) -> Jump:
    """The jump in y, its reset expanded so wide, (K, 4), around the motion at its knots."""
    first, x = watched(nominal.t), nominal.x.ends()
    low, high = (x - wide)[first:].min(axis=0), (x + wide)[first:].max(axis=0)
    start = float(nominal.t[first])
    box = np.column_stack([low, high])
    jump = Jump.of(shaped_height, shaped_struck, 4, start=start, box=box, then=SHAPE)
    return jump.along(nominal.x.derivative()(nominal.t[-1] - BEYOND))


def widths(P: FloatArray, rows: FloatArray | None = None) -> FloatArray:
    """(K, r) the largest |g'x̄| in x̄'Px̄ <= 1 for the rows g of (K, r, 4), or for each state."""
    inverse = np.linalg.inv(P)
    if rows is not None:
        inverse = rows @ inverse @ rows.swapaxes(1, 2)
    return np.asarray(np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)))


def designed() -> tuple[FunnelDesign, Jump]:
    """The funnel of a step, and the strike that leads from it into its start."""
    nominal = steady()
    t, x, u = nominal.t, nominal.x.ends(), nominal.u.ends()
    weight, torque = BACK.T @ Q @ BACK / SIZE, R / SIZE
    near = taylor_field(shaped, t, x, u, radius=np.full(5, NEAR))
    foot = strike(nominal, np.full(x.shape, NEAR))
    inlet = Goal(x[0], weight)
    for _ in range(ROUNDS):
        goal = goal_before(foot, shaped, nominal, inlet)
        goal = Goal(goal.centre, goal.P + LAYER * weight)
        found = tvlqr(near, nominal, Q=weight, R=torque, S_final=goal.P, stability=STABILITY)
        inlet = Goal(x[0], found.S[0])
    reach = ROOM * np.maximum(widths(found.S)[1:], widths(found.S)[:-1])
    push = ROOM * widths(found.S[:-1], found.policy.K.control[:, 0])
    field = taylor_field(shaped, t, x, u, radius=np.hstack([reach, push]))
    made = design(
        ContinuousTracking(field, nominal, goal=goal, Q=weight, R=torque, stability=STABILITY)
    )
    shape = made.funnel.P / made.funnel.rho[:, None, None]
    return made, strike(nominal, WIDER * widths(shape))


def proved(folder: Path | str) -> Verdict:
    """That every step from the funnel's start ends in it, in `folder`."""
    found, jump = designed()
    path = found.save(Path(folder) / "step")[-1]
    return check(compose_jumps([path], [jump], Path(folder) / "gait"))


def main() -> tuple[tuple[float, float], tuple[float, float]]:
    """(half the angle between the legs at the strike and the time of a step, the published)."""
    with TemporaryDirectory() as folder:
        print(proved(folder))
    start, seconds = striking()
    return (float(start[1] - start[0]) / 2, seconds), PUBLISHED


if __name__ == "__main__":
    print(main())
