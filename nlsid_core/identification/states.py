"""`identify_states`: a polynomial model of a measured state from repeats of the same excitations.

Noise in the regressors biases least squares. Repeats have independent noise, so the monomials of
one repeat are instrumented by those of the mean of the others: Σ Z'(x⁺ - x - Φθ) = 0.
Source: the instrumental-variable method; repeats as in thesis Chapter 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from math import comb

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.models import StateModel, signals_of
from nlsid_core.polynomial.values import monomial_values

LARGEST_GRAM = 60  # order of a Gram matrix in the funnel of the model; beyond it steps take seconds
USEFUL = 0.97  # a larger model has to bring the error below this part of the smaller one's
REFUSED_ERROR = 25.0  # % in free run: more than a linear guess gets wrong is not a model
LEAST_DISTURBANCE = (
    0.1  # of the measurement noise: no model is so good that its robot may not change
)
REPEATED_INPUT = 1e-3  # relative; a driver may quantise, but repeats play the same inputs
SHORTEST = 50  # samples of a stretch in the box worth simulating
SLICES = 8  # of each variable's range, to say where a model class fails


@dataclass(frozen=True, eq=False)
class StateFit:
    """The model of least free-run error on validation data, and every class that was tried.

    errors: (degrees per variable, % in free run on the validation trajectories; infinite if it
    diverged or was not determined). error: the chosen model's.
    """

    model: StateModel
    error: float
    errors: tuple[tuple[tuple[int, ...], float], ...]


def identify_states(
    train: Dataset,
    validation: Dataset,
    *,
    degrees: Sequence[tuple[int, ...]] | None = None,
) -> StateFit:
    """Fit x⁺ = f(x, u) to repeats; trajectories hold the measured state in y.

    degrees: classes to try, the highest power of each of [x; u]; default `classes_to_try`. The
    least free-run error on `validation` wins. Raises DataError if there are no repeats, or if no
    class describes the data to REFUSED_ERROR %, saying where they fail.
    """
    groups = list(train.repeats().values())
    if not groups:
        raise DataError("no excitation was repeated; record each at least twice, same inputs")
    for members in groups:
        refuse_unequal(members)
    first = groups[0][0]
    n, p = first.y.shape[1], first.u.shape[1]
    data = np.concatenate([np.hstack([m.y, m.u]) for group in groups for m in group])
    scale = np.abs(data).max(axis=0)
    if not (scale > 0).all():
        raise DataError(f"{(first.y_names + first.u_names)[int(np.argmin(scale))]} is always zero")
    best: StateFit | None = None
    tried: list[tuple[tuple[int, ...], float]] = []
    for choice in degrees if degrees is not None else classes_to_try(n, p):
        exponents = monomials_of(choice)
        theta = _instrumented(groups, exponents, scale)
        if theta is None:
            tried.append((tuple(choice), np.inf))
            continue
        model = _model(train, groups, exponents, theta, data)
        error = free_run_error(model, validation)
        tried.append((tuple(choice), error))
        if best is None or error < USEFUL * best.error:
            best = StateFit(model, error, ())
    if best is None or not best.error <= REFUSED_ERROR:
        reached = f"the best gets {best.error:.3g} %" if best else "the excitation determines none"
        raise DataError(
            f"no polynomial map describes this data to {REFUSED_ERROR:g} % in free run "
            f"({reached}); " + ("" if best is None else where_it_fails(best.model, train))
        )
    return StateFit(best.model, best.error, tuple(tried))


def classes_to_try(n: int, p: int) -> list[tuple[int, ...]]:
    """Degrees per variable, [positions; rates; inputs], small first, that a funnel can prove."""
    half = n // 2
    return [
        (position,) * half + (rate,) * (n - half) + (1,) * p
        for position, rate in product((1, 3, 5), (1, 2, 3))
        if rate <= position and comb(n + position, n) <= LARGEST_GRAM
    ]


def free_run_error(model: StateModel, dataset: Dataset) -> float:
    """Worst 100·|x - x̂|/|x - mean(x)| of the trajectories, each state in units of its spread.

    Of the stretches in the box of the model's data, each from its measured start; outside it the
    model is not a claim about anything. Infinite if it diverges or nothing is left.
    """
    errors = []
    for trial in dataset:
        spread, mean = trial.y.std(axis=0), trial.y.mean(axis=0)
        missed = whole = 0.0
        for part in stretches_in_box(model, trial):
            y, u = trial.y[part], trial.u[part]
            with np.errstate(over="ignore", invalid="ignore"):
                missed += float(np.sum(((y - model.simulate(y[0], u[:-1])) / spread) ** 2))
            whole += float(np.sum(((y - mean) / spread) ** 2))
        if whole:
            errors.append(100.0 * np.sqrt(missed / whole) if np.isfinite(missed) else np.inf)
    return float(max(errors, default=np.inf))


def stretches_in_box(model: StateModel, trial: Trajectory) -> list[slice]:
    """Where the trajectory stays in the box of the model's data for SHORTEST samples or more."""
    outside = (trial.y < model.x_range[:, 0]) | (trial.y > model.x_range[:, 1])
    ends = [-1, *np.flatnonzero(outside.any(axis=1)).tolist(), len(trial)]
    return [slice(a + 1, b) for a, b in pairwise(ends) if b - a > SHORTEST]


def where_it_fails(model: StateModel, dataset: Dataset) -> str:
    """The slice of a variable in which one step ahead is worst, in words."""
    points = np.concatenate([np.hstack([t.y[:-1], t.u[:-1]]) for t in dataset])
    missed = np.concatenate([t.y[1:] - model(t.y[:-1], t.u[:-1]) for t in dataset])
    size = np.sqrt(np.mean((missed / missed.std(axis=0)) ** 2, axis=1))
    found = [(0.0, "too little data to say where")]
    for j, signal in enumerate((*model.x, *model.u)):
        edges = np.linspace(points[:, j].min(), points[:, j].max(), SLICES + 1)
        for lo, hi in pairwise(edges.tolist()):
            inside = (points[:, j] >= lo) & (points[:, j] <= hi)
            if inside.sum() < len(points) // (4 * SLICES):
                continue
            ratio = float(size[inside].mean() / size.mean())
            words = (
                f"one step ahead it is worst where {signal.name} is in [{lo:.3g}, {hi:.3g}] "
                f"{signal.unit}: {ratio:.1f} times the mean error (stick-slip, a limit or an "
                "unmeasured state there is no polynomial)"
            )
            found.append((ratio, words))
    return max(found)[1]


def monomials_of(degrees: Sequence[int]) -> IntArray:
    """All products with at most these powers, of total degree at most the largest."""
    rows = [e for e in product(*(range(d + 1) for d in degrees)) if sum(e) <= max(degrees)]
    return np.array(rows, dtype=np.int64)


def _instrumented(
    groups: Sequence[Sequence[Trajectory]], exponents: IntArray, scale: FloatArray
) -> FloatArray | None:
    """θ of x⁺ - x (m, n) in scaled monomials; None if undetermined."""
    m, n = len(exponents), groups[0][0].y.shape[1]
    moments, target = np.zeros((m, m)), np.zeros((m, n))

    def monomials_at(y: FloatArray, u: FloatArray) -> FloatArray:
        return monomial_values(exponents, np.hstack([y[:-1], u]) / scale)

    for members in groups:
        total = np.sum([member.y for member in members], axis=0)
        for member in members:
            others = (total - member.y) / (len(members) - 1)
            instruments = monomials_at(others, member.u[:-1])
            moments += instruments.T @ monomials_at(member.y, member.u[:-1])
            target += instruments.T @ np.diff(member.y, axis=0)
    solution, _, rank, _ = np.linalg.lstsq(moments, target, rcond=None)
    return np.asarray(solution) if rank == m else None


def _model(
    train: Dataset,
    groups: Sequence[Sequence[Trajectory]],
    exponents: IntArray,
    theta: FloatArray,
    data: FloatArray,
) -> StateModel:
    first = groups[0][0]
    n = first.y.shape[1]
    scale = np.abs(data).max(axis=0)
    coefficients = theta / np.prod(scale**exponents, axis=1)[:, None]
    for i in range(n):
        unit = (exponents == np.eye(exponents.shape[1], dtype=np.int64)[i]).all(axis=1)
        coefficients[np.flatnonzero(unit)[0], i] += 1.0  # θ was fitted to x⁺ - x
    ranges = np.stack([data.min(axis=0), data.max(axis=0)], axis=1)
    model = StateModel(
        exponents=exponents,
        coefficients=coefficients,
        period=train.period,
        x=signals_of(first, "y"),
        u=signals_of(first, "u"),
        x_range=ranges[:n],
        u_range=ranges[n:],
        noise=noise_between(groups),
        disturbance=np.zeros(n),
        bags=tuple((t.name, t.digest) for group in groups for t in group),
    )
    return _with_disturbance(model, groups)


def noise_between(groups: Sequence[Sequence[Trajectory]]) -> FloatArray:
    """(n,) standard deviation: between repeats, or of third differences where there are none."""
    variances = [
        np.var([m.y for m in group], axis=0, ddof=1).mean(axis=0)
        if len(group) > 1
        else np.mean(np.diff(group[0].y, 3, axis=0) ** 2, axis=0) / 20.0
        for group in groups
    ]
    return np.asarray(np.sqrt(np.mean(variances, axis=0)))


def _with_disturbance(model: StateModel, groups: Sequence[Sequence[Trajectory]]) -> StateModel:
    """What one step misses on the mean of the repeats, less what the noise left in it explains."""
    squares, noise = [], []
    for members in groups:
        mean = np.mean([member.y for member in members], axis=0)
        squares.append(np.mean((mean[1:] - model(mean[:-1], members[0].u[:-1])) ** 2, axis=0))
        A, _ = model.linearised(mean.mean(axis=0), members[0].u.mean(axis=0))
        noise.append((model.noise**2 + A**2 @ model.noise**2) / len(members))
    floor = (LEAST_DISTURBANCE * model.noise) ** 2
    variance = np.maximum(np.mean(squares, axis=0) - np.mean(noise, axis=0), floor)
    return replace(model, disturbance=np.sqrt(variance))


def refuse_unequal(members: Sequence[Trajectory]) -> None:
    """Raise DataError unless all have the length and the inputs of the first."""
    first = members[0]
    for other in members[1:]:
        if len(other) != len(first):
            raise DataError(
                f"{other.name} has {len(other)} samples, its repeat {first.name} {len(first)}; "
                "cut repeats to the same length"
            )
        gap = float(np.abs(other.u - first.u).max())
        if gap > REPEATED_INPUT * float(np.abs(first.u).max()):
            raise DataError(
                f"{other.name} is no repeat of {first.name}: inputs differ by up to {gap:.3g}"
            )
