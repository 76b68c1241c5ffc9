"""A follower: what goes after its command, as fast as it can.

    y(t) - y(t-1) = a (y(t-1) - y(t-2)) + f(e(t-1)),    e(t) = K u(t-d) + C - y(t),
f increasing, linear between knots and flatter where the speed has a limit. In e alone it is one
signal with a map of its own past,
    e(t) = (1+a) e(t-1) - a e(t-2) - f(e(t-1)) + K (u(t-d) - (1+a) u(t-d-1) + a u(t-d-2)).
With slopes of f between (1-a)(1-ρ) and (1-a)² one quadratic form decreases for all of them: the
circle criterion of z/((z-1)(z-a)). Inside these bounds the simulation error is minimised, e(0) and
e(1) of every trial free, for some a and d each; the best are refined.
Source: the circle criterion, Zames 1966; a straight f begins as Bussgang's theorem (1952) allows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible, ShapeError
from nlsid_core.identification.fit import Step
from nlsid_core.identification.network.cells import SMOOTHING, TOLERANCE
from nlsid_core.identification.network.fit import Minimum, Problem, Scaled, minimise, shortened
from nlsid_core.identification.network.lowering import network_of
from nlsid_core.identification.network.maps import Knotted, rising
from nlsid_core.identification.network.options import Follower, Network
from nlsid_core.identification.network.signals import (
    NONE,
    Mapped,
    Signal,
    Signals,
    Taps,
    Trial,
    delayed,
)
from nlsid_core.identification.trail import Task
from nlsid_core.models import CellNetwork

INERTIAS = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9)  # a
MOST_DELAY = 10  # samples
INSIDE = 0.98  # of the circle criterion's slope: the proof has room
HALF = 0.5  # of the largest slope, which the least one is below
START_SAMPLES, START_STEPS = 3000, 12
KEPT = 2  # of a and d, refined
WIDTHS = (8, 4, 2, 1, 1, 1, 1, 2, 4, 8)  # of the intervals of f, on a grid
GAIN, LEVEL, FLOW = np.array([0]), np.array([1]), np.array([2])  # K, C and f at its first knot


def _unit() -> Knotted:
    """Over [-1, 1], the numbers being the slopes of intervals that are narrow around zero."""
    grid = rising(-1.0, 1.0, sum(WIDTHS))
    grouped = np.repeat(np.eye(len(WIDTHS)), WIDTHS, axis=0)
    return Knotted(-1.0, grid.spacing, grid.rows @ grouped)


UNIT = _unit()


@dataclass(frozen=True, eq=False)
class Loop:
    """The follower with this a and d, and the knots of f.

    θ = [K, C, f at the first knot, its slopes].
    """

    a: float
    delay: int
    f: Knotted

    @property
    def slopes(self) -> IntArray:
        """Where the slopes of f are in θ."""
        return 3 + np.arange(self.f.rows.shape[1])

    @property
    def signals(self) -> Signals:
        """u delayed, e, f of it, and y."""
        one, late, e, f = 1, 2, 3, 4
        inertia = (Taps(e, NONE, 1, 1.0 + self.a), Taps(e, NONE, 2, -self.a))
        flow = (Taps(f, NONE, 1, -1.0), Taps(one, FLOW, 0, -1.0))
        weights = enumerate((1.0, -1.0 - self.a, self.a))
        command = (Taps(late, GAIN, k, weight) for k, weight in weights)
        nodes = (
            Signal((Taps(0, NONE, self.delay),)),
            Signal((*inertia, *flow, *command), given=2),
            Mapped(e, self.f, self.slopes),
            Signal((Taps(late, GAIN), Taps(one, LEVEL), Taps(e, NONE, 0, -1.0))),
        )
        return Signals(1, nodes, 5, free=True)

    def errors(self, theta: FloatArray, trial: Trial) -> FloatArray:
        """e (N,) of the measured outputs."""
        late = delayed(trial.u[:, 0], self.delay, trial)
        return np.asarray(theta[0] * late + theta[1] - trial.y)

    def fitted(
        self, theta: FloatArray, trials: Sequence[Trial], slowest: float, steps: int
    ) -> Minimum:
        """The minimum from θ and the trials' starts."""
        low, high = np.full(len(theta), -np.inf), np.full(len(theta), np.inf)
        low[self.slopes] = (1.0 - self.a) * (1.0 - slowest)
        high[self.slopes] = INSIDE * (1.0 - self.a) ** 2
        bend = np.sqrt(SMOOTHING) * np.diff(np.eye(len(theta))[self.slopes], axis=0)
        problem = Problem(self.signals, trials, bend, (low, high))
        return minimise(problem, theta, steps=steps, tolerance=TOLERANCE)


def follower(
    train: Dataset, model_class: Network[Follower], task: Task
) -> tuple[CellNetwork, tuple[Step, ...]]:
    """A `CellNetwork` by simulation error, and the rms errors of the search's steps.

    Raises ShapeError for several signals, DataError on too little or constant data.
    """
    if train.trajectories[0].u.shape[1] != 1:
        raise ShapeError("a follower has one input")
    slowest = task.searched_rate
    scaled = Scaled.of(train, task.transient, model_class.start_samples)
    trials = [replace(trial, held=True) for trial in scaled.trials]
    short = shortened(trials, START_SAMPLES)
    late = min(range(MOST_DELAY + 1), key=lambda delay: _start(INERTIAS[0], delay, short)[3])
    tried, steps = [], []
    for a in INERTIAS:
        if 1.0 - slowest > HALF * (1.0 - a):
            break  # the slopes' bounds leave nothing
        least = np.inf
        while late >= 0:
            loop, theta, begun, _ = _start(a, late, short)
            found = loop.fitted(theta, begun, slowest, START_STEPS)
            tried.append((loop, found))
            steps.append(Step(f"a = {a:g}, {late} samples late", scaled.y[1] * found.rms))
            if found.rms >= least:
                break
            least, late = found.rms, late - 1
        late += 1  # more of the lag is inertia
    if not tried:
        raise Infeasible("no follower keeps to so small a max_rate; give a larger one")
    refined = []
    for loop, found in sorted(tried, key=lambda entry: entry[1].rms)[:KEPT]:
        begun = [replace(t, start=loop.errors(found.parameters, t)[:2]) for t in trials]
        last = loop.fitted(
            found.parameters, begun, slowest, task.wanted("sem_certified").iterations
        )
        refined.append((loop, last))
        steps.append(Step("of all samples", scaled.y[1] * last.rms))
    loop, best = min(refined, key=lambda entry: entry[1].rms)
    return (
        network_of(loop.signals, best, scaled, train, model_class.start_samples),
        tuple(steps),
    )


def _start(
    a: float, delay: int, trials: Sequence[Trial]
) -> tuple[Loop, FloatArray, list[Trial], float]:
    """A follower, its numbers, trials with starts, and what of the speeds it leaves unexplained.

    Whatever increasing f the data come from, least squares with a straight one find K and C.
    """
    rows, speeds = [], []
    for trial in trials:
        u, y = delayed(trial.u[:, 0], delay, trial), trial.y
        rows.append(np.column_stack([u, y, np.ones(len(y))])[1:-1])
        speeds.append(np.diff(y)[1:] - a * np.diff(y)[:-1])
    every, speed = np.concatenate(rows), np.concatenate(speeds)
    of_u, of_y, flow = np.linalg.lstsq(every, speed, rcond=None)[0]
    left = float(np.mean((every @ [of_u, of_y, flow] - speed) ** 2) / np.mean(speed**2))
    slope = max(-of_y, 1e-3)
    theta = np.array([of_u / slope, flow / slope, 0.0])
    loop = Loop(a, delay, UNIT)
    errors = [loop.errors(theta, trial) for trial in trials]
    half = max(float(np.abs(np.concatenate(errors)).max()), 1e-3)
    loop = replace(loop, f=Knotted(-half, half / sum(WIDTHS) * 2.0, half * UNIT.rows))
    theta = np.concatenate([theta, np.full(len(WIDTHS), slope)])
    theta[2] = -half * slope
    begun = [replace(trial, start=e[:2]) for trial, e in zip(trials, errors, strict=True)]
    return loop, theta, begun, left
