"""The one rule by which everything about a model is chosen: by data that were held out.

The trials are put into folds; trials that repeat one excitation stay together, and where all have
one excitation, stretches of time are held out instead. Each fold is simulated by models of the
others, every stretch from a start that is found on its first samples, which are not scored. A class
with curvature that the data do not determine may do well there and nowhere else: so it counts, too,
how far the folds' models are apart over the recorded inputs played at twice their speed, and a
fifth larger, where nothing was measured. Taken is the best model, or a smaller one that is at most
one hundredth worse.

What a person may expect is promised by the same errors: for each fold the model is chosen by the
other folds alone, of what was tried, and its error on that fold counts. Which attempts were tried
closely enough to be chosen is not held out: the first fold, and the best so far, decide that.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.stats import t as student

from nlsid_core.arrays import FloatArray
from nlsid_core.data.repeats import by_excitation
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.identification.families import ModelClass, describe
from nlsid_core.identification.fit import Fit
from nlsid_core.identification.identify import Search, identify
from nlsid_core.identification.methods.options import Method, Rse
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.prediction import Model, simulate_started, simulate_trial
from nlsid_core.identification.rates import rate_of_memory

FOLDS = 3
STRETCHES = 6  # of a recording, where stretches of time are held out
FEW = 5  # excitations: of fewer, each is judged in stretches
STARTS = (10, 20, 30, 45)  # samples that may show how a stretch starts, a fifth of it at most;
PLACES = (0.0, 0.15, 0.3, 0.45)  # of a trial, where it is tried how many are needed,
ENOUGH = 8  # trials, spread over all, that it is tried in,
START_LAGS, START_STEPS, START_CLOSE = 4, 6, 1.04  # by a linear model, and its squared error
SHORTEST = 20  # samples of a stretch
SAMPLES = 8000  # that a fold is fitted to, at most
BEYOND = ((2, 1.0), (1, 1.2))  # times the recorded speed and size: there folds' models are compared
CLOSE = 1.01  # times the best error: 1.03 to 1.05 times it was twice as bad on test data, on 4 sets
SURE = 0.9  # probability of the promised interval, were squared errors normal


@dataclass(frozen=True)
class Attempt:
    """A class and a method to try. memory: the longest time constant, in longest trials."""

    model_class: ModelClass
    method: Method
    memory: float = 1.0

    def __str__(self) -> str:
        iterations = getattr(self.method, "iterations", None)
        steps = "" if iterations is None else f" ({iterations})"
        limit = "" if self.memory == 1.0 else f", memory at most {self.memory:.2g} trials"
        return f"{describe(self.model_class)}: {self.method.name}{steps}{limit}"


@dataclass(frozen=True, eq=False)
class Row:
    """What became of an attempt: mean squared errors of the stretches, in squared spreads.

    errors: of each stretch, NaN where there is none yet. fits: of the folds that are judged.
    refusal: why the others are not. apart: by how much the folds' models differ beyond what
    was recorded, in the same unit: what the data leave open.
    """

    attempt: Attempt
    errors: FloatArray
    fits: tuple[Fit[Model], ...] = ()
    refusal: str = ""
    apart: float = 0.0

    @property
    def percent(self) -> float:
        """What is compared, in % of the outputs' spread: the root of error and `apart` together.

        Of the folds that are judged; infinite where there is a refusal.
        """
        return 100.0 * math.sqrt(np.nanmean(self.judged)) if not self.refusal else math.inf

    @property
    def judged(self) -> FloatArray:
        """How attempts are compared: errors, and what the data leave open."""
        return self.errors + self.apart

    @property
    def size(self) -> int:
        """Numbers in a model's file, at most."""
        return max(_numbers(fit.model.document()) for fit in self.fits)

    @property
    def rate(self) -> float:
        """The slowest rate that is proved."""
        return max(fit.proof.rate for fit in self.fits)


@dataclass(frozen=True)
class Promise:
    """What to expect of new data, in % of the outputs' spread: an error, and between which two.

    low: 0 where the model is fitted to more samples than those that were judged: how much better it
    is for that is not known. on: what was held out, in words.
    """

    percent: float
    low: float
    high: float
    on: str

    def __str__(self) -> str:
        between = f"{self.low:.3g} to {self.high:.3g}" if self.low else f"at most {self.high:.3g}"
        return f"{between} % on {self.on} that were held out"


@dataclass(frozen=True, eq=False)
class Fold:
    """fitted: what models are fitted to; judged: stretches, each of one or several repeats.

    is_whole: whether models are fitted to all that there is outside the fold.
    """

    fitted: Dataset
    judged: tuple[tuple[Trajectory, ...], ...]
    is_whole: bool


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Data in folds.

    on: what is held out, in words. start: samples that show how a stretch starts, and are not
    scored. spread: (p,) of the outputs.
    """

    data: Dataset
    on: str
    folds: tuple[Fold, ...]
    start: int
    spread: FloatArray

    @classmethod
    def of(cls, data: Dataset) -> "HeldOut":
        """DataError if there is too little of it."""
        groups = by_excitation(data)
        if len(groups) == 1:
            on = "stretches of the only excitation"
            folds = list(_folds(_stretches(data.trajectories, STRETCHES), 1))
        else:  # dealt out by how much the inputs vary, so that no fold has all that vary most, and
            on = "excitations"  # the first fold, on which all are judged, has those most of all
            groups = sorted(groups, key=lambda group: -float(np.var(group[0].u, axis=0).sum()))
            folds = list(_folds(groups, FOLDS if len(groups) < FEW else 1))
        spread = np.concatenate([trial.y for trial in data]).std(axis=0)
        shortest = min(len(t) for fold in folds for group in fold.judged for t in group)
        return cls(
            data, on, tuple(folds), _start(data, shortest), np.maximum(spread, np.finfo(float).tiny)
        )

    @property
    def fold_of(self) -> FloatArray:
        """The fold of each stretch."""
        return np.repeat(np.arange(len(self.folds)), [len(fold.judged) for fold in self.folds])

    def error(self, model: Model, stretch: Sequence[Trajectory]) -> float:
        """The mean squared error of a simulation, in squared spreads; infinite if it diverges."""
        with np.errstate(over="ignore", invalid="ignore"):
            outputs = zip(stretch, simulate_started(model, stretch, self.start), strict=True)
            missed = np.concatenate([(y - trial.y)[self.start :] for trial, y in outputs])
            error = float(np.mean((missed / self.spread) ** 2))
        return error if np.isfinite(error) else np.inf

    def apart(self, models: Sequence[Model]) -> float:
        """The mean square of the models' distance from their mean, beyond what was recorded."""
        middle = np.concatenate([trial.u for trial in self.data]).mean(axis=0)
        judged = [stretch[0] for fold in self.folds for stretch in fold.judged]
        runs = []
        with np.errstate(over="ignore", invalid="ignore"):
            for trial, (speed, size) in product(judged, BEYOND):
                y, u = trial.y[::speed], middle + size * (trial.u[::speed] - middle)
                beyond = replace(trial, t=trial.t[: len(y)], y=y, u=u)
                outputs = np.array([simulate_trial(model, beyond) for model in models])
                runs.append((outputs - outputs.mean(axis=0)) / self.spread)
            found = float(np.mean(np.square(np.concatenate(runs, axis=1))))
        return found if np.isfinite(found) else np.inf

    def glance(self, attempt: Attempt) -> Row:
        """The row of an attempt, judged on the first fold."""
        return self._judged(Row(attempt, np.full(len(self.fold_of), np.nan)), 1)

    def judged(self, row: Row) -> Row:
        """The row with the errors on all folds."""
        return self._judged(row, len(self.folds))

    def _judged(self, row: Row, count: int) -> Row:
        """On so many folds; those that are judged already are not again."""
        errors, fits = row.errors.copy(), list(row.fits)
        for k in range(len(fits), count):
            try:
                fits.append(fitted(self.folds[k].fitted, row.attempt, self.data))
            except (DataError, SolverError) as refusal:
                return replace(row, refusal=str(refusal))
            model = fits[-1].model
            errors[self.fold_of == k] = [self.error(model, s) for s in self.folds[k].judged]
        apart = self.apart([fit.model for fit in fits]) if count > 1 else 0.0
        diverges = "its simulation diverges" if np.isinf(errors).any() else ""
        return Row(row.attempt, errors, tuple(fits), diverges, apart)


@dataclass(frozen=True, eq=False)
class Choice:
    """Everything that was tried, in order, and what the rule takes."""

    held_out: HeldOut
    rows: tuple[Row, ...]

    @property
    def found(self) -> bool:
        """Whether anything that was tried has proved models."""
        return any(not row.refusal for row in self.rows)

    @property
    def best(self) -> Row:
        """What is taken; Infeasible if nothing has a proved model."""
        return self.ranked[0]

    @property
    def ranked(self) -> list[Row]:
        """What is taken, then the others that have an error, the best first."""
        known = [row for row in self.rows if not row.refusal]
        if not known:
            raise Infeasible("no class that was tried has a proved model of these data")
        first = simplest(known, np.ones(len(known[0].errors), dtype=bool))
        others = sorted((row for row in known if row is not first), key=lambda row: row.percent)
        return [first, *others]

    @property
    def optimism(self) -> float:
        """How many times larger errors are where nothing was fitted than where it was, 1 or more.

        Of the best, on all folds.
        """
        held_out, best = self.held_out, self.best
        own = [
            held_out.error(fit.model, [trial])
            for fold, fit in zip(held_out.folds, best.fits, strict=True)
            for trial in fold.fitted
        ]
        return max(1.0, math.sqrt(np.mean(best.errors) / np.mean(own)))

    @property
    def promise(self) -> Promise:
        """The errors on each fold of the model that the other folds choose.

        The interval is that of as much new data as a fold: the mean of n squared errors and that of
        n/3 new ones differ by a standard deviation of 2 σ/√n, half of it in the root.
        """
        known, fold_of = self.ranked, self.held_out.fold_of
        errors = np.empty(len(fold_of))
        for k in range(len(self.held_out.folds)):
            errors[fold_of == k] = simplest(known, fold_of != k).errors[fold_of == k]
        n, mean = len(errors), float(errors.mean())
        deviation = float(errors.std(ddof=1)) / max(mean, np.finfo(float).tiny) / math.sqrt(n)
        factor = math.exp(float(student.ppf(0.5 + 0.5 * SURE, n - 1)) * deviation)
        percent = 100.0 * math.sqrt(mean)
        low = percent / factor if all(fold.is_whole for fold in self.held_out.folds) else 0.0
        return Promise(percent, low, factor * percent, self.held_out.on)


def simplest(rows: Sequence[Row], by: FloatArray) -> Row:
    """The best model, or the smallest that is as good, by these stretches."""
    ranked = sorted(rows, key=lambda row: float(np.mean(row.judged[by])))
    limit = CLOSE**2 * np.mean(ranked[0].judged[by])
    good = [row for row in ranked if np.mean(row.judged[by]) <= limit]
    return min(good, key=lambda row: row.size)


def fitted(train: Dataset, attempt: Attempt, whole: Dataset) -> Fit[Model]:
    """The attempt's proved model of a part of the data. Raises as `identify`."""
    return identify(
        train,
        attempt.model_class,
        method=attempt.method,
        search=Search(comparators=(), max_rate=rate_of_memory(whole, attempt.memory)),
    )


def _start(data: Dataset, shortest: int) -> int:
    """Samples that show how a stretch starts: the fewest that are about as good as more.

    By the errors of a linear model that starts at several places of some trials.
    """
    rows = [min(samples, shortest // 5) for samples in STARTS]
    attempt = Attempt(Polynomial(START_LAGS), Rse(START_STEPS))
    try:
        model = fitted(shortened(data.trajectories), attempt, data).model
    except (DataError, SolverError):
        return rows[0]
    parts = [
        trial.rows(slice(first, first + min(shortest, SAMPLES // FOLDS)))
        for trial in data.trajectories[:: -(-len(data.trajectories) // ENOUGH)]
        for first in (int(place * len(trial)) for place in PLACES)
    ]
    errors = []
    for samples in rows:
        outputs = zip(parts, simulate_started(model, parts, samples), strict=True)
        errors.append(np.mean([np.mean((y - part.y)[rows[-1] :] ** 2) for part, y in outputs]))
    return next(n for n, e in zip(rows, errors, strict=True) if e <= START_CLOSE * min(errors))


def _folds(groups: Sequence[Sequence[Trajectory]], parts: int) -> Iterator[Fold]:
    """Every third group is judged, in so many stretches."""
    count = min(FOLDS, len(groups))
    for k in range(count):
        rest = [trial for i, group in enumerate(groups) if i % count != k for trial in group]
        judged = (part for group in groups[k::count] for part in _stretches(group, parts))
        short = (tuple(t.rows(slice(SAMPLES // FOLDS)) for t in part) for part in judged)
        some = shortened(rest)
        yield Fold(some, tuple(short), sum(map(len, some)) == sum(map(len, rest)))


def _stretches(trials: Sequence[Trajectory], count: int) -> list[list[Trajectory]]:
    """The trials cut into so many stretches each, the first ones of all, the second ones, …."""
    parts: list[list[Trajectory]] = [[] for _ in range(count)]
    for trial in trials:
        if count > 1 and len(trial) < count * SHORTEST:
            raise DataError(
                f"{trial.name}: {len(trial)} samples are too few to hold a part of them out; at "
                f"least {count * SHORTEST} are needed"
            )
        ends = np.linspace(0, len(trial), count + 1).round().astype(int).tolist()
        for part, first, end in zip(parts, ends, ends[1:], strict=False):
            part.append(trial.rows(slice(first, end), f"{trial.name}[{first}:{end}]"))
    return parts


def shortened(trials: Sequence[Trajectory], samples: int = SAMPLES) -> Dataset:
    """At most about so many: the first of each trial, or of as many trials as have enough."""
    share = max(samples // len(trials), min(min(map(len, trials)), samples // FOLDS))
    every = max(1, round(sum(min(len(t), share) for t in trials) / samples))
    return Dataset(tuple(trial.rows(slice(share)) for trial in trials[::every]))


def _numbers(document: object) -> int:
    """How many numbers there are in a document that are not whole."""
    if isinstance(document, dict | list):
        parts = document.values() if isinstance(document, dict) else document
        return sum(map(_numbers, parts))
    return int(isinstance(document, float) and document != round(document))
