"""Where block-cascade fits start: random filters, finer knots, more phases."""

from dataclasses import replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.network.cascade_fit import (
    Minimum,
    Parameters,
    Trial,
    basis_responses,
    delayed,
    filtered,
    minimise,
    output_of,
    second_inputs,
    simulate,
)
from nlsid_core.models import Spline

START_INTERVALS = 12
SCREENING_STEPS, START_STEPS = 20, 60
KEPT_STARTS = 3  # of the screened ones, minimised further
START_TOLERANCE = 1e-3
POLE_RADII = (0.5, 0.95)
POLE_ANGLES = (0.1, 1.5)  # rad a sample: a filter that passes something of a sampled signal
MARGIN = 0.02  # of the range of x beyond the outer data on each side
RIDGE = 1e-6  # of the mean curvature: knots without data stay near zero
FINE = 40  # points an interval at which one spline is fitted to another


def best_start(
    trials: tuple[Trial, ...],
    orders: tuple[int, int],
    *,
    smoothing: float,
    starts: int,
    rng: np.random.Generator,
    radius: float,
) -> Parameters:
    """The best of `starts` minima from random all-pole filters with f by linear least squares."""

    def minimised(start: Parameters, steps: int) -> Minimum:
        return minimise(
            trials,
            start,
            smoothing=smoothing,
            steps=steps,
            tolerance=START_TOLERANCE,
            radius=radius,
        )

    screened = [
        minimised(
            _random_start(trials, orders, smoothing=smoothing, rng=rng, radius=radius),
            SCREENING_STEPS,
        )
        for _ in range(starts)
    ]
    screened.sort(key=lambda minimum: minimum.cost)
    finished = [minimised(found.parameters, START_STEPS) for found in screened[:KEPT_STARTS]]
    return min(finished, key=lambda minimum: minimum.cost).parameters


def with_intervals(parameters: Parameters, trials: tuple[Trial, ...], intervals: int) -> Parameters:
    """The same cascade with f on `intervals` knot intervals over the range that x takes."""
    low, spacing = _knots(
        np.concatenate([second_inputs(parameters, t).ravel() for t in trials]), intervals
    )
    f = Spline(low, spacing, np.zeros(intervals + 3))
    x = np.linspace(f.low, f.high, FINE * intervals)
    index, weights = f.weights(x)
    basis = np.zeros((len(x), intervals + 3))
    for r in range(4):
        basis[np.arange(len(x)), index + r] = weights[r]
    coefficients = np.linalg.lstsq(basis, parameters.f(x), rcond=None)[0]
    return replace(parameters, f=replace(f, coefficients=coefficients))


def with_phases(parameters: Parameters, trials: tuple[Trial, ...], phases: int) -> Parameters:
    """A cascade of one phase with `phases` of them: phase j sees x(t - j/phases).

    b1[j] is fitted to x delayed by FFT, then every b2 to the outputs; both are linear.
    """
    m1, m2 = parameters.b1.shape[1], parameters.b2.shape[1]
    A1, one = np.concatenate([[1.0], -parameters.a1]), np.ones(1)
    columns, targets = [], []
    for trial in trials:
        v = filtered(one, A1, trial.u, trial)
        x = filtered(parameters.b1[0], one, v, trial)
        inside = slice(trial.transient, len(x) - trial.transient)  # an FFT is periodic
        columns.append(_lags(v, m1, trial).T[inside])
        targets.append(np.stack([_late(x, j / phases)[inside] for j in range(1, phases)], axis=1))
    shifted = np.linalg.lstsq(np.concatenate(columns), np.concatenate(targets), rcond=None)[0]
    b1 = np.concatenate([parameters.b1[:1], shifted.T])
    columns, targets = [], []
    for trial in trials:
        seen = parameters.f(second_inputs(replace(parameters, b1=b1), trial))
        lagged = np.concatenate([_lags(w, m2, trial) for w in seen])
        columns.append(output_of(one, parameters.a2, lagged, trial).T[trial.transient :])
        free = simulate(replace(parameters, b2=np.zeros_like(parameters.b2)), trial)
        targets.append((trial.y - free)[trial.transient :])
    b2 = np.linalg.lstsq(np.concatenate(columns), np.concatenate(targets), rcond=None)[0]
    return replace(parameters, b1=b1, b2=b2.reshape(phases, m2))


def mean_square(parameters: Parameters, trials: tuple[Trial, ...]) -> float:
    """Mean squared simulation error over the scored samples, in the trials' scaled unit."""
    errors = np.concatenate([(simulate(parameters, t) - t.y)[t.transient :] for t in trials])
    return float(errors @ errors) / len(errors)


def _random_start(
    trials: tuple[Trial, ...],
    orders: tuple[int, int],
    *,
    smoothing: float,
    rng: np.random.Generator,
    radius: float,
) -> Parameters:
    """All-pole filters, the first scaled to a unit output, f by regularised least squares."""
    a1, a2 = (_random_denominator(order, rng, radius) for order in orders)
    b1, b2 = np.eye(1, orders[0] + 1), np.eye(1, orders[1] + 1)
    flat = Parameters(a1, b1, Spline(0.0, 1.0, np.zeros(START_INTERVALS + 3)), a2, b2)
    gain = 1.0 / float(np.std(np.concatenate([second_inputs(flat, t)[0] for t in trials])))
    inputs = [gain * second_inputs(flat, t) for t in trials]
    low, spacing = _knots(np.concatenate(inputs, axis=1), START_INTERVALS)
    flat = replace(flat, b1=gain * b1, f=replace(flat.f, low=low, spacing=spacing))
    R = np.concatenate(
        [
            basis_responses(flat, x, t)[:, t.transient :]
            for x, t in zip(inputs, trials, strict=True)
        ],
        axis=1,
    )
    y = np.concatenate([(t.y - simulate(flat, t))[t.transient :] for t in trials])
    H = R @ R.T
    H += max(RIDGE, smoothing) * np.trace(H) / len(H) * np.eye(len(H))
    return replace(flat, f=replace(flat.f, coefficients=np.linalg.solve(H, R @ y)))


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


def _knots(x: FloatArray, intervals: int) -> tuple[float, float]:
    """First knot and spacing that cover x with a margin."""
    width = float(np.ptp(x))
    low = float(np.min(x)) - MARGIN * width
    return low, (1.0 + 2.0 * MARGIN) * width / intervals


def _late(x: FloatArray, delay: float) -> FloatArray:
    """x(t - delay) of a band-limited signal, delay in samples."""
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(len(x)) * delay)
    return np.asarray(np.fft.irfft(np.fft.rfft(x) * turn, len(x)))


def _lags(signal: FloatArray, count: int, trial: Trial) -> FloatArray:
    """(count, N): signal(t), signal(t - 1), …, before the first sample as the trial's input."""
    return np.stack([delayed(signal, k, trial) for k in range(count)])
