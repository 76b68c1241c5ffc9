"""Twenty-three problems written as a user writes them from the docs: default settings, no tuning.

    python -m benchmarks.first_try [--json] [--only NAME ...] [--starts N] [--limit S] [--out FILE]

Each function is all that a user writes. A refusal is reported, not hidden. Starts on the boundary
at t0 and at a later knot follow the true equations; w is at random corners of its box. `room` is
how many times as far from the motion the nearest start at t0 is that misses the goal. Each is then
designed for a computer: `hold="largest"`, states measured wrong by up to a hundredth of the goal;
and simulated so, with samples a half to all of the hold apart.

A design that takes more than --limit of processor time is stopped and reported as not proved. What
became of each problem is printed, and written to --out, when it is known.
"""

import inspect
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.limits import OutOfTimeError, stopped_after
from benchmarks.machine import parser, tell
from benchmarks.thesis.soundness import OneSet, Simulation
from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    design,
    integrate_nominal,
    plan_motion,
)
from nlsid_core.dynamics import Rates, solve
from nlsid_core.errors import NlsidError
from nlsid_core.proofs import check

Written = tuple[Callable[..., Any], ContinuousTracking]
SUBSTEPS = 10
LIMIT = 60.0  # s of processor time for one design
WRONG = 0.01  # of the goal's half-widths: what a state is measured wrong by


def car() -> Written:
    """A lane change at 8 m/s; the input is the curvature's rate, limited."""

    def rate(x: Any, u: Any) -> Any:  # along, across in m, heading in rad, curvature in 1/m
        return [8 * np.cos(x[2]), 8 * np.sin(x[2]), 8 * x[3], u[0]]

    motion = plan_motion(rate, start=[0, 0, 0, 0], end=[31.5, 3, 0, 0], seconds=4, u=[0])
    goal = [1.0, 0.5, 0.1, 0.05]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=[[-0.3, 0.3]])


def bicycle() -> Written:
    """A lane change at 10 m/s; the steering follows its command with a lag of 0.2 s."""

    def rate(x: Any, u: Any) -> Any:  # across in m, heading and steering in rad
        return [10 * np.sin(x[1]), 10 / 2.7 * np.tan(x[2]), (u[0] - x[2]) / 0.2]

    motion = plan_motion(rate, start=[0, 0, 0], end=[3, 0, 0], seconds=3, u=[0])
    return rate, ContinuousTracking(rate, motion, goal=[0.3, 0.06, 0.06])


def rocket() -> Written:
    """A planar rocket that descends 20 m and lands upright; thrust and gimbal angle."""

    def rate(x: Any, u: Any) -> Any:  # position in m, tilt in rad, their rates
        side, up = u[0] * np.sin(x[2] + u[1]), u[0] * np.cos(x[2] + u[1])
        return [x[3], x[4], x[5], side, up - 9.81, -1.5 * u[0] * np.sin(u[1])]

    start, end = [4, 20, 0, 0, -5, 0], [0, 0, 0, 0, 0, 0]
    motion = plan_motion(rate, start=start, end=end, seconds=5, u=[9.81, 0])
    goal = [0.5, 0.5, 0.1, 0.5, 0.5, 0.3]
    return rate, ContinuousTracking(rate, motion, goal=goal)


def acrobot() -> Written:
    """Swing and catch: torque at the elbow only, from hanging to upright."""

    def rate(x: Any, u: Any) -> Any:  # angles from hanging in rad, their rates
        c, s = np.cos(x[1]), np.sin(x[1])
        M = [[1.7 + c, 0.35 + 0.5 * c], [0.35 + 0.5 * c, 0.35]]
        g1 = 9.81 * (1.5 * np.sin(x[0]) + 0.5 * np.sin(x[0] + x[1]))
        turn = 0.5 * s * (2 * x[2] * x[3] + x[3] ** 2)
        b = [turn - g1, u[0] - 0.5 * s * x[2] ** 2 - 9.81 * 0.5 * np.sin(x[0] + x[1])]
        a = solve(M, b)
        return [x[2], x[3], a[0], a[1]]

    motion = plan_motion(rate, start=[0, 0, 0, 0], end=[np.pi, 0, 0, 0], seconds=4, u=[0])
    return rate, ContinuousTracking(rate, motion, goal=[0.1, 0.1, 0.3, 0.3])


def dubins(wind: float) -> Written:
    """An airplane at 10 m/s in wind that blows from anywhere; turn and climb rates."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # position in m, heading and path angle in rad
        level = 10 * np.cos(x[4])
        return [
            level * np.cos(x[3]) + w[0],
            level * np.sin(x[3]) + w[1],
            10 * np.sin(x[4]) + w[2],
            u[0],
            u[1],
        ]

    start, end = [0, 0, 0, 0, 0], [35, 15, 3, np.pi / 4, 0]
    motion = plan_motion(calm(rate, 3), start=start, end=end, seconds=4, u=[0, 0])
    box = wind * np.array([[-1, 1], [-1, 1], [-1, 1]])
    return rate, ContinuousTracking(rate, motion, goal=[4, 3, 3, 0.3, 0.3], uncertain=box)


def satellite() -> Written:
    """A turn about all axes; inertia diag(1, 2, 4), modified Rodrigues parameters."""

    def rate(x: Any, u: Any) -> Any:  # attitude, body rates in rad/s
        s, w = x[:3], x[3:]
        inner, square = s[0] * w[0] + s[1] * w[1] + s[2] * w[2], s[0] ** 2 + s[1] ** 2 + s[2] ** 2
        turned = ((1 - square) * w + 2 * np.cross(s, w, axis=0) + 2 * inner * s) / 4
        gyro = [-2 * w[1] * w[2], 3 * w[0] * w[2], -w[0] * w[1]]
        return [*turned, gyro[0] + u[0], (gyro[1] + u[1]) / 2, (gyro[2] + u[2]) / 4]

    start, end = [0.3, -0.2, 0.2, 0, 0, 0], np.zeros(6)
    motion = plan_motion(rate, start=start, end=end, seconds=5, u=[0, 0, 0])
    return rate, ContinuousTracking(rate, motion, goal=[0.2, 0.2, 0.2, 0.2, 0.2, 0.2])


def van_der_pol() -> Written:
    """The oscillator run backward in time, without an input, from the origin's region."""

    def rate(x: Any) -> Any:
        return [-x[1], x[0] + (x[0] ** 2 - 1) * x[1]]

    times = np.linspace(0, 4, 31)
    motion = integrate_nominal(rate, lambda _: np.zeros(0), t=times, start=[0, 0])
    return rate, ContinuousTracking(rate, motion, goal=[0.5, 0.5])


def flexible_arm() -> Written:
    """Two links in a plane with elastic joints: motor torques, links beyond springs."""

    def rate(x: Any, u: Any) -> Any:  # link and motor angles in rad, their rates
        c, s = np.cos(x[1]), np.sin(x[1])
        M = [[1.6 + 0.8 * c, 0.5 + 0.4 * c], [0.5 + 0.4 * c, 0.5]]
        spring = 50 * (x[2:4] - x[:2]) + 2 * (x[6:] - x[4:6])
        bend = 0.4 * s * np.array([-x[5] * (2 * x[4] + x[5]), x[4] ** 2])
        a = solve(M, spring - bend)
        return [*x[4:], *a, *((u - spring) / 0.3)]

    start, end = np.zeros(8), [1, 0.8, 1, 0.8, 0, 0, 0, 0]
    motion = plan_motion(rate, start=start, end=end, seconds=2, u=[0, 0])
    goal = [0.1, 0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 0.5]
    return rate, ContinuousTracking(rate, motion, goal=goal)


def quadrotor_9() -> Written:
    """A quadrotor whose autopilot follows roll, pitch and thrust commands with a lag."""

    def rate(x: Any, u: Any) -> Any:  # position, velocity, roll, pitch in rad, thrust in m/s²
        roll, pitch, thrust = x[6], x[7], x[8]
        push = [thrust * np.sin(pitch) * np.cos(roll), -thrust * np.sin(roll)]
        lift = thrust * np.cos(pitch) * np.cos(roll) - 9.81
        return [*x[3:6], *push, lift, *((u - x[6:]) / 0.15)]

    start, end = np.zeros(9), np.zeros(9)
    end[:3], start[8], end[8] = [2, 1, 0.5], 9.81, 9.81
    motion = plan_motion(rate, start=start, end=end, seconds=3, u=[0, 0, 9.81])
    goal = [0.2, 0.2, 0.2, 0.4, 0.4, 0.4, 0.2, 0.2, 1.0]
    return rate, ContinuousTracking(rate, motion, goal=goal)


def quadrotor_16() -> Written:
    """A quadrotor with four motors that follow their commands with a lag."""

    def rate(x: Any, u: Any) -> Any:  # position, velocity, Euler angles, body rates, motors
        (f, p, y), (a, b, c), T = x[6:9], x[9:12], x[12:]
        sf, cf, sp, cp = np.sin(f), np.cos(f), np.sin(p), np.cos(p)
        sy, cy, thrust = np.sin(y), np.cos(y), T[0] + T[1] + T[2] + T[3]
        push = [thrust * (cf * sp * cy + sf * sy), thrust * (cf * sp * sy - sf * cy)]
        angles = [a + (b * sf + c * cf) * sp / cp, b * cf - c * sf, (b * sf + c * cf) / cp]
        turn = [8 * (T[1] - T[3]) - 0.7 * b * c, 8 * (T[2] - T[0]) + 0.7 * a * c]
        lift, spin = thrust * cf * cp - 9.81, T[0] - T[1] + T[2] - T[3]
        return [*x[3:6], *push, lift, *angles, *turn, spin, *((u - T) / 0.05)]

    start, end, hover = np.zeros(16), np.zeros(16), 9.81 / 4
    end[:3], start[12:], end[12:] = [1, 1, 0.5], hover, hover
    motion = plan_motion(rate, start=start, end=end, seconds=3, u=[hover] * 4)
    goal = [0.2] * 3 + [0.4] * 3 + [0.2] * 3 + [1.0] * 3 + [1.0] * 4
    return rate, ContinuousTracking(rate, motion, goal=goal)


def docking() -> Written:
    """A spacecraft in a circular orbit comes to rest at a port; three limited thrusts."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # radial, along, across the orbit in m, their rates
        n, a = 1.1e-3, u + w
        radial, along = 3 * n**2 * x[0] + 2 * n * x[4] + a[0], a[1] - 2 * n * x[3]
        return [*x[3:], radial, along, a[2] - n**2 * x[2]]

    start, end = [10, -20, 5, 0, 0, 0], np.zeros(6)
    motion = plan_motion(calm(rate, 3), start=start, end=end, seconds=60, u=[0, 0, 0])
    goal, push, limits = 3 * [0.5] + 3 * [0.05], 3 * [[-1e-3, 1e-3]], 3 * [[-0.05, 0.05]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits, uncertain=push)


def crane() -> Written:
    """A trolley with a hoist; wind pushes the load."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # trolley and rope in m, sway in rad, their rates
        turn = u[0] * np.cos(x[2]) + 9.81 * np.sin(x[2]) + 2 * x[4] * x[5] + w[0]
        return [*x[3:], u[0], u[1], -turn / x[1]]

    start, end = [0, 5, 0, 0, 0, 0], [4, 3, 0, 0, 0, 0]
    motion = plan_motion(calm(rate, 1), start=start, end=end, seconds=6, u=[0, 0])
    goal, limits = [0.3, 0.2, 0.1, 0.3, 0.2, 0.15], [[-2, 2], [-1, 1]]
    gust = [[-0.05, 0.05]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits, uncertain=gust)


def differential_drive() -> Written:
    """Two driven wheels that slip sideways and turn too far."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # position in m, heading in rad, speed, turn rate
        c, s = np.cos(x[2]), np.sin(x[2])
        return [x[3] * c - w[0] * s, x[3] * s + w[0] * c, x[4] + w[1], u[0], u[1]]

    start, end = [0, 0, 0, 1, 0], [4, 1.5, 0.5, 1, 0]
    motion = plan_motion(calm(rate, 2), start=start, end=end, seconds=4, u=[0, 0])
    goal, limits, slip = [0.3, 0.3, 0.2, 0.3, 0.3], [[-1, 1], [-2, 2]], 2 * [[-0.03, 0.03]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits, uncertain=slip)


def two_link_arm() -> Written:
    """Two links in a plane, a limited torque at each joint."""

    def rate(x: Any, u: Any) -> Any:  # angles in rad, their rates
        c, s = 0.4 * np.cos(x[1]), 0.4 * np.sin(x[1])
        torque = [u[0] + s * x[3] * (2 * x[2] + x[3]), u[1] - s * x[2] ** 2]
        a = solve([[1.6 + 2 * c, 0.5 + c], [0.5 + c, 0.5]], torque)
        return [x[2], x[3], a[0], a[1]]

    motion = plan_motion(rate, start=[0, 0, 0, 0], end=[1, 0.8, 0, 0], seconds=2, u=[0, 0])
    goal, limits = [0.1, 0.1, 0.3, 0.3], [[-10, 10], [-6, 6]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits)


def climb() -> Written:
    """An airplane climbs 60 m in gusts; thrust that lags and lift, both limited."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # along, height in m, speed, path angle, thrust
        c, s = np.cos(x[3]), np.sin(x[3])
        slows = 9.81 * s + 1e-3 * x[2] ** 2
        turns = (u[1] - 9.81 * c) / x[2]
        return [x[2] * c + w[0], x[2] * s + w[1], x[4] - slows, turns, 2 * (u[0] - x[4])]

    start, end = [0, 0, 40, 0, 1.6], [400, 60, 40, 0, 1.6]
    motion = plan_motion(calm(rate, 2), start=start, end=end, seconds=10, u=[1.6, 9.81])
    goal, limits, gust = [8, 5, 3, 0.15, 1.5], [[-2, 8], [0, 20]], 2 * [[-0.5, 0.5]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits, uncertain=gust)


def vtol() -> Written:
    """A planar aircraft on its thrust, in gusts; thrust and turning acceleration are limited."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # position in m, tilt in rad, their rates
        side, up = w[0] - u[0] * np.sin(x[2]), u[0] * np.cos(x[2]) - 9.81 + w[1]
        return [*x[3:], side, up, u[1]]

    end, limits = [3, 1, 0, 0, 0, 0], [[2, 18], [-8, 8]]
    options: Any = {"start": np.zeros(6), "end": end, "seconds": 3, "u": [9.81, 0]}
    motion = plan_motion(calm(rate, 2), limits=limits, **options)
    goal, gust = [0.4, 0.4, 0.2, 0.6, 0.6, 0.6], 2 * [[-0.2, 0.2]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits, uncertain=gust)


def lane_change() -> Written:
    """A lane change at 20 m/s on tyres that saturate, in a side wind; the steering's rate."""

    def rate(x: Any, u: Any, w: Any) -> Any:  # across, heading, sideways speed, turn rate, steering
        front, rear = x[4] - (x[2] + 1.2 * x[3]) / 20, (1.4 * x[3] - x[2]) / 20
        f, r = (9 * np.sin(1.4 * np.arctan(10 * slip)) for slip in (front, rear))
        side, turn = (1.4 * f + 1.2 * r) / 2.6, 0.38 * (f - r)
        across = 20 * np.sin(x[1]) + x[2] * np.cos(x[1])
        return [across, x[3], side - 20 * x[3] + w[0], turn, u[0]]

    motion = plan_motion(calm(rate, 1), start=np.zeros(5), end=[3, 0, 0, 0, 0], seconds=3, u=[0])
    goal, limits, wind = [0.4, 0.08, 0.6, 0.3, 0.05], [[-0.6, 0.6]], [[-0.3, 0.3]]
    return rate, ContinuousTracking(rate, motion, goal=goal, limits=limits, uncertain=wind)


def segway() -> Written:
    """A pendulum on wheels with dry friction; the force is limited."""

    def rate(x: Any, u: Any) -> Any:  # position in m, tilt in rad, their rates
        c, s = 0.5 * np.cos(x[1]), np.sin(x[1])
        push = u[0] - 0.5 * np.tanh(x[2] / 0.1) + 0.5 * s * x[3] ** 2
        a = solve([[1.5, c], [c, 0.35]], [push, 4.9 * s - 0.5 * u[0]])
        return [x[2], x[3], a[0], a[1]]

    motion = plan_motion(rate, start=[0, 0, 0, 0], end=[1, 0, 0, 0], seconds=3, u=[0])
    return rate, ContinuousTracking(rate, motion, goal=[0.2, 0.1, 0.4, 0.4], limits=[[-8, 8]])


def bearing() -> Written:
    """A magnetic bearing, unstable and stiffening, held for 20 ms; the force is limited."""

    def rate(x: Any, u: Any) -> Any:  # displacement in mm, its rate
        return [x[1], 20 * x[0] + 40 * x[0] ** 3 + u[0]]

    motion = plan_motion(rate, start=[0.1, 0], end=[0, 0], seconds=1, u=[0])
    options: Any = {"limits": [[-20, 20]], "hold": 0.02}
    return rate, ContinuousTracking(rate, motion, goal=[0.05, 0.4], **options)


def ball_and_beam() -> Written:
    """A ball rolls on a beam whose turning acceleration is the input, limited."""

    def rate(x: Any, u: Any) -> Any:  # ball in m, beam in rad, their rates
        return [x[1], 5 / 7 * (x[0] * x[3] ** 2 - 9.81 * np.sin(x[2])), x[3], u[0]]

    motion = plan_motion(rate, start=[0.4, 0, 0, 0], end=[-0.2, 0, 0, 0], seconds=2, u=[0])
    return rate, ContinuousTracking(rate, motion, goal=[0.1, 0.2, 0.1, 0.4], limits=[[-15, 15]])


def maglev() -> Written:
    """A ball below a magnet, moved 4 mm up; the current follows a limited command with a lag."""

    def rate(x: Any, u: Any) -> Any:  # gap in m, its rate, current in A
        return [x[1], 9.81 - 9.81e-4 * (x[2] / x[0]) ** 2, 50 * (u[0] - x[2])]

    motion = plan_motion(rate, start=[0.012, 0, 1.2], end=[0.008, 0, 0.8], seconds=1, u=[1])
    return rate, ContinuousTracking(rate, motion, goal=[0.001, 0.02, 0.1], limits=[[0, 3]])


def quadrotor_12() -> Written:
    """A quadrotor flies a bend of 2 m and turns with it; thrust and turning accelerations."""

    def rate(x: Any, u: Any) -> Any:  # position, velocity, Euler angles, body rates
        (f, p, y), (a, b, c) = x[6:9], x[9:]
        sf, cf, sp, cp, sy, cy = np.sin(f), np.cos(f), np.sin(p), np.cos(p), np.sin(y), np.cos(y)
        push = [u[0] * (cf * sp * cy + sf * sy), u[0] * (cf * sp * sy - sf * cy)]
        angles = [a + (b * sf + c * cf) * sp / cp, b * cf - c * sf, (b * sf + c * cf) / cp]
        turn = [u[1] - 0.7 * b * c, u[2] + 0.7 * a * c, u[3]]
        return [*x[3:6], *push, u[0] * cf * cp - 9.81, *angles, *turn]

    start, end = np.zeros(12), np.zeros(12)
    start[3], end[:3], end[4], end[8] = 1, [2, 2, 0.5], 1, np.pi / 2
    motion = plan_motion(rate, start=start, end=end, seconds=4, u=[9.81, 0, 0, 0])
    goal = [0.2] * 3 + [0.4] * 3 + [0.2] * 3 + [1.0] * 3
    return rate, ContinuousTracking(rate, motion, goal=goal)


def calm(rate: Callable[..., Any], count: int) -> Callable[..., Any]:
    """The equations without their `count` disturbances, to plan with."""
    return lambda x, u: rate(x, u, np.zeros(count))


PROBLEMS: dict[str, Callable[[], Written]] = {
    "car": car,
    "bicycle": bicycle,
    "rocket": rocket,
    "acrobot": acrobot,
    "dubins_0.15": lambda: dubins(0.15),
    "dubins_0.5": lambda: dubins(0.5),
    "satellite": satellite,
    "van_der_pol": van_der_pol,
    "flexible_arm": flexible_arm,
    "quadrotor_9": quadrotor_9,
    "quadrotor_16": quadrotor_16,
    "docking": docking,
    "crane": crane,
    "differential_drive": differential_drive,
    "two_link_arm": two_link_arm,
    "climb": climb,
    "vtol": vtol,
    "lane_change": lane_change,
    "segway": segway,
    "bearing": bearing,
    "ball_and_beam": ball_and_beam,
    "maglev": maglev,
    "quadrotor_12": quadrotor_12,
}


class Truth(OneSet):
    """The equations as they are written, for simulations."""

    def __init__(self, function: Callable[..., Any], found: FunnelDesign, given: int) -> None:
        self.rates = Rates(function, found.model.n, found.model.m, np.zeros((given, 2)), (), ())
        self.uncertain = found.model.uncertain[:given]

    def __call__(
        self, t: float, X: ArrayLike, U: ArrayLike, W: ArrayLike | None, *, span: int | None
    ) -> FloatArray:
        """ẋ (N, n)."""
        del span
        return self.rates(t, X, U, W)


def lines_of(problem: Callable[..., Any]) -> int:
    """How many lines a user writes: the function's statements, without its docstring."""
    name = problem.__name__ if problem.__name__ != "<lambda>" else "dubins"
    source = inspect.getsource(globals()[name])
    return sum(bool(line.strip()) for line in source.splitlines()[2:])


def designed(
    make: Callable[[], ContinuousTracking], limit: float
) -> tuple[FunnelDesign | None, dict[str, Any]]:
    """The design if it is proved, and what is told; what `make` takes counts."""
    used, found, said = time.process_time(), None, {}
    try:
        with stopped_after(limit):
            found = design(make())
    except (NlsidError, OutOfTimeError) as refusal:
        said = {"said": str(refusal)}
    seconds = time.process_time() - used
    return found, {"proved": found is not None, "seconds": seconds} | said


def run(name: str, starts: int, limit: float) -> dict[str, Any]:
    """What became of one problem at the first try, and of its policy on a computer."""
    lines = {"lines": lines_of(PROBLEMS[name])}
    written: list[Written] = []

    def first() -> ContinuousTracking:
        written.append(PROBLEMS[name]())
        return written[0][1]

    found, told = designed(first, limit)
    if found is None:
        return told | lines
    function, problem = written[0]
    given = 0 if problem.uncertain is None else len(np.asarray(problem.uncertain))
    t, later = found.funnel.t, len(found.funnel.t) // 2
    told |= {
        "states": found.funnel.n,
        "knots": len(t),
        "pieces": len(found.found.proved.pieces),
        "half_widths_in_the_middle": found.funnel.widths(float(t[later])).tolist(),
        "half_widths_at_the_end": found.funnel.widths(float(t[-1])).tolist(),
    }
    told |= judged(function, found, given, starts)
    told["room"] = Simulation(Truth(function, found, given), found.policy, found.funnel).escape(
        found.found.goal.P, starts=starts // 8, rng=np.random.default_rng(5)
    )
    if found.model.m:  # without an input there is nothing to hold
        error = WRONG * np.asarray(problem.goal, dtype=np.float64)
        held, told["held"] = designed(lambda: replace(problem, hold="largest", error=error), limit)
        if held is not None:
            told["held"] |= judged(function, held, given, starts)
    return told | lines


def judged(
    function: Callable[..., Any], found: FunnelDesign, given: int, starts: int
) -> dict[str, Any]:
    """The proof decided again from its files, and starts on the boundary at t0 and later."""
    with tempfile.TemporaryDirectory() as folder:
        used = time.process_time()
        verdict = check(found.save(folder)[-1])
        check_seconds = time.process_time() - used
    truth, rng = Truth(function, found, given), np.random.default_rng(5)
    parts = truth, found.policy, found.funnel
    runs = []
    for knot, count in ((0, starts), (len(found.funnel.t) // 2, starts // 4)):
        at: dict[str, Any] = {"starts": count, "rng": rng, "knot": knot}
        if "hold" in found.claim:
            at["error"] = np.asarray(found.claim.get("error", np.zeros(found.model.n)))
            runs.append(Simulation(*parts).held(hold=found.claim["hold"], **at))
        else:
            runs.append(Simulation(*parts).boundary(substeps=SUBSTEPS, **at))
    return {key: found.claim[key] for key in ("hold", "error") if key in found.claim} | {
        "check_seconds": check_seconds,
        "margin": float(verdict.margin),
        "half_widths": found.funnel.widths(float(found.funnel.t[0])).tolist(),
        "starts": sum(r.starts for r in runs),
        "left": sum(r.violations for r in runs),
        "max_v": max(r.max_v for r in runs),
    }


def summary(results: dict[str, Any]) -> dict[str, Any]:
    """The figures over all problems that were tried, and what became of each."""
    held = [told["held"] for told in results.values() if "held" in told]
    rooms = [told["room"] for told in results.values() if "room" in told]
    return {
        "proved_first_try": sum(told["proved"] for told in results.values()),
        "of": len(results),
        "left": sum(told.get("left", 0) for told in results.values()),
        "median_room": float(np.median(rooms)) if rooms else None,
        "proved_held": sum(told["proved"] for told in held),
        "left_held": sum(told.get("left", 0) for told in held),
        "most_lines": max(told["lines"] for told in results.values()),
        "most_seconds": max(told["seconds"] for told in results.values()),
        "most_seconds_held": max((told["seconds"] for told in held), default=0.0),
    } | results


def main() -> None:
    """Print what became of each, and with --json one JSON object as the last line."""
    options = parser(__doc__)
    options.add_argument("--only", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    options.add_argument("--starts", type=int, default=4000)
    options.add_argument("--limit", type=float, default=LIMIT, help="s of processor time a design")
    options.add_argument("--out", type=Path, help="a file for the results, as they come")
    arguments = options.parse_args()
    results: dict[str, Any] = {}
    for name in arguments.only:
        results[name] = run(name, arguments.starts, arguments.limit)
        print(name, results[name], flush=True)
        if arguments.out is not None:
            written = json.dumps(summary(results), indent=1) + "\n"
            files.write_atomically(arguments.out, written.encode())
    tell(summary(results), as_json=arguments.json)


if __name__ == "__main__":
    main()
