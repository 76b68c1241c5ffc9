"""`identify_feedback`: a filter with feedback through a static map, unrolled until it is proved.

    y = c + Σ a_k y_-k + Σ b_k u_-k + Σ e_k φ(y_-k)
(Lur'e), fitted by simulation error, is a `CellNetwork` whose one map stands in a loop. It is stable
for every input only where its damping is large beside the slopes of φ. Elsewhere it is unrolled,
    y_0 = G_0 u,    y_s = G_s u + H_s φ_s(y_{s-1}),    s = 1 … K:
stable filters in a row are stable whatever the maps are. The stages imitate the loop on inputs that
nobody recorded, phases drawn at random and sizes beyond those of the trials, and on the trials; a
loop that answers a stronger input well thus hands that on. K is chosen by held-back trials.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, ShapeError
from nlsid_core.identification.fit import Step
from nlsid_core.identification.network.feedback_fit import (
    DIVERGED,
    KNOTS,
    Basis,
    Stage,
    Trial,
    lagged,
    mean_square,
    minimise_loop,
    minimise_stages,
    simulate_loop,
    simulate_stages,
    stage_errors,
)
from nlsid_core.identification.network.options import Feedback, Network
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.identification.regressors import signal_scale
from nlsid_core.identification.starts import autoregression, reflected
from nlsid_core.models import CellNetwork, PiecewiseLinear
from nlsid_core.models.cell_network import PRIOR
from nlsid_core.models.signal import signals_of
from nlsid_core.progress import Progress

SHAPES: tuple[Callable[[FloatArray], FloatArray], ...] = (  # of φ at the start, y in its range
    lambda y: y**3,
    lambda y: y**2,
    lambda y: np.tanh(4.0 * y),
)
ROOM = 1.3  # times the range of y: where the maps end, and the largest of the inputs imitated
SIZES = (0.9, 1.5)  # of these inputs, in those of the trials
LENGTH = 500  # samples of an input that is imitated
FITTED = 30_000  # samples of the trials that the stages are fitted to, beside them
LOOP_STEPS, LOOP_TOLERANCE = 60, 1e-4
TOLERANCE = 2e-3  # relative gain of a step of the stages
WORTH = 0.98  # of the held-back error, that a further stage has to reach
SMALLEST = 1e-3  # rms error in spreads of y, below which a start is not trusted


@dataclass(frozen=True, eq=False)
class Scaled:
    """Trials in spreads: y mean and spread, u means and spreads (q,), and the trials."""

    y: tuple[float, float]
    u: tuple[FloatArray, FloatArray]
    trials: list[Trial]

    @classmethod
    def of(
        cls,
        data: Dataset,
        model_class: Network[Feedback],
        transient: int,
        like: "Scaled | None" = None,
    ) -> "Scaled":
        """Raises ShapeError for several outputs, DataError on too little or constant data."""
        if data.trajectories[0].y.shape[1] != 1:
            raise ShapeError(
                "feedback through a map has one output; the data have "
                f"{data.trajectories[0].y.shape[1]}"
            )
        n, skipped = model_class.structure.lags, max(transient, 0)
        for trial in data:
            if len(trial) <= 3 * max(skipped, model_class.start_samples):
                raise DataError(
                    f"{trial.name or 'trajectory'}: {len(trial)} samples, of which the first "
                    f"{max(skipped, model_class.start_samples)} are not scored; give more than "
                    "three times as many, or fewer start_samples"
                )
        if like is None:
            mean, spread = signal_scale(data, "y")
            y, u = (float(mean[0]), float(spread[0])), signal_scale(data, "u")
        else:
            y, u = like.y, like.u
        trials = []
        for t in data:
            outputs = (t.y[:, 0] - y[0]) / y[1]
            trials.append(Trial((t.u - u[0]) / u[1], outputs, outputs[:n], skipped))
        return cls(y, u, trials)


def identify_loop(
    scaled: Scaled, model_class: Network[Feedback]
) -> tuple[float, Stage, Basis, list[Trial]]:
    """(rms error in spreads of y, the loop, its maps, the trials with the starts that fit it).

    The best of the minima from the equation errors with a few maps. Raises Infeasible if there is
    none that does not diverge.
    """
    y = np.concatenate([trial.y for trial in scaled.trials])
    basis = _basis(y, model_class.structure.intervals)
    n, q = model_class.structure.lags, scaled.trials[0].u.shape[1]
    half, middle = 0.5 * np.ptp(y), 0.5 * (y.max() + y.min())
    found = []
    for shape in SHAPES:
        phi = basis.fitted(shape((basis.knots - middle) / half))
        rows, outputs = [], []
        for trial in scaled.trials:
            inputs = lagged(trial.u, n).transpose(0, 2, 1).reshape(-1, len(trial.y))
            mapped = lagged(phi @ basis.responses(trial.y), n)[1:]
            ones = np.ones((1, len(trial.y)))
            columns = np.concatenate([lagged(trial.y, n)[1:], inputs, ones, mapped])
            rows.append(columns[:, n:].T)
            outputs.append(trial.y[n:])
        theta = np.linalg.lstsq(np.concatenate(rows), np.concatenate(outputs), rcond=None)[0]
        a, b, c, e = np.split(theta, np.cumsum([n, (n + 1) * q, 1]))
        loop = Stage(a, b.reshape(n + 1, q), float(c[0]), np.concatenate([[0.0], e]), phi)
        found.append(
            minimise_loop(loop, basis, scaled.trials, steps=LOOP_STEPS, tolerance=LOOP_TOLERANCE)
        )
    error, loop, trials = min(found, key=lambda entry: entry[0])
    if not error < 1.0:
        raise Infeasible("no feedback through a map explains the data; give richer data or lags")
    return error, loop, basis, trials


def imitated(
    loop: Stage, basis: Basis, trials: Sequence[Trial], count: int, rng: np.random.Generator
) -> list[Trial]:
    """What the loop makes of inputs like those of the trials: every other one is as recorded, but
    larger or smaller; of the others the phases are drawn at random, the same for all inputs.
    """
    made, largest = [], ROOM * 0.5 * (basis.high - basis.low)
    middle = 0.5 * (basis.high + basis.low)
    for k in range(count):
        trial = trials[int(rng.integers(len(trials)))]
        first = int(rng.integers(max(1, len(trial.y) - LENGTH)))
        part, start = trial.u[first : first + LENGTH], trial.y[first : first + len(loop.a)]
        if k % 2:
            spectrum = np.fft.rfft(part, axis=0)
            turned = np.exp(2j * np.pi * rng.uniform(size=(len(spectrum), 1)))
            turned[0] = 1.0
            part = np.fft.irfft(spectrum * turned, len(part), axis=0)
        u = part * rng.uniform(*SIZES)
        y = simulate_loop(loop, basis, u, start)
        if np.abs(y - middle).max() < min(largest, DIVERGED):
            made.append(Trial(u, y, start, len(loop.a)))
    return made


def identify_unproved(
    train: Dataset, model_class: Network[Feedback], *, transient: int
) -> CellNetwork:
    """The loop as a network, which may be proved or not. Raises as `identify_feedback`."""
    scaled = Scaled.of(train, model_class, transient)
    error, loop, basis, trials = identify_loop(scaled, model_class)
    return network_of([loop], basis, scaled, trials, train, model_class, error, closed=True)


def identify_feedback(
    train: Dataset,
    fitted: Dataset,
    judged: Dataset,
    model_class: Network[Feedback],
    *,
    transient: int,
    slowest: float,
    steps: int,
    progress: Progress,
) -> tuple[CellNetwork, StabilityProof, tuple[Step, ...]]:
    """A proved `CellNetwork`, and the held-back rms errors that chose its maps.

    fitted, judged: what stages are fitted to while their number is chosen, and what chooses it;
    the chosen number is fitted again to `train`. slowest: radius of the filters' poles, at most.
    steps: of each fit, at most. Raises as `Scaled.of`, and Infeasible if nothing is found or
    proved.
    """
    scaled = Scaled.of(train, model_class, transient)
    error, loop, basis, trials = identify_loop(scaled, model_class)
    whole = network_of([loop], basis, scaled, trials, train, model_class, error, closed=True)
    proof = prove_stability(whole)
    if proof is not None and proof.rate <= slowest:
        return whole, proof, (Step("the loop itself", scaled.y[1] * error),)
    progress("feedback fitted", 0.2)
    few = Scaled.of(fitted, model_class, transient, scaled)
    _, first_loop, first_basis, few_trials = identify_loop(few, model_class)
    known = _known(first_loop, first_basis, few_trials, model_class)
    others = Scaled.of(judged, model_class, transient, scaled).trials
    rng = np.random.default_rng(model_class.seed + 1)
    unseen = imitated(first_loop, first_basis, few_trials, model_class.structure.imitated // 4, rng)
    stages, history, best = _linear(known, model_class.structure.lags, slowest), [], np.inf
    chosen = stages
    further = replace(first_loop, a=_within(first_loop.a, slowest))
    for maps in range(1, model_class.structure.stages + 1):
        _, stages = minimise_stages(
            [*stages, further],
            first_basis,
            known,
            radius=slowest,
            steps=steps,
            tolerance=TOLERANCE,
        )
        further = stages[-1]
        reached = _rms(stages, first_basis, [*others, *unseen])
        history.append(Step(f"{maps} map{'s' * (maps > 1)}", scaled.y[1] * reached))
        progress(history[-1].what, 0.2 + 0.6 * maps / model_class.structure.stages)
        if reached < WORTH * best:
            best, chosen = reached, stages
    _, stages = minimise_stages(
        chosen,
        basis,
        _known(loop, basis, trials, model_class),
        radius=slowest,
        steps=steps,
        tolerance=TOLERANCE,
    )
    error = _rms(stages, basis, trials)
    history.append(Step("fitted to all trials, training error", scaled.y[1] * error))
    model = network_of(stages, basis, scaled, trials, train, model_class, error)
    proof = prove_stability(model)
    if proof is None:
        raise Infeasible("no proof for the minimum found; try fewer stages or a smaller max_rate")
    return model, proof, tuple(history)


def _known(
    loop: Stage, basis: Basis, trials: Sequence[Trial], model_class: Network[Feedback]
) -> list[Trial]:
    """What stages are fitted to: trials, and what the loop makes of inputs that nobody recorded."""
    rng = np.random.default_rng(model_class.seed)
    return [
        *_shortened(trials),
        *imitated(loop, basis, trials, model_class.structure.imitated, rng),
    ]


def _linear(known: Sequence[Trial], lags: int, radius: float) -> list[Stage]:
    """The first stage, by least squares."""
    found = autoregression([(t.y[:, None], t.u) for t in known], lags)
    if found is None:
        raise DataError(f"too few samples for {lags} lags; give more data")
    none: FloatArray = np.zeros(0)
    a, b = found[0][:, 0, 0], found[1].reshape(lags + 1, -1)
    return [Stage(_within(a, radius), b, 0.0, none, none)]


def _rms(stages: Sequence[Stage], basis: Basis, trials: Sequence[Trial]) -> float:
    """Of the simulation error over the scored samples, in spreads of y."""
    return float(np.sqrt(mean_square(stage_errors(stages, basis, trials))))


def network_of(
    stages: Sequence[Stage],
    basis: Basis,
    scaled: Scaled,
    trials: Sequence[Trial],
    train: Dataset,
    model_class: Network[Feedback],
    error: float,
    *,
    closed: bool = False,
) -> CellNetwork:
    """The stages, or one loop, as a network of recorded signals; scaling is undone here.

    Stage s has the state x_i(t+1) = x_{i+1}(t) + a_i y(t) + b_i u(t) + e_i w(t), y = x_1 + c +
    b_0 u + e_0 w. The states are written in units in which those along the trials are white and,
    beside a start's error of `error`, as certain as `CellNetwork.start_from` takes them to be.
    """
    n, q = len(stages[0].a), len(scaled.u[0])
    size = n * len(stages)
    m = len(stages) - 1 + int(closed)
    width = m + size + q + 1
    after = np.zeros((size, width))
    into, maps, y = [], [], np.zeros(width)
    for s, stage in enumerate(stages):
        mapped = np.zeros(width)
        if closed or s:
            mapped[s - 1 + int(closed)] = 1.0
            maps.append(_saturated(basis, stage.phi))
        if s:
            into.append(y)
        first = m + s * n
        rows = np.eye(width)[first : first + n]
        drive = np.zeros((n + 1, width))
        drive[:, m + size : -1] = stage.b
        if closed or s:
            drive += np.outer(stage.e, mapped)
        y = rows[0] + drive[0]
        y[-1] += stage.c
        for i in range(n):
            after[s * n + i] = (rows[i + 1] if i + 1 < n else 0.0) + stage.a[i] * y + drive[i + 1]
        if closed:
            into.append(y)
    x = _states(stages, basis, trials, closed)
    middle, spread = x.mean(axis=0), x.std(axis=0)
    C = (
        np.cov((x - middle).T).reshape(size, size)
        + 1e-9 * np.diag(spread**2)
        + 1e-12 * np.eye(size)
    )
    T = cholesky(C, lower=True) * min(1.0, PRIOR / max(error, SMALLEST))
    inside = slice(m, m + size)

    def moved(row: FloatArray) -> FloatArray:
        """In the new states, x = middle + T x', and of recorded inputs."""
        found = row.copy()
        found[inside] = row[inside] @ T
        found[-1] += row[inside] @ middle
        found[m + size : -1] /= scaled.u[1]
        found[-1] -= found[m + size : -1] @ scaled.u[0]
        return found

    next_rows = np.array([moved(row) for row in after])
    next_rows[:, -1] -= middle
    next_rows = solve_triangular(T, next_rows, lower=True)
    output = scaled.y[1] * moved(y)
    output[-1] += scaled.y[0]
    first_trial = train.trajectories[0]
    return CellNetwork(
        maps=tuple(maps),
        into=np.array([moved(row) for row in into]).reshape(m, width),
        next=next_rows,
        output=output[None],
        start=np.zeros(size),
        start_samples=model_class.start_samples,
        period=train.period,
        y=signals_of(first_trial, "y"),
        u=signals_of(first_trial, "u"),
        bags=train.bags,
    )


def _states(
    stages: Sequence[Stage], basis: Basis, trials: Sequence[Trial], closed: bool
) -> FloatArray:
    """The states of all stages along the trials, (samples, states)."""
    n, found = len(stages[0].a), []
    for trial in trials:
        if closed:
            y_loop = simulate_loop(stages[0], basis, trial.u, trial.start)
            ys: list[FloatArray] = [y_loop]
            ws: list[FloatArray] = [np.asarray(stages[0].phi @ basis.responses(y_loop))]
        else:
            ys, ws = simulate_stages(stages, basis, trial)
            ws.insert(0, np.zeros(len(trial.u)))
        columns = []
        for stage, y, w in zip(stages, ys, ws, strict=True):
            past, inputs, maps = lagged(y, n), lagged(trial.u, n), lagged(w, n)
            e = stage.e if len(stage.e) else np.zeros(n + 1)
            for i in range(n):
                k = n - i  # terms: what the past says of y(t + i)
                columns.append(
                    stage.a[i:] @ past[1 : k + 1]
                    + np.einsum("ktq,kq->t", inputs[1 : k + 1], stage.b[i + 1 :])
                    + e[i + 1 :] @ maps[1 : k + 1]
                )
        found.append(np.array(columns).T[n:])
    return np.concatenate(found)


def _basis(y: FloatArray, intervals: int) -> Basis:
    half, middle = 0.5 * float(np.ptp(y)), 0.5 * float(y.max() + y.min())
    return Basis(middle - ROOM * half, middle + ROOM * half, intervals)


def _saturated(basis: Basis, phi: FloatArray) -> PiecewiseLinear:
    """The map, constant beyond its knots."""
    values, spacing = basis.rows @ phi, (basis.high - basis.low) / KNOTS
    knots = np.concatenate([[basis.low - spacing], basis.knots, [basis.high + spacing]])
    return PiecewiseLinear(knots, np.concatenate([values[:1], values, values[-1:]]))


def _within(a: FloatArray, radius: float) -> FloatArray:
    """The coefficients with poles outside the circle reflected, and slower ones at the radius."""
    theta = reflected(np.concatenate([[1.0], -a]), 0.999 * radius)
    return np.asarray(-theta[1:] / theta[0])


def _shortened(trials: Sequence[Trial]) -> list[Trial]:
    """The first trials, of FITTED samples in all."""
    kept, left = [], FITTED
    for trial in trials:
        if left > 3 * trial.skipped + len(trial.start):
            kept.append(replace(trial, u=trial.u[:left], y=trial.y[:left]))
        left -= len(trial.y)
    return kept
