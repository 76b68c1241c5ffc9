"""A filter with feedback through a static map, unrolled until it is proved.

    y = c + Σ a_k y_-k + Σ b_k u_-k + Σ e_k φ(y_-k)
(Lur'e), fitted by simulation error, is a `CellNetwork` whose one map stands in a loop. It is stable
for every input only where its damping is large beside the slopes of φ. Elsewhere it is unrolled,
    y_0 = G_0 u,    y_s = G_s u + H_s φ_s(y_{s-1}),    s = 1 … K:
stable filters in a row are stable whatever the maps are. The stages imitate the loop on inputs that
nobody recorded, phases drawn at random and sizes beyond those of the trials, and on the trials; a
loop that answers a stronger input well thus hands that on.
Source: Picard's iteration, whose truncated form is a Volterra series (Boyd and Chua 1985).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, counted
from nlsid_core.identification.fit import Proof, Step
from nlsid_core.identification.network.fit import (
    MAX_RADIUS,
    Minimum,
    Problem,
    Scaled,
    minimise,
    shortened,
)
from nlsid_core.identification.network.lowering import network_of
from nlsid_core.identification.network.maps import Knotted, Smooth
from nlsid_core.identification.network.options import Feedback, Network
from nlsid_core.identification.network.signals import (
    DIVERGED,
    Mapped,
    Signal,
    Signals,
    Taps,
    Trial,
    delayed,
)
from nlsid_core.identification.proofs.stability import prove_stability
from nlsid_core.identification.starts import autoregression, reflected
from nlsid_core.identification.trail import Task
from nlsid_core.models import CellNetwork

SHAPES: tuple[Callable[[FloatArray], FloatArray], ...] = (  # of φ at the start, y in its range
    lambda y: y**3,
    lambda y: y**2,
    lambda y: np.tanh(4.0 * y),
)
KNOTS = 48  # intervals of the piecewise linear map, whatever the spline's
ROOM = 1.3  # times the range of y: where the maps end, and the largest of the inputs imitated
SIZES = (0.9, 1.5)  # of these inputs, in those of the trials
LENGTH = 500  # samples of an input that is imitated
FITTED = 30_000  # samples of the trials that the stages are fitted to, beside them
LOOP_STEPS, LOOP_TOLERANCE = 60, 1e-4
TOLERANCE = 2e-3  # relative gain of a step of the stages


@dataclass(frozen=True, eq=False)
class Layout:
    """n lags, q inputs, and the map: linear between knots on a spline of J numbers, constant
    beyond.
    """

    n: int
    q: int
    f: Knotted

    @classmethod
    def of(cls, made: Feedback, trials: Sequence[Trial]) -> "Layout":
        """The map reaches beyond the outputs by ROOM."""
        y = np.concatenate([trial.y for trial in trials])
        half, middle = 0.5 * float(np.ptp(y)), 0.5 * float(y.max() + y.min())
        low, high = middle - ROOM * half, middle + ROOM * half
        size = made.intervals + 3
        spline = Smooth(low, (high - low) / made.intervals, made.intervals)
        rows = spline.moves(np.zeros(size), np.linspace(low, high, KNOTS + 1)).T
        spacing = (high - low) / KNOTS
        ends = np.concatenate([rows[:1], rows, rows[-1:]])
        return cls(made.lags, trials[0].u.shape[1], Knotted(low - spacing, spacing, ends))

    def loop(self) -> Signals:
        """θ = [a, b of every input, c, e, φ]."""
        y = self.q + 1
        taps, at = self._filter(y, 0)
        e = at + np.arange(self.n)
        phi = at + self.n + np.arange(self.f.rows.shape[1])
        signal = Signal((*taps, Taps(y + 1, e, 1)), self.n)
        return Signals(self.q, (signal, Mapped(y, self.f, phi)), y, free=True)

    def stages(self, maps: int) -> Signals:
        """θ = [a, b, c] of the first, then [a, b, c, e, φ] of every other one."""
        y = self.q + 1
        taps, at = self._filter(y, 0)
        nodes: list[Signal | Mapped] = [Signal(tuple(taps), self.n)]
        for _ in range(maps):
            taps, end = self._filter(y + 2, at)
            e = end + np.arange(self.n + 1)
            phi = end + self.n + 1 + np.arange(self.f.rows.shape[1])
            nodes.append(Mapped(y, self.f, phi))
            nodes.append(Signal((*taps, Taps(y + 1, e)), self.n))
            y, at = y + 2, int(phi[-1]) + 1
        return Signals(self.q, tuple(nodes), y)

    def _filter(self, signal: int, at: int) -> tuple[list[Taps], int]:
        """The filter of a signal whose numbers begin `at`, and where they end."""
        n, q = self.n, self.q
        b = at + n + np.arange((n + 1) * q).reshape(q, n + 1)
        end = at + n + b.size
        taps = [Taps(signal, at + np.arange(n), 1), Taps(q, np.array([end]))]
        return [*taps, *(Taps(j, row) for j, row in enumerate(b))], end + 1


def _loop(made: Feedback, trials: Sequence[Trial]) -> tuple[Layout, Minimum]:
    """The best of the minima from the equation errors with a few maps.

    Raises Infeasible if there is none that does not diverge.
    """
    layout, n = Layout.of(made, trials), made.lags
    y = np.concatenate([trial.y for trial in trials])
    half, middle = 0.5 * np.ptp(y), 0.5 * (y.max() + y.min())
    knots = layout.f.knots(np.zeros(0))
    begun, found = [replace(trial, start=trial.y[:n]) for trial in trials], []
    for shape in SHAPES:
        values = shape((knots - middle) / half)[1:-1]
        phi = np.linalg.lstsq(layout.f.rows[1:-1], values, rcond=None)[0]
        rows = []
        for trial in begun:
            mapped = layout.f.values(phi, trial.y)
            columns = [delayed(trial.y, k, trial) for k in range(1, n + 1)]
            columns += [delayed(u, k, trial) for u in trial.u.T for k in range(n + 1)]
            columns += [np.ones(len(trial.y))]
            columns += [delayed(mapped, k, trial) for k in range(1, n + 1)]
            rows.append(np.array(columns)[:, n:].T)
        outputs = np.concatenate([trial.y[n:] for trial in begun])
        start = np.linalg.lstsq(np.concatenate(rows), outputs, rcond=None)[0]
        theta = np.concatenate([start, phi])
        problem = Problem(layout.loop(), begun, np.zeros((0, len(theta))))
        found.append(minimise(problem, theta, steps=LOOP_STEPS, tolerance=LOOP_TOLERANCE))
    best = min(found, key=lambda minimum: minimum.rms)
    if not best.rms < 1.0:
        raise Infeasible("no feedback through a map explains the data; give richer data or lags")
    return layout, best


def _imitated(layout: Layout, loop: Minimum, count: int, rng: np.random.Generator) -> list[Trial]:
    """What the loop makes of inputs like those of the trials: every other one is as recorded, but
    larger or smaller; of the others the phases are drawn at random, the same for all inputs.
    """
    made, n, signals = [], layout.n, layout.loop()
    knots = layout.f.knots(np.zeros(0))
    middle, largest = 0.5 * (knots[0] + knots[-1]), ROOM * 0.5 * (knots[-2] - knots[1])
    for k in range(count):
        trial = loop.trials[int(rng.integers(len(loop.trials)))]
        first = int(rng.integers(max(1, len(trial.y) - LENGTH)))
        part, start = trial.u[first : first + LENGTH], trial.y[first : first + n]
        if k % 2:
            spectrum = np.fft.rfft(part, axis=0)
            turned = np.exp(2j * np.pi * rng.uniform(size=(len(spectrum), 1)))
            turned[0] = 1.0
            part = np.fft.irfft(spectrum * turned, len(part), axis=0)
        one = Trial(part * rng.uniform(*SIZES), part[:, 0], start, n)
        y = signals.run(loop.parameters, one)[signals.output]
        if np.abs(y - middle).max() < min(largest, DIVERGED):
            made.append(replace(one, y=y))
    return made


def feedback_unrolled(
    train: Dataset, model_class: Network[Feedback], task: Task
) -> tuple[CellNetwork, tuple[Step, ...]]:
    """A `CellNetwork` that can be proved, and the rms errors of more and more stages.

    Raises DataError or ShapeError on data that cannot be used, Infeasible if nothing is found.
    """
    made, slowest = model_class.structure, min(MAX_RADIUS, task.searched_rate)
    scaled = Scaled.of(train, task.transient, model_class.start_samples)
    layout, loop = _loop(made, scaled.trials)
    whole = network_of(layout.loop(), loop, scaled, train, model_class.start_samples)
    proof: Proof | None = prove_stability(whole)
    if proof is not None and proof.rate <= slowest:
        return whole, (Step("the loop itself", scaled.y[1] * loop.rms),)
    task.progress("feedback fitted", 0.2)
    known = _known(layout, loop, model_class)
    theta = _linear(known, layout, slowest)
    further = _as_stage(loop.parameters, layout, slowest)
    steps = []
    for maps in range(1, made.stages + 1):
        problem = _stages(layout, maps, known, slowest)
        theta = minimise(
            problem,
            np.concatenate([theta, further]),
            steps=task.wanted("sem_certified").iterations,
            tolerance=TOLERANCE,
        ).parameters
        further = theta[-len(further) :]
        every = _stages(layout, maps, loop.trials, slowest)
        error = every.mean_square(theta) ** 0.5
        steps.append(Step(counted(maps, "map"), scaled.y[1] * error))
        task.progress(steps[-1].what, 0.2 + 0.8 * maps / made.stages)
    found = Minimum(error, theta, tuple(every.trials))
    return (
        network_of(every.signals, found, scaled, train, model_class.start_samples),
        tuple(steps),
    )


def _stages(layout: Layout, maps: int, trials: Sequence[Trial], radius: float) -> Problem:
    """The stages on these trials, all with the same first samples."""
    signals = layout.stages(maps)
    begun = [replace(t, start=np.tile(t.start, maps + 1)) for t in trials]
    return Problem(signals, begun, np.zeros((0, signals.parameters)), radius=radius)


def _known(layout: Layout, loop: Minimum, model_class: Network[Feedback]) -> list[Trial]:
    """What stages are fitted to: trials, and what the loop makes of inputs that nobody recorded."""
    rng = np.random.default_rng(model_class.seed)
    imitated = _imitated(layout, loop, model_class.structure.imitated, rng)
    return [*shortened(loop.trials, FITTED), *imitated]


def _linear(known: Sequence[Trial], layout: Layout, radius: float) -> FloatArray:
    """The numbers of the first stage, by least squares."""
    found = autoregression([(t.y[:, None], t.u) for t in known], layout.n)
    if found is None:
        raise DataError(f"too few samples for {layout.n} lags; give more data")
    a, b = found[0][:, 0, 0], found[1][:, 0, :]
    return np.concatenate([_within(a, radius), b.T.ravel(), [0.0]])


def _as_stage(theta: FloatArray, layout: Layout, radius: float) -> FloatArray:
    """The loop's numbers as those of a stage: its filter stable, e of no delay zero."""
    n, first_e = layout.n, layout.n + (layout.n + 1) * layout.q + 1
    return np.concatenate([_within(theta[:n], radius), theta[n:first_e], [0.0], theta[first_e:]])


def _within(a: FloatArray, radius: float) -> FloatArray:
    """The coefficients with poles outside the circle reflected, and slower ones at the radius."""
    theta = reflected(np.concatenate([[1.0], -a]), 0.999 * radius)
    return np.asarray(-theta[1:] / theta[0])
