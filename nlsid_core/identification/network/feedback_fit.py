"""Simulation errors of feedback through a static map, and of the same equation unrolled.

The loop is y = c + Σ a_k y_-k + Σ b_k u_-k + Σ e_k φ(y_-k), k >= 1 where y or φ(y) is delayed.
Unrolled, every stage is a stable filter of the input and of the map of the stage before it:
    y_0 = G_0 u,    y_s = G_s u + H_s φ_s(y_{s-1}).
φ is linear between knots that lie on a cubic spline, and constant beyond them. Both are minimised
by damped Gauss-Newton steps with exact sensitivities: ∂y of the loop solves one banded system, that
of the stages passes the same filters as y does. Source: Marquardt 1963; for the unrolled equation
Picard's iteration, the truncated form of which is a Volterra series (Boyd and Chua 1985).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_banded
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.methods.damped import descend
from nlsid_core.models import Spline

KNOTS = 48  # intervals of the piecewise linear map, whatever the spline's
FIRST_DAMPING, PATIENCE = 1e-2, 2
DIVERGED = 50.0  # spreads of y, at which the loop's simulation is held


@dataclass(frozen=True, eq=False)
class Trial:
    """u (N, q) and y (N,) in their spreads, start (n,): the first outputs of every simulation.

    The first `skipped` samples are not scored.
    """

    u: FloatArray
    y: FloatArray
    start: FloatArray
    skipped: int


@dataclass(frozen=True, eq=False)
class Basis:
    """Maps on [low, high]: rows (KNOTS + 1, J) gives their values at the knots from J numbers."""

    low: float
    high: float
    intervals: int
    rows: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        size = self.intervals + 3
        spline = Spline(self.low, (self.high - self.low) / self.intervals, np.zeros(size))
        index, weights = spline.weights(self.knots)
        rows = np.zeros((KNOTS + 1, size))
        for r in range(4):
            rows[np.arange(KNOTS + 1), index + r] = weights[r]
        object.__setattr__(self, "rows", rows)

    @property
    def knots(self) -> FloatArray:
        """(KNOTS + 1,)."""
        return np.linspace(self.low, self.high, KNOTS + 1)

    def fitted(self, values: FloatArray) -> FloatArray:
        """The numbers (J,) of the map nearest to these values at the knots."""
        return np.asarray(np.linalg.lstsq(self.rows, values, rcond=None)[0])

    def responses(self, y: FloatArray) -> FloatArray:
        """(J, N): the values at y (N,) are phi @ responses."""
        position = np.clip((y - self.low) * KNOTS / (self.high - self.low), 0.0, KNOTS)
        i = np.minimum(position.astype(np.intp), KNOTS - 1)
        s = (position - i)[:, None]
        return np.asarray((self.rows[i] * (1.0 - s) + self.rows[i + 1] * s).T)

    def slopes(self, phi: FloatArray, y: FloatArray) -> FloatArray:
        """(N,): the slope of the map at y."""
        position = (y - self.low) * KNOTS / (self.high - self.low)
        i = np.clip(position, 0, KNOTS - 1).astype(np.intp)
        rises = np.diff(self.rows @ phi) * KNOTS / (self.high - self.low)
        return np.asarray(np.where((position >= 0) & (position <= KNOTS), rises[i], 0.0))


@dataclass(frozen=True, eq=False)
class Stage:
    """a (n,), b (n+1, q), c, and of what the map gives e (n+1,), phi (J,), both empty without one.

    Of a loop e[0] = 0.
    """

    a: FloatArray
    b: FloatArray
    c: float
    e: FloatArray
    phi: FloatArray

    def vector(self) -> FloatArray:
        """θ = [a, b, c, e, φ]."""
        return np.concatenate([self.a, self.b.ravel(), [self.c], self.e, self.phi])

    def moved(self, step: FloatArray) -> "Stage":
        """The stage of θ + step."""
        ends = np.cumsum([self.a.size, self.b.size, 1, self.e.size])
        a, b, c, e, phi = np.split(self.vector() + step, ends)
        return Stage(a, b.reshape(self.b.shape), float(c[0]), e, phi)

    @property
    def radius(self) -> float:
        """Of its filter's slowest pole."""
        return float(np.abs(np.roots(np.concatenate([[1.0], -self.a]))).max(initial=0.0))


def lagged(signal: FloatArray, lags: int) -> FloatArray:
    """(lags + 1, N, …): the signal delayed by 0 … lags samples, zero before it begins."""
    rows = np.zeros((lags + 1, *signal.shape))
    for k in range(lags + 1):
        rows[k, k:] = signal[: len(signal) - k]
    return rows


def moving_sum(b: FloatArray, signal: FloatArray) -> FloatArray:
    """Σ_k b_k signal(t - k) of (…, N), zero before it begins."""
    found = b[0] * signal
    for k, weight in enumerate(b[1:], 1):
        found[..., k:] += weight * signal[..., :-k]
    return np.asarray(found)


def simulate_loop(loop: Stage, basis: Basis, u: FloatArray, start: FloatArray) -> FloatArray:
    """y (N,) from its first n samples; held at DIVERGED where it grows beyond all measure."""
    n = len(loop.a)
    forcing = (loop.c + np.einsum("ktq,kq->t", lagged(u, n), loop.b)).tolist()
    values, per, low = (basis.rows @ loop.phi).tolist(), KNOTS / (basis.high - basis.low), basis.low
    rises, last = [*np.diff(values).tolist(), 0.0], float(KNOTS)
    terms = list(zip(range(1, n + 1), loop.a.tolist(), loop.e[1:].tolist(), strict=True))

    def mapped(y: float) -> float:
        position = min(max((y - low) * per, 0.0), last)
        i = int(position)
        return values[i] + (position - i) * rises[i]  # type: ignore[no-any-return]

    y = start.tolist()
    w = [mapped(value) for value in y]
    for t in range(n, len(forcing)):
        value = forcing[t]
        for k, a, e in terms:
            value += a * y[t - k] + e * w[t - k]
        if not -DIVERGED < value < DIVERGED:
            value = min(max(value, -DIVERGED), DIVERGED)
        y.append(value)
        w.append(mapped(value))
    return np.array(y)


def loop_sensitivities(
    loop: Stage, basis: Basis, trial: Trial, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """∂y/∂θ (P, N) and ∂y/∂start (n, N) of the loop's simulation y."""
    n, N, q = len(loop.a), len(y), trial.u.shape[1]
    responses = basis.responses(y)
    none = np.zeros((1, N))
    direct = np.concatenate(
        [
            lagged(y, n)[1:],
            lagged(trial.u, n).transpose(0, 2, 1).reshape(-1, N),
            none + 1.0,
            none,
            lagged(loop.phi @ responses, n)[1:],
            moving_sum(loop.e, responses),
            np.zeros((n, N)),
        ]
    )
    direct[:, :n] = 0.0
    direct[-n:, :n] = np.eye(n)
    slopes, bands = basis.slopes(loop.phi, y), np.zeros((n + 1, N))
    bands[0] = 1.0
    for k in range(1, n + 1):
        bands[k, n - k : N - k] = -(loop.a[k - 1] + loop.e[k] * slopes[n - k : N - k])
    moved = solve_banded((n, 0), bands, direct.T, check_finite=False).T
    shared = n + (n + 1) * q + 1 + len(loop.e) + len(loop.phi)
    return moved[:shared], moved[shared:]


def simulate_stages(
    stages: Sequence[Stage], basis: Basis, trial: Trial
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Every stage's y (N,), all with the same first samples, and what the maps give (N,)."""
    inputs = lagged(trial.u, len(stages[0].a))
    ys: list[FloatArray] = []
    ws: list[FloatArray] = []
    for stage in stages:
        n, A = len(stage.a), np.concatenate([[1.0], -stage.a])
        forcing = stage.c + np.einsum("ktq,kq->t", inputs, stage.b)
        if ys:
            ws.append(np.asarray(stage.phi @ basis.responses(ys[-1])))
            forcing += moving_sum(stage.e, ws[-1])
        forcing[:n] = moving_sum(A, trial.start)
        ys.append(lfilter([1.0], A, forcing))
    return ys, ws


def stage_sensitivities(
    stages: Sequence[Stage], basis: Basis, trial: Trial, ys: list[FloatArray], ws: list[FloatArray]
) -> FloatArray:
    """∂y/∂θ (P, N) of the last stage."""
    N = len(trial.u)
    moved: FloatArray = np.zeros((0, N))
    for k, stage in enumerate(stages):
        n = len(stage.a)
        inputs = lagged(trial.u, n).transpose(0, 2, 1).reshape(-1, N)
        direct = [lagged(ys[k], n)[1:], inputs, np.ones((1, N))]
        if k:
            before = basis.slopes(stage.phi, ys[k - 1]) * moved
            direct = [
                moving_sum(stage.e, before),
                *direct,
                lagged(ws[k - 1], n),
                moving_sum(stage.e, basis.responses(ys[k - 1])),
            ]
        forcing = np.concatenate(direct)
        forcing[:, :n] = 0.0
        moved = lfilter([1.0], np.concatenate([[1.0], -stage.a]), forcing)
    return moved


def minimise_loop(
    loop: Stage, basis: Basis, trials: Sequence[Trial], *, steps: int, tolerance: float
) -> tuple[float, Stage, list[Trial]]:
    """(rms error, the loop, the trials with the starts that fit best) at a local minimum."""
    n, P = len(loop.a), len(loop.vector())
    free = np.ones(P, dtype=bool)
    free[P - len(loop.phi) - len(loop.e)] = False  # e[0]

    def taken(theta: FloatArray) -> tuple[Stage, FloatArray]:
        return loop.moved(theta[:P] - loop.vector()), theta[P:].reshape(-1, n)

    def cost(theta: FloatArray) -> float:
        here, starts = taken(theta)
        return mean_square(
            [
                (simulate_loop(here, basis, trial.u, start) - trial.y)[trial.skipped :]
                for trial, start in zip(trials, starts, strict=True)
            ]
        )

    def normal(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        here, starts = taken(theta)
        H, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        for i, (trial, start) in enumerate(zip(trials, starts, strict=True)):
            y = simulate_loop(here, basis, trial.u, start)
            shared, own = loop_sensitivities(here, basis, trial, y)
            shared[~free] = 0.0
            J = np.concatenate([shared, own])[:, trial.skipped :]
            at = np.r_[0:P, P + i * n : P + (i + 1) * n]
            H[np.ix_(at, at)] += J @ J.T
            gradient[at] += J @ (y - trial.y)[trial.skipped :]
        return H, gradient

    begin = np.concatenate([loop.vector(), *(trial.start for trial in trials)])
    theta, reached, _ = descend(
        begin,
        cost,
        normal,
        steps=steps,
        tolerance=tolerance,
        damping=FIRST_DAMPING,
        patience=PATIENCE,
    )
    found, starts = taken(theta)
    moved = [replace(trial, start=start) for trial, start in zip(trials, starts, strict=True)]
    return reached**0.5, found, moved


def minimise_stages(
    stages: Sequence[Stage],
    basis: Basis,
    trials: Sequence[Trial],
    *,
    radius: float,
    steps: int,
    tolerance: float,
) -> tuple[float, list[Stage]]:
    """(rms error, the stages) at a local minimum with poles within the radius."""

    def taken(theta: FloatArray) -> list[Stage]:
        ends = np.cumsum([len(stage.vector()) for stage in stages])[:-1]
        parts = np.split(theta, ends)
        return [s.moved(part - s.vector()) for s, part in zip(stages, parts, strict=True)]

    def cost(theta: FloatArray) -> float:
        here = taken(theta)
        if max(stage.radius for stage in here) > radius:
            return float("inf")
        return mean_square(stage_errors(here, basis, trials))

    def normal(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        here = taken(theta)
        H, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        for trial in trials:
            ys, ws = simulate_stages(here, basis, trial)
            J = stage_sensitivities(here, basis, trial, ys, ws)[:, trial.skipped :]
            H += J @ J.T
            gradient += J @ (ys[-1] - trial.y)[trial.skipped :]
        return H, gradient

    begin = np.concatenate([stage.vector() for stage in stages])
    theta, reached, _ = descend(
        begin,
        cost,
        normal,
        steps=steps,
        tolerance=tolerance,
        damping=FIRST_DAMPING,
        patience=PATIENCE,
    )
    return reached**0.5, taken(theta)


def stage_errors(
    stages: Sequence[Stage], basis: Basis, trials: Sequence[Trial]
) -> list[FloatArray]:
    """What the last stage is off at the scored samples of each trial."""
    return [
        (simulate_stages(stages, basis, trial)[0][-1] - trial.y)[trial.skipped :]
        for trial in trials
    ]


def mean_square(errors: Sequence[FloatArray]) -> float:
    """Over all of them."""
    every = np.concatenate(errors)
    return float(every @ every) / len(every)
