"""Contracting scalar cells in a row, that saturate and flow over.

    z_i = φ_i(x_i) + g_i(x_{i-1}) + γ_i (z_{i-1} - m_{i-1})₊ + b_i·u,
    x_i⁺ = min(z_i, m_i),   y = x_c,   or with friction   y⁺ = rest + z_c - min(max(z_c, -h), h):
dry friction h as the implicit Euler method has it, with sticking (z_c is then a force times time).
φ_i, g_i are linear between equally spaced knots. Slopes of φ_i in [0, ρ] make every such cascade
stable: V = Σ w^i Δx_i² decreases at a rate near ρ for a small w, what a cell gets from those before
it being bounded. Inside these bounds the simulation error is minimised, z(0) of every trial free.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations_with_replacement, product

import numpy as np
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification.fit import Step
from nlsid_core.identification.network.fit import Minimum, Problem, Scaled, minimise, shortened
from nlsid_core.identification.network.lowering import network_of
from nlsid_core.identification.network.maps import DeadZone, Knotted, Limit, Limited, Top, rising
from nlsid_core.identification.network.options import CellRow, Network
from nlsid_core.identification.network.signals import NONE, Mapped, Signal, Signals, Taps, Trial
from nlsid_core.identification.trail import Task
from nlsid_core.models import CellNetwork

SMOOTHING = 1e-6  # of slopes of neighbouring intervals
POLES = (0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998)  # of the cells, at the start
LEAST_FRICTION = 1e-6
FRICTIONS = (0.1, 0.5)  # in spreads of y, what it takes from y at rest, at the start
TOPS = (1.0, 0.9, 0.75)  # quantiles of a hidden state at which it flows over, at the start
STARTS, KEPT = 3, 2  # combinations of poles; minima that are refined
START_SAMPLES, START_INTERVALS = 5000, 2
START_STEPS = 40  # 20 stop far from minima: test error 12.4 % in place of 11.5 % on F1TENTH
TOLERANCE = 1e-6
LIMITS: dict[int, Limit] = {1: Top(), 2: DeadZone()}  # by how many numbers they have


@dataclass(frozen=True, eq=False)
class Row:
    """Cells on knots (c, K+1), of q inputs, and where each cell's numbers are in θ.

    Numbers of a cell: level, phi (K,) slopes, b (q,), limit ([m] or [h, rest]); of all but the
    first g (K,) slopes too, and gamma where the cell before flows over.
    """

    knots: FloatArray
    inputs: int
    limit: str
    places: list[dict[str, IntArray]] = field(init=False)

    def __post_init__(self) -> None:
        cells, K = len(self.knots), self.knots.shape[1] - 1
        places, first = [], 0
        for i in range(cells):
            rubs = self.limit == "friction" and i + 1 == cells
            sizes = {"level": 1, "phi": K, "b": self.inputs}
            sizes["limit"] = 1 if self.limit == "top" else 2 * rubs
            sizes |= {"g": K} if i else {}
            sizes |= {"gamma": 1} if i and self.limit == "top" else {}
            cell = {}
            for name, size in sizes.items():
                cell[name] = np.arange(first, first + size)
                first += size
            places.append(cell)
        object.__setattr__(self, "places", places)

    @cached_property
    def built(self) -> tuple[Signals, list[int]]:
        """z_i(t - 1) of every cell as signals, and the numbers of x_i."""
        q, z_before = self.inputs, 0
        nodes: list[Signal | Mapped] = []
        x: list[int] = []
        for i, cell in enumerate(self.places):
            z, limit = q + 1 + len(nodes), LIMITS.get(len(cell["limit"]))
            after: list[Mapped] = [] if limit is None else [Mapped(z, limit, cell["limit"])]
            taps = [Taps(q, cell["level"], 1)]
            taps += [Taps(j, cell["b"][j : j + 1], 1) for j in range(q)]
            if i:
                taps.append(Taps(z - 1, NONE, 1))
            if "gamma" in cell:
                taps += [Taps(z_before, cell["gamma"]), Taps(x[-1], cell["gamma"], factor=-1.0)]
            z_before = z
            x.append(z + len(after))
            after.append(self._map(i, z, cell["phi"]))
            taps.append(Taps(z + len(after), NONE, 1))
            if i + 1 < len(self.knots):
                after.append(self._map(i, z, self.places[i + 1]["g"]))
            nodes += [Signal(tuple(taps), given=1), *after]
        return Signals(q, tuple(nodes), x[-1], free=True), x

    def function(self, i: int) -> Knotted:
        """A map of x_i."""
        return rising(self.knots[i, 0], self.knots[i, -1], self.knots.shape[1] - 1)

    def _map(self, i: int, z: int, slopes: IntArray) -> Mapped:
        """A map of x_i as one of z_i, whose number is z."""
        f, at_limit = self.function(i), self.places[i]["limit"]
        limit = LIMITS.get(len(at_limit))
        if limit is None:
            return Mapped(z, f, slopes)
        return Mapped(z, Limited(f, limit, len(slopes)), np.concatenate([slopes, at_limit]))

    def problem(self, trials: Sequence[Trial], slowest: float) -> Problem:
        """What is minimised, with slopes of φ_i in [0, slowest]."""
        size = self.built[0].parameters
        low, high = np.full(size, -np.inf), np.full(size, np.inf)
        bend = []
        for cell in self.places:
            low[cell["phi"]], high[cell["phi"]] = 0.0, slowest
            if len(cell["limit"]) == 2:
                low[cell["limit"][0]] = LEAST_FRICTION
            flow = cell.get("g", NONE)
            if "gamma" in cell:  # what flows over goes on as what does not
                low[cell["gamma"]] = 0.0
                flow = np.append(flow, cell["gamma"])
            for slopes in (cell["phi"], flow):
                bend += list(np.diff(np.eye(size)[slopes], axis=0))
        return Problem(self.built[0], trials, np.sqrt(SMOOTHING) * np.array(bend), (low, high))


Begun = tuple[Row, FloatArray, tuple[Trial, ...]]  # cells, their numbers, trials with starts


def cells_in_a_row(
    train: Dataset, model_class: Network[CellRow], task: Task
) -> tuple[CellNetwork, tuple[Step, ...]]:
    """A `CellNetwork` by simulation error, and the rms errors of the search's steps.

    Raises ShapeError for several outputs, DataError on too little or constant data.
    """
    made, slowest = model_class.structure, task.searched_rate
    scaled = Scaled.of(train, task.transient, model_class.start_samples)
    short = shortened(scaled.trials, START_SAMPLES)
    limits: list[tuple[float, ...]] = [()]
    if made.limit == "friction":
        limits = [(part,) for part in FRICTIONS]
    elif made.limit == "top":
        limits = list(product(TOPS, repeat=made.cells - 1))
    tried, steps = [], []
    begun: list[FloatArray] = []
    for poles in _best_poles(short, made.cells, slowest):
        for levels in limits:
            start = _start(short, poles, levels, made.limit, -scaled.y[0] / scaled.y[1])
            if any(np.allclose(start[1], known) for known in begun):
                continue  # such as two tops that no trial reaches
            begun.append(start[1])
            problem = start[0].problem(start[2], slowest)
            found = minimise(problem, start[1], steps=START_STEPS, tolerance=TOLERANCE)
            tried.append((start[0], found))
            named = ", ".join(f"{pole:g}" for pole in poles)
            steps.append(Step(f"poles {named}, {made.limit} {levels}", scaled.y[1] * found.rms))
    refined = []
    for row, found in sorted(tried, key=lambda entry: entry[1].rms)[:KEPT]:
        finer, theta, trials = _finer(row, found, scaled.trials, made.intervals)
        problem = finer.problem(trials, slowest)
        last = minimise(
            problem, theta, steps=task.wanted("sem_certified").iterations, tolerance=TOLERANCE
        )
        refined.append((finer, last))
        steps.append(Step(f"{made.intervals} intervals", scaled.y[1] * last.rms))
    row, best = min(refined, key=lambda entry: entry[1].rms)
    return (
        network_of(row.built[0], best, scaled, train, model_class.start_samples),
        tuple(steps),
    )


def _filtered(u: FloatArray, poles: Sequence[float]) -> list[FloatArray]:
    """u behind 1, 2, … filters of unit gain, each at rest under its first value."""
    outputs = []
    for pole in poles:
        u = u[:1] + lfilter([0.0, 1.0 - pole], [1.0, -pole], u - u[:1], axis=0)
        outputs.append(u)
    return outputs


def _gains(trials: Sequence[Trial], poles: Sequence[float]) -> tuple[float, FloatArray]:
    """(mean squared error, gains (q + 1,)) of the linear cascade with these poles, and offset."""
    columns = np.concatenate([_filtered(trial.u, poles)[-1] for trial in trials])
    columns = np.column_stack([columns, np.ones(len(columns))])
    y = np.concatenate([trial.y for trial in trials])
    gains = np.linalg.lstsq(columns, y, rcond=None)[0]
    return float(np.mean((columns @ gains - y) ** 2)), gains


def _best_poles(trials: Sequence[Trial], cells: int, slowest: float) -> list[tuple[float, ...]]:
    """The combinations of poles whose linear cascades fit best."""
    allowed = [pole for pole in POLES if pole < slowest] or [0.5 * slowest]
    combinations = list(combinations_with_replacement(allowed, cells))
    return sorted(combinations, key=lambda poles: _gains(trials, poles)[0])[:STARTS]


def _start(
    trials: Sequence[Trial],
    poles: Sequence[float],
    levels: Sequence[float],
    limit: str,
    still: float,
) -> Begun:
    """The linear cascade with these poles, hidden states in their spreads; still: y of 0."""
    cells, K = len(poles), START_INTERVALS
    _, gains = _gains(trials, poles)
    paths = [_filtered(trial.u @ gains[:-1, None], poles) for trial in trials]
    x = [np.concatenate([path[i][:, 0] for path in paths]) for i in range(cells)]
    spread = np.array([max(float(np.std(part)), 1e-3) for part in x])
    spread[-1] = 1.0
    x[-1] = np.concatenate([trial.y for trial in trials])
    x = [part / s for part, s in zip(x, spread, strict=True)]
    row = Row(np.array([_knots(part, K) for part in x]), len(gains) - 1, limit)
    theta = np.zeros(row.built[0].parameters)
    for i, (cell, pole) in enumerate(zip(row.places, poles, strict=True)):
        level = pole * row.knots[i, 0]
        theta[cell["phi"]] = pole
        if i == 0:
            theta[cell["b"]] = (1.0 - pole) * gains[:-1] / spread[0]
        else:
            gain = (1.0 - pole) * spread[i - 1] / spread[i]
            theta[cell["g"]] = gain
            level += gain * row.knots[i - 1, 0]
            if "gamma" in cell:
                theta[cell["gamma"]] = gain
        if i + 1 == cells:
            level += (1.0 - pole) * gains[-1]
        if limit == "top":
            theta[cell["limit"]] = np.quantile(x[i], (*levels, 1.0)[i])
        elif len(cell["limit"]):
            theta[cell["limit"]] = levels[0] * (1.0 - pole), still
            level -= still
        theta[cell["level"]] = level
    first = np.array([[path[i][0, 0] / spread[i] for i in range(cells)] for path in paths])
    return row, theta, _started(row, theta, trials, first)


def _started(
    row: Row, theta: FloatArray, trials: Sequence[Trial], z: FloatArray
) -> tuple[Trial, ...]:
    """The trials from z (trials, c), where the last cell gives the first output."""
    begun, limit = [], row.places[-1]["limit"]
    for trial, start in zip(trials, z, strict=True):
        start = np.append(start[:-1], trial.y[0])
        if row.limit == "friction":
            start[-1] += np.copysign(theta[limit[0]], start[-1] - theta[limit[1]]) - theta[limit[1]]
        begun.append(replace(trial, start=start))
    return tuple(begun)


def _knots(x: FloatArray, intervals: int) -> FloatArray:
    """Equally spaced over the range of x, which is not a point."""
    middle, half = 0.5 * (x.min() + x.max()), max(0.5 * float(np.ptp(x)), 1e-3)
    return np.linspace(middle - half, middle + half, intervals + 1)


def _finer(row: Row, found: Minimum, trials: Sequence[Trial], intervals: int) -> Begun:
    """About the same maps on `intervals` intervals over the states that all trials visit.

    A trial that was not fitted starts from the mean of those that were.
    """
    theta, known = found.parameters, np.array([trial.start for trial in found.trials])
    z = np.tile(known.mean(axis=0), (len(trials), 1))
    begun = [*found.trials, *_started(row, theta, trials, z)[len(known) :]]
    begun = [replace(trial, start=b.start) for trial, b in zip(trials, begun, strict=True)]
    signals, of_x = row.built
    runs = [signals.run(theta, trial) for trial in begun]
    x = [np.concatenate([run[source] for run in runs]) for source in of_x]
    x[-1] = np.concatenate([trial.y for trial in trials])
    finer = Row(np.array([_knots(part, intervals) for part in x]), row.inputs, row.limit)
    moved = np.zeros(finer.built[0].parameters)
    for i, (cell, old) in enumerate(zip(finer.places, row.places, strict=True)):
        for name in ("level", "b", "limit", "gamma"):
            if name in cell:
                moved[cell[name]] = theta[old[name]]
        for name, of in (("phi", i), ("g", i - 1)):
            if name in cell:
                values = row.function(of).values(theta[old[name]], finer.knots[of])
                moved[cell["level"]] += values[0]
                moved[cell[name]] = np.diff(values) / np.diff(finer.knots[of])
    return finer, moved, tuple(begun)
