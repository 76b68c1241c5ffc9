"""Identify a block cascade: random starts, Levenberg-Marquardt, structure chosen by validation.

The nonlinearity is linear in its coefficients, so a start is a random pair of all-pole filters with
the best f between them. A second phase and finer knots join while they lower the validation error.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.cascade import contracts, slope_range
from nlsid_core.errors import DataError, Infeasible, ShapeError
from nlsid_core.identification.cascade_residual import Blocks, over
from nlsid_core.models import BlockCascade, Signal, Spline
from nlsid_core.trajectory import Dataset, Trajectory

TRANSIENT = 100  # samples at the start of a trial that the zero state spoils; not fitted
START_SAMPLES = 10_000  # of the longest trial, enough to tell good starts from bad ones
START_KNOTS = 12
START_STEPS = 25
LM_STEPS = 60
LM_STOP = 1e-5  # relative decrease of the cost, twice in a row
DAMPING = (1e-2, 0.2, 4.0)  # first, factor after an accepted step, after a rejected one
MOST_DAMPING = 1e10
IMPROVEMENT = 0.002  # relative fall of the validation error that pays for more structure
KNOT_MARGIN = 0.02  # of the intermediate signal's range, beyond it on either side
SLOWEST_START, FASTEST_START = 0.3, 0.95  # radii of the random poles
RATE_ROOM = 0.02  # of 1 - |slowest pole| given up by the certified rate
COUPLING_FALL = 0.1
COUPLING_TRIES = 12


@dataclass(frozen=True)
class CascadeClass:
    """Which cascades: orders of both filters; ladders of knot intervals and of phases to try.

    starts: how many random starts; smoothing: weight of the squared second differences of f.
    """

    input_order: int
    output_order: int
    knots: tuple[int, ...] = (24, 48, 96)
    phases: tuple[int, ...] = (1, 2)
    starts: int = 12
    smoothing: float = 1e-8

    def __post_init__(self) -> None:
        if min(self.input_order, self.output_order) < 0 or self.starts < 1:
            raise DataError("orders should not be negative, and one start is needed at least")
        if not self.knots or not self.phases or min(*self.knots, *self.phases, 1) < 1:
            raise DataError("give at least one positive number of knots and of phases")


@dataclass(frozen=True, eq=False)
class CascadeProof:
    """P (n1+n2, n1+n2) and rate, decided exactly by the checker's code."""

    P: FloatArray
    rate: float

    def document(self, model: BlockCascade, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": {"file": file, "digest": _json.digest(model.document())}}
        claim = {"kind": "cascade_stability", "rate": self.rate, "about": about}
        return proof_document(claim, {"P": self.P.tolist()})


@dataclass(frozen=True)
class CascadeStep:
    """One structure that was tried: phases, knots, validation error (scaled), seconds so far."""

    phases: int
    knots: int
    validation: float
    seconds: float


@dataclass(frozen=True, eq=False)
class CascadeFit:
    """The cascade with the least validation error, its proof, and what was tried."""

    model: BlockCascade
    proof: CascadeProof
    history: tuple[CascadeStep, ...]


def identify_cascade(
    train: Dataset,
    validation: Dataset,
    model_class: CascadeClass,
    *,
    rng: np.random.Generator,
    progress: Callable[[str, float], None] | None = None,
) -> CascadeFit:
    """Fit on `train`, choose the structure on `validation`, prove the result.

    Trials start from the zero state; the first samples are not fitted. Raises ShapeError for
    several inputs or outputs, Infeasible if no exact proof is found.
    """
    first = train.trajectories[0]
    if first.y.shape[1] != 1 or first.u.shape[1] != 1:
        raise ShapeError("a block cascade has one input and one output")
    if min(len(trial) for trial in (*train, *validation)) <= 2 * TRANSIENT:
        raise DataError(f"every trial needs more than {2 * TRANSIENT} samples")
    report = progress if progress is not None else _silent
    started = time.perf_counter()
    u_scale = float(np.concatenate([t.u[:, 0] for t in train]).std())
    y_scale = float(np.concatenate([t.y[:, 0] for t in train]).std())
    if u_scale <= 0.0 or y_scale <= 0.0:
        raise DataError("the excitation or the response is constant: nothing can be identified")
    fitted = [_scaled(trial, u_scale, y_scale) for trial in train]
    held = [_scaled(trial, u_scale, y_scale) for trial in validation]
    blocks = _best_start(fitted, model_class, rng, report)
    best, error = blocks, np.inf
    history = []
    for knots in model_class.knots:
        improved = False
        for phases in model_class.phases:
            if phases < len(best.B1):
                continue
            candidate = _refined(_split(best, phases, fitted[0][0]), knots, fitted)
            candidate = _levenberg_marquardt(candidate, fitted, model_class.smoothing, LM_STEPS)
            scored = float(np.sqrt(_cost(candidate, held)))
            history.append(CascadeStep(phases, knots, scored, time.perf_counter() - started))
            report(f"{phases} phases, {knots} knots", 0.3 + 0.7 * len(history) / 6.0)
            if scored < error * (1.0 - IMPROVEMENT):
                best, error, improved = candidate, scored, True
        if not improved:
            break
    model = _model(best, train, u_scale, y_scale)
    proof = prove_cascade(model)
    if proof is None:
        raise Infeasible("no exact proof of the cascade was found; try lower orders")
    return CascadeFit(model, proof, tuple(history))


def prove_cascade(model: BlockCascade) -> CascadeProof | None:
    """V = d₁'P₁d₁ + ε d₂'P₂d₂ with the Lyapunov matrices of both filters, ε small enough."""
    n1, n2 = len(model.A1), len(model.A2)
    A1, A2 = _lag_form(model.A1), _lag_form(model.A2).T
    radius = max((np.max(abs(np.linalg.eigvals(A))) for A in (A1, A2) if len(A)), default=0.0)
    rate = float(radius + RATE_ROOM * (1.0 - radius))
    if not 0.0 < rate < 1.0:
        return None
    P1, P2 = (
        solve_discrete_lyapunov(A.T / rate, np.eye(len(A))) if len(A) else A for A in (A1, A2)
    )
    steepest = max(abs(float(s)) for s in slope_range(model)) * float(
        np.abs(model.B1).sum() * np.abs(model.B2).sum()
    )
    coupling = 1.0 / max(steepest, 1.0) ** 2
    for _ in range(COUPLING_TRIES):
        P = np.zeros((n1 + n2, n1 + n2))
        P[:n1, :n1] = P1 + P1.T
        P[n1:, n1:] = coupling * (P2 + P2.T)
        P /= np.abs(P).max()
        if contracts(model, P, rate) is None:
            return CascadeProof(P, rate)
        coupling *= COUPLING_FALL
    return None


Pair = tuple[FloatArray, FloatArray]


def _scaled(trial: Trajectory, u_scale: float, y_scale: float) -> Pair:
    return trial.u[:, 0] / u_scale, trial.y[:, 0] / y_scale


def _best_start(
    data: list[Pair],
    model_class: CascadeClass,
    rng: np.random.Generator,
    report: Callable[[str, float], None],
) -> Blocks:
    u, y = max(data, key=lambda pair: len(pair[0]))
    short = [(u[:START_SAMPLES], y[:START_SAMPLES])]
    best, least = None, np.inf
    for number in range(model_class.starts):
        report(f"start {number + 1} of {model_class.starts}", 0.3 * number / model_class.starts)
        start = _random_start(short[0], model_class, rng)
        found = _levenberg_marquardt(start, short, model_class.smoothing, START_STEPS)
        cost = _cost(found, short)
        if cost < least:
            best, least = found, cost
    assert best is not None, "there is at least one start"
    return best


def _random_start(data: Pair, model_class: CascadeClass, rng: np.random.Generator) -> Blocks:
    u, y = data
    A1, A2 = (
        _random_denominator(order, rng)
        for order in (model_class.input_order, model_class.output_order)
    )
    x = over(A1, u)
    B1 = np.zeros((1, len(A1) + 1))
    B1[0, 0] = 1.0 / x.std()
    B2 = np.eye(1, len(A2) + 1)
    blocks = Blocks(A1, B1, _knots_over(x * B1[0, 0], START_KNOTS), A2, B2)
    _, derivatives = blocks.sensitivities(u)
    spline = slice(len(A1) + B1.size, len(A1) + B1.size + len(blocks.f.c))
    basis = derivatives[spline, TRANSIENT:]
    curvature = np.diff(np.eye(len(blocks.f.c)), 2, axis=0)
    normal = basis @ basis.T + model_class.smoothing * len(u) * curvature.T @ curvature
    normal += 1e-12 * np.trace(normal) * np.eye(len(normal))
    c = np.linalg.solve(normal, basis @ y[TRANSIENT:])
    return replace(blocks, f=replace(blocks.f, c=c))


def _random_denominator(order: int, rng: np.random.Generator) -> FloatArray:
    radii = rng.uniform(SLOWEST_START, FASTEST_START, order)
    roots: list[complex] = []
    while len(roots) < order:
        radius = radii[len(roots)]
        if order - len(roots) == 1:
            roots.append(complex(radius))
        else:
            turn = np.exp(1j * rng.uniform(0.0, 0.5 * np.pi))
            roots += [radius * turn, radius * np.conj(turn)]
    return np.poly(roots)[1:].real.astype(np.float64) if roots else np.zeros(0)


def _knots_over(x: FloatArray, intervals: int) -> Spline:
    margin = KNOT_MARGIN * float(np.ptp(x))
    start, end = float(np.min(x)) - margin, float(np.max(x)) + margin
    step = (end - start) / intervals
    return Spline(start, step, start + step * np.arange(-1.0, intervals + 2.0))


def _refined(blocks: Blocks, intervals: int, data: list[Pair]) -> Blocks:
    """The same cascade with f on `intervals` knots over the range its input has now."""
    x = np.concatenate([blocks.intermediate(u)[1].ravel() for u, _ in data])
    f = _knots_over(x, intervals)
    points = np.linspace(f.start, f.end, 20 * intervals)
    first, weights = f.weights(points)
    basis = np.zeros((len(points), len(f.c)))
    for k in range(4):
        basis[np.arange(len(points)), first + k] = weights[:, k]
    c = np.linalg.lstsq(basis, blocks.f(points), rcond=None)[0]
    return replace(blocks, f=replace(f, c=c))


def _split(blocks: Blocks, phases: int, u: FloatArray) -> Blocks:
    """The same cascade with more phases: phase j sees the intermediate signal j/M samples later."""
    if len(blocks.B1) == phases:
        return blocks
    v, x = blocks.intermediate(u)
    frequencies = np.fft.rfftfreq(len(u)) * 2.0 * np.pi
    lags = np.stack([np.concatenate([np.zeros(k), v[: len(v) - k]])
                     for k in range(len(blocks.A1) + 1)])  # fmt: skip
    B1 = []
    for j in range(phases):
        delayed = np.fft.irfft(np.fft.rfft(x[0]) * np.exp(-1j * frequencies * j / phases), len(u))
        B1.append(np.linalg.lstsq(lags.T, delayed, rcond=None)[0])
    return replace(blocks, B1=np.array(B1), B2=np.repeat(blocks.B2[:1] / phases, phases, axis=0))


def _cost(blocks: Blocks, data: list[Pair]) -> float:
    """Mean squared residual after the transient."""
    total, count = 0.0, 0
    with np.errstate(all="ignore"):
        for u, y in data:
            residual = (blocks.simulate(u) - y)[TRANSIENT:]
            total += float(residual @ residual)
            count += len(residual)
    return total / count if np.isfinite(total) else np.inf


def _levenberg_marquardt(blocks: Blocks, data: list[Pair], smoothing: float, steps: int) -> Blocks:
    """Minimise the mean squared residual + smoothing·|second differences of f|²."""
    curvature = np.diff(np.eye(len(blocks.f.c)), 2, axis=0)
    begin = len(blocks.A1) + blocks.B1.size
    inside = slice(begin, begin + len(blocks.f.c))
    penalty = smoothing * curvature.T @ curvature
    count = sum(len(u) - TRANSIENT for u, _ in data)

    def cost(candidate: Blocks) -> float:
        c = candidate.f.c
        return _cost(candidate, data) + float(c @ penalty @ c)

    value, damping, calm = cost(blocks), DAMPING[0], 0
    for _ in range(steps):
        theta = blocks.vector()
        gradient, normal = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        for u, y in data:
            simulated, derivatives = blocks.sensitivities(u)
            derivatives = derivatives[:, TRANSIENT:]
            gradient += derivatives @ (simulated - y)[TRANSIENT:] / count
            normal += derivatives @ derivatives.T / count
        gradient[inside] += penalty @ blocks.f.c
        normal[inside, inside] += penalty
        scale = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
        scaled = normal / np.outer(scale, scale)
        while True:
            damped = scaled + damping * np.eye(len(theta))
            candidate = blocks.with_vector(
                theta - np.linalg.solve(damped, gradient / scale) / scale
            )
            new = cost(candidate) if candidate.is_stable() else np.inf
            if new < value:
                break
            damping *= DAMPING[2]
            if damping > MOST_DAMPING:
                return blocks
        calm = calm + 1 if value - new < LM_STOP * value else 0
        blocks, value, damping = candidate, new, damping * DAMPING[1]
        if calm == 2:
            break
    return blocks


def _model(blocks: Blocks, train: Dataset, u_scale: float, y_scale: float) -> BlockCascade:
    first = train.trajectories[0]
    inputs = np.concatenate([trial.u[:, 0] for trial in train])
    return BlockCascade(
        A1=blocks.A1,
        B1=blocks.B1,
        f=blocks.f,
        A2=blocks.A2,
        B2=blocks.B2,
        y_scale=y_scale,
        u_scale=u_scale,
        period=train.period,
        y=Signal(first.y_names[0], first.y_units[0], first.y_paths[0]),
        u=Signal(first.u_names[0], first.u_units[0], first.u_paths[0]),
        u_range=(float(inputs.min()), float(inputs.max())),
        bags=tuple((trial.name, trial.digest) for trial in train),
    )


def _lag_form(A: FloatArray) -> FloatArray:
    """Companion matrix of the state [v(t-1); …; v(t-n)] of 1/A."""
    matrix = np.diag(np.ones(max(len(A) - 1, 0)), -1) if len(A) else np.zeros((0, 0))
    if len(A):
        matrix[0] = -A
    return matrix


def _silent(_what: str, _fraction: float) -> None:
    return None
