"""Reachability problems that other tools have published figures of, as funnels without an input.

    python -m benchmarks.reachability [--json] [--only NAME ...] [--starts N] [--limit S]

Such a tool carries a box forward and says how wide it has become. A funnel goes backward from a
goal, so the goal is made wider or narrower, in its own proportions, until the proved inlet just
holds the box; all designs count in `seconds` (of the processor). `width` is the funnel's at the
end, `spread` that of simulated solutions from the box's corners and from random points of it: no
sound answer is below that. `left` counts the solutions that left the funnel.

Laub-Loomis, Lotka-Volterra and the rendezvous (LALO20, LOVO20, SPRE20) are as in Geretti et al.,
ARCH-COMP20 Category Report: Continuous and Hybrid Systems with Nonlinear Dynamics, 2020.
Lotka-Volterra's modes inside and outside of a circle have the same equations but for a counter,
which is left out here. Of the rendezvous, whose mode changes at x = -100 m, there is the first
mode, for 100 min. `highest` is what the tube allows the state whose width is told, at 200 moments.
"""

import argparse
import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import fsolve

from benchmarks.first_try import designed, show
from benchmarks.machine import describe
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, FunnelDesign, integrate_nominal

LIMIT = 120.0  # s of processor time for one design
SIZES = 5  # of the goal that are tried at most
ROOM = 1.03  # over the size that should just do: the inlet's size is not quite proportional
TIGHT = 0.9  # of V = 1 that a corner of the box reaches: then no narrower goal is tried
TOLERANCE = 1e-9  # of solutions, relative
MOMENTS = 200  # at which solutions are compared with the funnel


@dataclass(frozen=True)
class Reachability:
    """ẋ = rate(x) from the box start ± half over `seconds`.

    goal: (n, n) the matrix that the search begins with. output: of which the width is told. power:
    knots lie at seconds·(k/K)^power. Q: (n, n) by how much |x|²_goal falls at the end (None: the
    default). published: tool -> figures and where they are from.
    """

    rate: Callable[[Any], Any]
    start: tuple[float, ...]
    half: tuple[float, ...]
    seconds: float
    goal: FloatArray
    output: int
    knots: int
    power: float = 1.0
    Q: FloatArray | None = None
    published: dict[str, dict[str, Any]] = field(default_factory=dict)

    def tracking(self, size: float) -> ContinuousTracking:
        """What a user writes, with a goal of this size."""
        times = self.seconds * np.linspace(0, 1, self.knots) ** self.power
        motion = integrate_nominal(self.rate, lambda _: np.zeros(0), t=times, start=self.start)
        Q = None if self.Q is None else self.Q / size**2
        return ContinuousTracking(self.rate, motion, goal=self.goal / size**2, Q=Q)

    def corners(self) -> FloatArray:
        """(N, n), every corner of the box once."""
        sides = [sorted({x - r, x + r}) for x, r in zip(self.start, self.half, strict=True)]
        return np.array(list(itertools.product(*sides)))

    def solutions(self, starts: FloatArray, t: FloatArray) -> FloatArray:
        """(len(t), N, n) from starts (N, n), by another integrator than the designs'."""

        def rates(_: float, flat: FloatArray) -> FloatArray:
            return np.ravel(np.array(self.rate(flat.reshape(starts.shape).T)).T)

        found = solve_ivp(
            rates, (0.0, self.seconds), starts.ravel(), "DOP853", t_eval=t,
            rtol=TOLERANCE, atol=1e-3 * TOLERANCE,
        )  # fmt: skip
        return np.asarray(found.y.T).reshape(len(t), *starts.shape)


def laub_loomis(x: Any) -> list[Any]:
    """Enzymes of a cell that signals; seven concentrations."""
    return [
        1.4 * x[2] - 0.9 * x[0],
        2.5 * x[4] - 1.5 * x[1],
        0.6 * x[6] - 0.8 * x[1] * x[2],
        2 - 1.3 * x[2] * x[3],
        0.7 * x[0] - x[3] * x[4],
        0.3 * x[0] - 3.1 * x[5],
        1.8 * x[5] - 1.5 * x[1] * x[6],
    ]  # fmt: skip


def lotka_volterra(x: Any) -> list[Any]:
    """Prey and those who eat it, once around their equilibrium."""
    return [3 * x[0] - 3 * x[0] * x[1], x[0] * x[1] - x[1]]


MU, R, MASS = 3.986e14 * 60**2, 42164e3, 500.0  # m³/min², m, kg
N = (MU / R**3) ** 0.5  # 1/min, of the target's orbit
GAIN = np.array([[-28.8287, 0.1005, -1449.9754, 0.0046], [-0.087, -33.2562, 0.00462, -1451.5013]])


def approach(x: Any) -> list[Any]:
    """A spacecraft under its controller, seen from its target: two positions in m, two speeds."""
    u = [sum(k * s for k, s in zip(row, x, strict=True)) / MASS for row in GAIN.tolist()]
    pull = MU / np.sqrt((R + x[0]) ** 2 + x[1] ** 2) ** 3
    along = N**2 * x[0] + 2 * N * x[3] + MU / R**2 - pull * (R + x[0]) + u[0]
    return [x[2], x[3], along, N**2 * x[1] - 2 * N * x[2] - pull * x[1] + u[1]]


FLOW = {
    "Flow* 2.1.0": {
        "seconds": 18.0,
        "width": None,
        "year": 2017,
        "source": "flowstar.org, example Laub-Loomis; its computer is not named, nor the widths",
    }
}


def falling(
    rate: Callable[[Any], Any], x: FloatArray, widths: list[float], spare: float
) -> tuple[FloatArray, FloatArray]:
    """P and Q with -d|x|²_P/dt = |x|²_Q in the linearisation at x; |x|²_P also falls by twice
    `spare` (1/s) of itself. widths: half-widths in which |x|²_Q is about one."""
    n, step = len(x), 1e-30
    A = np.array([np.imag(rate(x + 1j * step * e)) for e in np.eye(n)]).T / step
    D = np.diag(np.array(widths) ** -2)
    P = solve_continuous_lyapunov((A + spare * np.eye(n)).T, -D)
    P = (P + P.T) / 2
    return P, D + 2 * spare * P


def laub(half: float) -> Reachability:
    """LALO20 from a box of this half-width in every state."""
    start = (1.2, 1.05, 1.5, 2.4, 1.0, 0.1, 0.45)
    rest = fsolve(laub_loomis, start)
    widths = [0.8, 1.2, 0.7, 2.0, 0.6, 0.15, 0.4]
    P, Q = falling(laub_loomis, rest, [half * width for width in widths], 0.06)
    return Reachability(
        laub_loomis, start, (half,) * 7, 20.0, P, 3, 101, 1.3, Q, FLOW if half == 0.1 else {}
    )


def rendezvous() -> Reachability:
    """SPRE20's approach; its seconds are minutes."""
    P, Q = falling(approach, np.zeros(4), [60.0, 60.0, 25.0, 25.0], 0.0)
    start, half = (-900.0, -400.0, 0.0, 0.0), (25.0, 25.0, 0.0, 0.0)
    return Reachability(approach, start, half, 100.0, P, 0, 61, 2.0, Q)


PROBLEMS: dict[str, Reachability] = {
    "laub_loomis_0.01": laub(0.01),
    "laub_loomis_0.05": laub(0.05),
    "laub_loomis_0.1": laub(0.1),
    "lotka_volterra": Reachability(
        lotka_volterra, (1.3, 1.0), (0.008, 0.0), 3.64, 1e4 * np.diag([1.0, 3.0]), 0, 61
    ),
    "rendezvous": rendezvous(),
}


def holding(problem: Reachability, limit: float) -> tuple[FunnelDesign | None, dict[str, Any]]:
    """The narrowest funnel found whose inlet holds the box.

    told: seconds and number of all designs, and if there is none that does, why.
    """
    size, best, narrowest = 1.0, None, np.inf
    told: dict[str, Any] = {"seconds": 0.0, "designs": 0}
    for _ in range(SIZES):
        found, said = designed(lambda: problem.tracking(size), limit)  # noqa: B023
        told["seconds"] += said["seconds"]
        told["designs"] += 1
        if found is None:
            told["said"] = said["said"]
            break
        reached = float(np.max(found.funnel.value(0.0, problem.corners())))
        if reached <= 1 and size < narrowest:
            best, narrowest = found, size
        elif best is None:
            told["said"] = f"a corner of the box is at V = {reached:.3g}, outside of the inlet"
        if TIGHT <= reached <= 1:
            break
        size *= ROOM * reached**0.5
    if best is not None:
        told.pop("said", None)
    return best, told


def run(problem: Reachability, starts: int, limit: float) -> dict[str, Any]:
    """What became of one problem."""
    found, told = holding(problem, limit)
    t = np.linspace(0, problem.seconds, MOMENTS)
    rng, centre, half = np.random.default_rng(0), np.array(problem.start), np.array(problem.half)
    inside = centre + half * rng.uniform(-1, 1, size=(starts, len(half)))
    X = problem.solutions(np.vstack([problem.corners(), inside]), t)
    result = {
        "proved": found is not None,
        "states": len(problem.start),
        "spread": float(np.ptp(X[-1, :, problem.output])),
        "published": problem.published,
    } | told
    if found is None:
        return result
    V = np.array([found.funnel.value(float(s), x) for s, x in zip(t, X, strict=True)])
    edges = [found.funnel.nominal(s) + found.funnel.widths(s) for s in t.tolist()]
    return result | {
        "highest": float(np.max([edge[problem.output] for edge in edges])),
        "width": float(2 * found.funnel.widths(problem.seconds)[problem.output]),
        "starts": V.shape[1],
        "left": int((V > 1 + 1e-6).any(axis=0).sum()),
        "max_v": float(V.max()),
    }


def main() -> None:
    """Print what became of each, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--limit", type=float, default=LIMIT, help="s of processor time a design")
    arguments = parser.parse_args()
    print(describe(), flush=True)
    results: dict[str, Any] = {}
    for name in arguments.only:
        results[name] = run(PROBLEMS[name], arguments.starts, arguments.limit)
        print(f"\n{name}")
        show(results[name])
    if arguments.json:
        print(json.dumps({"proved": sum(r["proved"] for r in results.values())} | results))


if __name__ == "__main__":
    main()
