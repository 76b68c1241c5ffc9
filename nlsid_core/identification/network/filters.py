"""A filter, a static map, a filter, found by simulation error from random starts.

    x_j = B1_j/A1 u,    y = Σ_j B2_j/A2 f(x_j),    j = 0 … phases - 1

Random starts on a part of the data, then all of it with more and more knots. `BlockCascade` says
what the phases are.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.fit import Step
from nlsid_core.identification.network.fit import (
    MAX_RADIUS,
    Minimum,
    Problem,
    Scaled,
    best_for,
    minimise,
    shortened,
)
from nlsid_core.identification.network.maps import Smooth
from nlsid_core.identification.network.options import FilterMapFilter, Network
from nlsid_core.identification.network.signals import Mapped, Signal, Signals, Taps, Trial
from nlsid_core.identification.regressors import signal_scale
from nlsid_core.identification.trail import Task
from nlsid_core.models import BlockCascade, Spline, signals_of

STEPS, TOLERANCE = 40, 1e-3  # with fewer knots
FINAL_STEPS, FINAL_TOLERANCE = 40, 1e-5
SMOOTHING = 1e-8  # of the spline
SCREENED_SAMPLES, START_SAMPLES = 2000, 10_000  # for the starts
START_INTERVALS = 12
FEWEST_INTERVALS = 6  # of a map that is refined
SCREENING_STEPS, START_STEPS = 20, 60
REMEMBERED = 16  # of the best starts
KEPT_STARTS = 3  # of the screened ones, minimised further
POLE_RADII = (0.5, 0.95)
POLE_ANGLES = (0.1, 1.5)  # rad a sample: a filter that passes something of a sampled signal
MARGIN = 0.02  # of the range of x beyond the outer data on each side
RIDGE = 1e-6  # of the mean curvature: knots without data stay near zero
FINE = 40  # points an interval at which one spline is fitted to another


@dataclass(frozen=True, eq=False)
class Cascade:
    """θ = [a1, b1, a2, b2, the coefficients of f] of filters of these orders, in scaled signals.

    held: trials begin in motion, from the first measured outputs; else from rest.
    """

    orders: tuple[int, int]
    phases: int
    held: bool
    f: Smooth
    theta: FloatArray

    @property
    def places(self) -> list[IntArray]:
        """Where in θ a1 (n₁,), b1 (M, n₁+1), a2 (n₂,), b2 (M, n₂+1) and the coefficients are."""
        (n1, n2), M = self.orders, self.phases
        shapes = [(n1,), (M, n1 + 1), (n2,), (M, n2 + 1), (self.f.intervals + 3,)]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        indices = np.split(np.arange(ends[-1]), ends[:-1])
        return [at.reshape(shape) for at, shape in zip(indices, shapes, strict=True)]

    @property
    def numbers(self) -> list[FloatArray]:
        """a1, b1, a2, b2 and the coefficients of f."""
        return [self.theta[at] for at in self.places]

    def moved(self, numbers: dict[str, FloatArray]) -> "Cascade":
        """With other numbers, called as in `places`; their sizes may change."""
        names = ("a1", "b1", "a2", "b2", "c")
        known = dict(zip(names, self.numbers, strict=True)) | numbers
        theta = np.concatenate([known[name].ravel() for name in names])
        return replace(self, theta=theta, phases=len(known["b1"]))

    @property
    def signals(self) -> Signals:
        """x_0 …, y of one input."""
        a1, b1, a2, b2, c = self.places
        nodes: list[Signal | Mapped] = []
        for j, b in enumerate(b1):
            past = _past(2 + 2 * j, a1)
            nodes += [Signal((Taps(0, b), *past)), Mapped(2 + 2 * j, self.f, c)]
        y = 2 + len(nodes)
        taps = [Taps(3 + 2 * j, b) for j, b in enumerate(b2)]
        nodes.append(Signal((*taps, *_past(y, a2)), len(a2) if self.held else 0))
        return Signals(1, tuple(nodes), y)

    def problem(self, trials: tuple[Trial, ...], radius: float) -> Problem:
        """What is minimised: of the map, second differences are kept small."""
        *_, c = self.places
        weight = np.sqrt(SMOOTHING) / max(float(np.ptp(self.theta[c])), np.finfo(float).tiny)
        bend = np.zeros((len(c) - 2, len(self.theta)))
        bend[:, c] = weight * np.diff(np.eye(len(c)), n=2, axis=0)
        return Problem(self.signals, trials, bend, radius=radius)

    def inner(self, trials: tuple[Trial, ...]) -> FloatArray:
        """All x_j along all trials."""
        signals = self.signals
        return np.concatenate(
            [x for trial in trials for x in signals.run(self.theta, trial)[2:-1:2]]
        )


def filter_map_filter(
    train: Dataset, model_class: Network[FilterMapFilter], task: Task
) -> tuple[BlockCascade, tuple[Step, ...]]:
    """A `BlockCascade` by simulation error, and the rms errors with more and more knots.

    Raises ShapeError for several inputs or outputs, DataError on too little or constant data.
    """
    made, progress = model_class.structure, task.progress
    scaled = _scales(train)
    trials = _trials(train, scaled, made, task.transient)
    radius = min(MAX_RADIUS, task.searched_rate)
    plain = replace(model_class, structure=replace(made, phases=1, intervals=START_INTERVALS))
    found = _best_start(train, plain, radius, task.transient)
    progress(f"best of {made.starts} starts", 0.4)
    knots = [K for K in (made.intervals // 4, made.intervals // 2) if K >= FEWEST_INTERVALS]
    steps: list[Step] = []
    for K in (*knots, made.intervals):
        found, reached = _minimised(_with_intervals(found, trials, K), trials, radius)
        if not steps and made.phases > 1:
            wider = _with_phases(found, trials, made.phases)
            found, reached = _minimised(wider, trials, radius)
        steps.append(Step(f"{K} intervals", scaled.y[1] * reached.rms))
        progress(steps[-1].what, 0.4 + 0.4 * len(steps) / (1 + len(knots)))
    found, reached = _minimised(found, trials, radius, steps=FINAL_STEPS, tolerance=FINAL_TOLERANCE)
    steps.append(Step("minimised further", scaled.y[1] * reached.rms))
    progress("minimised further", 1.0)
    return _model(found, scaled, train), tuple(steps)


def _minimised(
    start: Cascade,
    trials: tuple[Trial, ...],
    radius: float,
    *,
    steps: int = STEPS,
    tolerance: float = TOLERANCE,
) -> tuple[Cascade, Minimum]:
    """A local minimum, with poles within the radius."""
    found = minimise(start.problem(trials, radius), start.theta, steps=steps, tolerance=tolerance)
    return replace(start, theta=found.parameters), found


def _scales(train: Dataset) -> Scaled:
    """The spreads of input and output; a cascade has no offsets to undo."""
    first = train.trajectories[0]
    if first.u.shape[1] != 1 or first.y.shape[1] != 1:
        raise ShapeError(
            f"a block cascade has one input and one output; the data have {first.u.shape[1]} and "
            f"{first.y.shape[1]}"
        )
    spreads = signal_scale(train, "y")[1], signal_scale(train, "u")[1]
    return Scaled((0.0, float(spreads[0][0])), (np.zeros(1), spreads[1]), ())


def _trials(
    data: Dataset, scales: Scaled, made: FilterMapFilter, transient: int
) -> tuple[Trial, ...]:
    """In these scales, from rest or in motion."""
    held, (_, n2) = made.begin == "measured", made.orders
    skipped = max(transient, n2) if held else transient
    found = Scaled.of(data, skipped, skipped, scales).trials
    trials = tuple(replace(t, start=t.y[: n2 if held else 0], held=held) for t in found)
    needed = 2 * (sum(made.orders) + 2) + START_INTERVALS + 3
    if sum(len(trial.y) - trial.skipped for trial in trials) < needed:
        raise DataError(
            f"fewer than {needed} scored samples for orders {made.orders}; give more data"
        )
    return trials


@lru_cache(maxsize=REMEMBERED)
def _best_start(
    train: Dataset, model_class: Network[FilterMapFilter], radius: float, transient: int
) -> Cascade:
    """The best of the minima from random all-pole filters with f by linear least squares.

    Remembered, since models with more knots or phases begin with it too.
    """
    made, rng = model_class.structure, np.random.default_rng(model_class.seed)
    trials = _trials(train, _scales(train), made, transient)
    few, more = (shortened(trials, n) or trials for n in (SCREENED_SAMPLES, START_SAMPLES))
    screened = [
        _minimised(_random_start(few, made, rng, radius), few, radius, steps=SCREENING_STEPS)
        for _ in range(made.starts)
    ]
    screened.sort(key=lambda found: found[1].rms)
    finished = [
        _minimised(start, more, radius, steps=START_STEPS) for start, _ in screened[:KEPT_STARTS]
    ]
    return min(finished, key=lambda found: found[1].rms)[0]


def _random_start(
    trials: tuple[Trial, ...], made: FilterMapFilter, rng: np.random.Generator, radius: float
) -> Cascade:
    """All-pole filters, the first scaled to a unit output, f by regularised least squares."""
    a1, a2 = (_random_denominator(order, rng, radius) for order in made.orders)
    b1, b2 = np.eye(1, len(a1) + 1), np.eye(1, len(a2) + 1)
    parts = (a1, b1.ravel(), a2, b2.ravel(), np.zeros(START_INTERVALS + 3))
    f = Smooth(0.0, 1.0, START_INTERVALS)
    flat = Cascade(made.orders, 1, made.begin == "measured", f, np.concatenate(parts))
    x = flat.inner(trials)
    gain = 1.0 / float(np.std(x))
    flat = replace(flat.moved({"b1": gain * b1}), f=_knots(gain * x, START_INTERVALS))
    free = Problem(flat.signals, trials, np.zeros((0, len(flat.theta))))
    return replace(flat, theta=best_for(free, flat.theta, flat.places[4], RIDGE))


def _random_denominator(order: int, rng: np.random.Generator, radius: float) -> FloatArray:
    """Coefficients a of zⁿ - a[0] zⁿ⁻¹ - … with random poles: pairs, and a real one if n is odd."""
    roots: list[complex] = []
    radii = np.minimum(POLE_RADII, 0.9 * radius)
    while len(roots) + 2 <= order:
        pole = rng.uniform(*radii) * np.exp(1j * rng.uniform(*POLE_ANGLES))
        roots += [pole, pole.conjugate()]
    if len(roots) < order:
        roots.append(rng.uniform(*radii))
    return np.asarray(-np.real(np.poly(roots))[1:]) if roots else np.zeros(0)


def _with_intervals(cascade: Cascade, trials: tuple[Trial, ...], intervals: int) -> Cascade:
    """The same cascade with f on `intervals` knot intervals over the range that x takes."""
    f, c = _knots(cascade.inner(trials), intervals), cascade.numbers[4]
    x = np.linspace(f.low, f.low + f.spacing * intervals, FINE * intervals)
    basis = f.moves(np.zeros(intervals + 3), x).T
    fitted = np.linalg.lstsq(basis, cascade.f.values(c, x), rcond=None)[0]
    return replace(cascade.moved({"c": fitted}), f=f)


def _with_phases(cascade: Cascade, trials: tuple[Trial, ...], phases: int) -> Cascade:
    """A cascade of one phase with `phases` of them: phase j sees x(t - j/phases).

    b1[j] is fitted to x delayed by FFT, then every b2 to the outputs; both are linear.
    """
    _, b1_at, _, b2_at, _ = cascade.places
    columns, targets = [], []
    for trial in trials:
        sources, derivatives = cascade.signals.sensitivities(cascade.theta, trial)
        x, moved = sources[2], derivatives[2]
        inside = slice(trial.skipped, len(x) - trial.skipped)  # an FFT is periodic
        columns.append(moved[b1_at[0]].T[inside])
        targets.append(np.stack([_late(x, j / phases)[inside] for j in range(1, phases)], axis=1))
    shifted = np.linalg.lstsq(np.concatenate(columns), np.concatenate(targets), rcond=None)[0]
    b1 = np.concatenate([cascade.theta[b1_at], shifted.T])
    wide = cascade.moved({"b1": b1, "b2": np.zeros((phases, b2_at.shape[1]))})
    at = wide.places[3].ravel()
    return replace(wide, theta=best_for(wide.problem(trials, np.inf), wide.theta, at))


def _past(signal: int, at: IntArray) -> tuple[Taps, ...]:
    """The taps of a signal's own past; a filter without poles has none."""
    return (Taps(signal, at, 1),) if len(at) else ()


def _knots(x: FloatArray, intervals: int) -> Smooth:
    """A map on knots that cover x with a margin."""
    width = float(np.ptp(x))
    low = float(np.min(x)) - MARGIN * width
    return Smooth(low, (1.0 + 2.0 * MARGIN) * width / intervals, intervals)


def _late(x: FloatArray, delay: float) -> FloatArray:
    """x(t - delay) of a band-limited signal, delay in samples."""
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(len(x)) * delay)
    return np.asarray(np.fft.irfft(np.fft.rfft(x) * turn, len(x)))


def _model(cascade: Cascade, scaled: Scaled, train: Dataset) -> BlockCascade:
    """Scaling undone: the only place where it is."""
    first, (a1, b1, a2, b2, c) = train.trajectories[0], cascade.numbers
    return BlockCascade(
        a1=a1,
        b1=b1 / scaled.u[1],
        f=Spline(cascade.f.low, cascade.f.spacing, c),
        a2=a2,
        b2=b2 * scaled.y[1],
        period=train.period,
        y=signals_of(first, "y")[0],
        u=signals_of(first, "u")[0],
        bags=train.bags,
    )
