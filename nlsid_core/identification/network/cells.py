"""`identify_cells`: contracting scalar cells in a row, that saturate and flow over, as a network.

    z_i = φ_i(x_i) + g_i(x_{i-1}) + γ_i (z_{i-1} - m_{i-1})₊ + b_i·u,
    x_i⁺ = min(z_i, m_i),   y = x_c,   or with friction   y⁺ = rest + z_c - min(max(z_c, -h), h):
dry friction h as the implicit Euler method has it, with sticking (z_c is then a force times time).
φ_i, g_i are linear between equally spaced knots. Slopes of φ_i in [0, ρ] make every such cascade
stable: V = Σ w^i Δx_i² decreases at a rate near ρ for a small w, what a cell gets from those before
it being bounded. Inside these bounds the simulation error is minimised, x(0) of every trial free,
with exact sensitivities: with all signals known they solve one bidiagonal system a cell.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product

import numpy as np
from scipy.linalg import solve_banded
from scipy.optimize import least_squares
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, ShapeError
from nlsid_core.identification.fit import Step
from nlsid_core.identification.network.options import CellRow, Network
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.models import CellNetwork, PiecewiseLinear
from nlsid_core.models.signal import signals_of

SMOOTHING = 1e-6  # of slopes of neighbouring intervals
POLES = (0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998)  # of the cells, at the start
LEAST_FRICTION = 1e-6
FRICTIONS = (0.1, 0.5)  # in spreads of y, what it takes from y at rest, at the start
TOPS = (1.0, 0.9, 0.75)  # quantiles of a hidden state at which it flows over, at the start
STARTS, KEPT = 3, 2  # combinations of poles; minima that are refined
START_SAMPLES, START_STEPS, START_INTERVALS = 5000, 20, 2
TOLERANCE = 1e-6
DIVERGED = 1e6  # a state in spreads: what the minimiser should not visit


@dataclass(frozen=True, eq=False)
class Trial:
    """u (N, q) and y (N,) in their spreads; the first `skipped` samples are not scored."""

    u: FloatArray
    y: FloatArray
    skipped: int


@dataclass(frozen=True, eq=False)
class Cascade:
    """c cells with K intervals: knots (c, K+1); level (c,); phi, g (c, K) slopes, of g[0] none.

    gamma, top, half, rest (c,), b (c, q); top is infinite where there is none, half (width of the
    dead zone) not a number; x0 (trials, c). g_i is zero at
    the first knot of x_{i-1}.
    """

    knots: FloatArray
    level: FloatArray
    phi: FloatArray
    g: FloatArray
    gamma: FloatArray
    top: FloatArray
    half: FloatArray
    rest: FloatArray
    b: FloatArray
    x0: FloatArray

    def pack(self) -> FloatArray:
        """The free numbers: of every cell, then x0."""
        parts = []
        for i in range(len(self.level)):
            parts += [self.level[i : i + 1], self.phi[i], self.b[i]]
            parts += [self.g[i]] if i else []
            if np.isfinite(self.half[i]):
                parts += [self.half[i : i + 1], self.rest[i : i + 1]]
            if np.isfinite(self.top[i]):
                parts += [self.top[i : i + 1], *([self.gamma[i : i + 1]] if i else [])]
        return np.concatenate([*parts, self.x0.ravel()])

    def places(self) -> list[dict[str, slice]]:
        """Where `pack` puts the numbers of each cell."""
        found, at = [], 0
        for i in range(len(self.level)):
            sizes = {"level": 1, "phi": self.phi.shape[1], "b": self.b.shape[1]}
            sizes |= {"g": self.g.shape[1]} if i else {}
            if np.isfinite(self.half[i]):
                sizes |= {"half": 1, "rest": 1}
            if np.isfinite(self.top[i]):
                sizes |= {"top": 1} | ({"gamma": 1} if i else {})
            cell = {}
            for name, size in sizes.items():
                cell[name] = slice(at, at + size)
                at += size
            found.append(cell)
        return found

    def unpacked(self, theta: FloatArray) -> "Cascade":
        """The same with other free numbers."""
        arrays = {
            k: getattr(self, k).copy()
            for k in ("level", "phi", "g", "gamma", "top", "half", "rest", "b")
        }
        for i, cell in enumerate(self.places()):
            for name, place in cell.items():
                arrays[name][i] = theta[place] if arrays[name].ndim > 1 else theta[place][0]
        return replace(self, **arrays, x0=theta[-self.x0.size :].reshape(self.x0.shape))

    def simulate(self, u: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States x and z, both (N, c), for inputs u (N, q)."""
        cells, K = len(self.level), self.phi.shape[1]
        rows = (u @ self.b.T).tolist()
        low, per = self.knots[:, 0].tolist(), (K / np.ptp(self.knots, axis=1)).tolist()
        knots, phi, g = self.knots.tolist(), self.phi.tolist(), self.g.tolist()
        widths = np.diff(self.knots, axis=1)
        at_knots = [
            np.concatenate([[0.0], np.cumsum(self.phi * widths, axis=1)[i]]) + self.level[i]
            for i in range(cells)
        ]
        own = [values.tolist() for values in at_knots]
        onward = [
            np.concatenate([[0.0], np.cumsum(self.g[i] * widths[i - 1])]).tolist()
            for i in range(cells)
        ]
        top, gamma = self.top.tolist(), self.gamma.tolist()
        half, rest = self.half.tolist(), self.rest.tolist()
        x, xs, zs = x0.tolist(), [], []
        for drive in rows:
            xs.append(x)
            after, z, flow = [], [], 0.0
            for i in range(cells):
                now = x[i]
                k = int(min(max((now - low[i]) * per[i], 0.0), K - 1.0))
                d = now - knots[i][k]
                value = own[i][k] + phi[i][k] * d + drive[i] + flow
                z.append(value)
                over = value - top[i]
                if half[i] == half[i]:
                    after.append(rest[i] + value - min(max(value, -half[i]), half[i]))
                else:
                    after.append(top[i] if over > 0.0 else value)
                if i + 1 < cells:
                    flow = onward[i + 1][k] + g[i + 1][k] * d
                    if over > 0.0:
                        flow += gamma[i + 1] * over
            zs.append(z)
            x = [min(max(v, -DIVERGED), DIVERGED) for v in after]
        return np.array(xs), np.array(zs)

    def sensitivities(self, trial: Trial, x: FloatArray, z: FloatArray, which: int) -> FloatArray:
        """∂y/∂θ (N, P) of trial number `which` from its states."""
        cells, K, N = len(self.level), self.phi.shape[1], len(trial.u)
        size, shared = len(self.pack()), len(self.pack()) - self.x0.size
        own = shared + which * cells
        used = np.r_[0:shared, own : own + cells]
        column = np.full(size, -1)
        column[used] = np.arange(len(used))
        before: FloatArray = np.zeros((0, 0))
        after, hinges_before, over_before = before, before, np.zeros(0)
        interval_before = np.zeros(0, dtype=int)
        for i, cell in enumerate(self.places()):
            k = np.clip((x[:, i] - self.knots[i, 0]) * K / np.ptp(self.knots[i]), 0, K - 1)
            index = k.astype(int)
            hinges = _hinges(self.knots[i], x[:, i])
            direct = np.zeros((N, len(used)))
            direct[:, cell["level"]] = 1.0
            direct[:, cell["phi"]] = hinges
            direct[:, cell["b"]] = trial.u
            if i:
                direct[:, cell["g"]] = hinges_before
                direct += self.g[i][interval_before][:, None] * before
                if "gamma" in cell:
                    flows = over_before > 0.0
                    direct[:, cell["gamma"]] = np.maximum(over_before, 0.0)[:, None]
                    direct += (self.gamma[i] * flows)[:, None] * after
            rubs = "half" in cell
            below = abs(z[:, i]) > self.half[i] if rubs else z[:, i] <= self.top[i]
            a = below * self.phi[i][index]
            forcing = np.zeros((N, len(used)))
            forcing[0, column[own + i]] = 1.0
            forcing[1:] = below[:-1, None] * direct[:-1]
            if "top" in cell:
                forcing[1:, cell["top"]] += ~below[:-1, None]
            if rubs:
                forcing[1:, cell["rest"]] += 1.0
                forcing[1:, cell["half"]] -= (below * np.sign(z[:, i]))[:-1, None]
            bands = np.ones((2, N))
            bands[1] = -a
            moved = solve_banded((1, 0), bands, forcing, overwrite_b=True, check_finite=False)
            after = direct + self.phi[i][index][:, None] * moved  # ∂(z - top)
            if "top" in cell:
                after[:, cell["top"]] -= 1.0
            over_before = z[:, i] - self.top[i]
            before, hinges_before, interval_before = moved, hinges, index
        J = np.zeros((N, size))
        J[:, used] = before
        return J


def identify_cells(
    train: Dataset, model_class: Network[CellRow], *, transient: int = 0, slowest: float, steps: int
) -> tuple[CellNetwork, StabilityProof, tuple[Step, ...]]:
    """A `CellNetwork` by simulation error, proved stable, and the rms errors of the search's steps.

    slowest: slope of φ_i, at most. steps: from each start, at most. Raises ShapeError for several
    outputs, DataError on too little or constant data, Infeasible if the minimum found has no proof.
    """
    data = [(t.u, t.y) for t in train]
    if data[0][1].shape[1] != 1:
        raise ShapeError(f"cells in a row have one output; the data have {data[0][1].shape[1]}")
    all_u, all_y = (np.concatenate([pair[i] for pair in data]) for i in (0, 1))
    if (np.ptp(all_y) == 0) or (np.ptp(all_u, axis=0) == 0).any():
        raise DataError("an input or the output is constant in all trials: nothing to identify")
    skipped = max(transient, 0)
    for t in train:
        if len(t) <= 3 * max(skipped, model_class.start_samples):
            raise DataError(
                f"{t.name or 'trajectory'}: {len(t)} samples, of which the first "
                f"{max(skipped, model_class.start_samples)} are not scored; give more than three "
                "times as many, or fewer start_samples"
            )
    scales = all_u.mean(axis=0), all_u.std(axis=0), float(all_y.mean()), float(all_y.std())
    trials = [
        Trial((u - scales[0]) / scales[1], (y[:, 0] - scales[2]) / scales[3], skipped)
        for u, y in data
    ]
    short = _shortened(trials)
    tried, done = [], []
    for poles in _best_poles(short, model_class.structure.cells, slowest):
        limits = list(product(TOPS, repeat=model_class.structure.cells - 1))
        if model_class.structure.limit != "top":
            limits = (
                [(h,) for h in FRICTIONS] if model_class.structure.limit == "friction" else [()]
            )
        for levels in limits:
            start = _start(short, poles, levels, model_class, -scales[2] / scales[3])
            tried.append(_minimised(start, short, slowest, START_STEPS))
            named = ", ".join(f"{pole:g}" for pole in poles)
            done.append(
                Step(
                    f"poles {named}, {model_class.structure.limit} {levels}",
                    scales[3] * tried[-1][0],
                )
            )
    found = []
    for _, cascade in sorted(tried, key=lambda entry: entry[0])[:KEPT]:
        wide = _with_trials(cascade, short, trials)
        finer = _with_intervals(wide, trials, model_class.structure.intervals)
        found.append(_minimised(finer, trials, slowest, steps))
        done.append(Step(f"{model_class.structure.intervals} intervals", scales[3] * found[-1][0]))
    model = _network(min(found, key=lambda entry: entry[0])[1], scales, train, model_class)
    proof = prove_stability(model)
    if proof is None:
        raise Infeasible("no proof for the minimum found; try fewer cells or a smaller max_rate")
    return model, proof, tuple(done)


def _hinges(knots: FloatArray, x: FloatArray) -> FloatArray:
    """(N, K): f(x) = level + hinges·slopes, f linear between the knots and on beyond them."""
    low, high = knots[:-1].copy(), knots[1:].copy()
    low[0], high[-1] = -np.inf, np.inf
    return np.asarray(np.clip(x[:, None], low, high) - np.maximum(low, knots[0]))


def _minimised(
    start: Cascade, trials: Sequence[Trial], slowest: float, steps: int
) -> tuple[float, Cascade]:
    """(rms error in spreads of y, the cascade) at a local minimum with slopes in [0, slowest]."""
    places, theta = start.places(), start.pack()
    low, high = np.full(len(theta), -np.inf), np.full(len(theta), np.inf)
    for cell in places:
        low[cell["phi"]], high[cell["phi"]] = 0.0, slowest
        if "half" in cell:
            low[cell["half"]] = LEAST_FRICTION
    smooth = [
        (place.start + k, place.start + k + 1)
        for cell in places
        for name, place in cell.items()
        if name in ("phi", "g")
        for k in range(place.stop - place.start - 1)
    ]
    bend = np.zeros((len(smooth), len(theta)))
    for row, (first, second) in enumerate(smooth):
        bend[row, first], bend[row, second] = -1.0, 1.0
    bend *= np.sqrt(SMOOTHING)
    samples = np.sqrt(sum(len(trial.y) - trial.skipped for trial in trials))

    def residual(values: FloatArray) -> FloatArray:
        cascade, parts = start.unpacked(values), []
        for trial, x0 in zip(trials, cascade.x0, strict=True):
            x, _ = cascade.simulate(trial.u, x0)
            parts.append((x[:, -1] - trial.y)[trial.skipped :] / samples)
        return np.concatenate([*parts, bend @ values])

    def jacobian(values: FloatArray) -> FloatArray:
        cascade, parts = start.unpacked(values), []
        for which, trial in enumerate(trials):
            x, z = cascade.simulate(trial.u, cascade.x0[which])
            moved = cascade.sensitivities(trial, x, z, which)
            parts.append(moved[trial.skipped :] / samples)
        return np.concatenate([*parts, bend])

    inside = np.clip(theta, low + 1e-9, high - 1e-9)
    found = least_squares(
        residual,
        inside,
        jac=jacobian,
        bounds=(low, high),
        x_scale="jac",
        ftol=TOLERANCE,
        xtol=TOLERANCE,
        max_nfev=steps,
    )
    error = found.fun[: len(found.fun) - len(bend)]
    return float(np.linalg.norm(error)), start.unpacked(found.x)


def _shortened(trials: Sequence[Trial]) -> list[Trial]:
    """The first trials, of about START_SAMPLES samples in all."""
    kept: list[Trial] = []
    left = START_SAMPLES
    for trial in trials:
        if left <= 0:
            break
        kept.append(replace(trial, u=trial.u[:left], y=trial.y[:left]))
        left -= len(trial.y)
    return kept


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
    model_class: Network[CellRow],
    still: float,
) -> Cascade:
    """The linear cascade with these poles, hidden states in their spreads; still: y of 0."""
    cells, q = len(poles), trials[0].u.shape[1]
    _, gains = _gains(trials, poles)
    paths = [_filtered(trial.u @ gains[:-1, None], poles) for trial in trials]
    x = [np.concatenate([path[i][:, 0] for path in paths]) for i in range(cells)]
    spread = np.array([max(float(np.std(part)), 1e-3) for part in x])
    spread[-1] = 1.0
    x[-1] = np.concatenate([trial.y for trial in trials])
    K = START_INTERVALS
    knots = np.array([_knots(part / s, K) for part, s in zip(x, spread, strict=True)])
    pole = np.array(poles)
    phi = np.repeat(pole[:, None], K, axis=1)
    gain = np.array([0.0, *((1.0 - pole[1:]) * spread[:-1] / spread[1:])])
    level = pole * knots[:, 0]
    level[1:] += gain[1:] * knots[:-1, 0]
    level[-1] += (1.0 - pole[-1]) * gains[-1]
    b = np.zeros((cells, q))
    b[0] = (1.0 - pole[0]) * gains[:-1] / spread[0]
    top, half, rest = np.full(cells, np.inf), np.full(cells, np.nan), np.zeros(cells)
    if model_class.structure.limit == "top":
        parts = zip(x, spread, (*levels, 1.0), strict=True)
        top = np.array([float(np.quantile(part / s, quantile)) for part, s, quantile in parts])
    elif model_class.structure.limit == "friction":
        half[-1], rest[-1] = levels[0] * (1.0 - pole[-1]), still
        level[-1] -= still
    x0 = np.array([[path[i][0, 0] / spread[i] for i in range(cells)] for path in paths])
    x0[:, -1] = [trial.y[0] for trial in trials]
    return Cascade(
        knots, level, phi, np.repeat(gain[:, None], K, axis=1), gain, top, half, rest, b, x0
    )


def _knots(x: FloatArray, intervals: int) -> FloatArray:
    """Equally spaced over the range of x, which is not a point."""
    middle, half = 0.5 * (x.min() + x.max()), max(0.5 * float(np.ptp(x)), 1e-3)
    return np.linspace(middle - half, middle + half, intervals + 1)


def _with_trials(cascade: Cascade, known: Sequence[Trial], trials: Sequence[Trial]) -> Cascade:
    """x0 of all trials: the mean of those known, and the first output, where it is not known."""
    x0 = np.tile(cascade.x0.mean(axis=0), (len(trials), 1))
    x0[:, -1] = [trial.y[0] for trial in trials]
    x0[: len(known)] = cascade.x0
    return replace(cascade, x0=x0)


def _with_intervals(cascade: Cascade, trials: Sequence[Trial], intervals: int) -> Cascade:
    """About the same maps on `intervals` intervals over the states that the trials visit."""
    x = np.concatenate(
        [cascade.simulate(t.u, x0)[0] for t, x0 in zip(trials, cascade.x0, strict=True)]
    )
    x[:, -1] = np.concatenate([trial.y for trial in trials])
    knots = np.array([_knots(part, intervals) for part in x.T])
    cells, shape = len(knots), (len(knots), intervals)
    level, phi, g = np.zeros(cells), np.zeros(shape), np.zeros(shape)
    for i in range(cells):
        values = cascade.level[i] + _hinges(cascade.knots[i], knots[i]) @ cascade.phi[i]
        level[i] += values[0]
        phi[i] = np.diff(values) / np.diff(knots[i])
        if i:
            values = _hinges(cascade.knots[i - 1], knots[i - 1]) @ cascade.g[i]
            level[i] += values[0]
            g[i] = np.diff(values) / np.diff(knots[i - 1])
    return replace(cascade, knots=knots, level=level, phi=phi, g=g)


def _network(
    cascade: Cascade,
    scales: tuple[FloatArray, FloatArray, float, float],
    train: Dataset,
    model_class: Network[CellRow],
) -> CellNetwork:
    """The cascade as a network of recorded signals: the only place where scaling is undone."""
    cells, q = cascade.b.shape
    saturates = np.isfinite(cascade.top)
    m = 2 * cells - 1 + int(saturates.sum()) + int(np.isfinite(cascade.half).sum())
    width = m + cells + q + 1
    maps: list[PiecewiseLinear] = []
    into, after = [], np.zeros((cells, width))
    onward: FloatArray = np.zeros(width)

    def added(f: PiecewiseLinear, row: FloatArray) -> FloatArray:
        maps.append(f)
        into.append(row)
        return _unit(len(maps) - 1, width)

    for i in range(cells):
        knots, widths = cascade.knots[i], np.diff(cascade.knots[i])
        state = _unit(m + i, width)
        values = cascade.level[i] + np.concatenate([[0.0], np.cumsum(cascade.phi[i] * widths)])
        z = added(PiecewiseLinear(knots, values), state) + onward
        z[m + cells : -1] += cascade.b[i] / scales[1]
        z[-1] -= float(cascade.b[i] @ (scales[0] / scales[1]))
        after[i] = z
        if saturates[i]:
            top = float(cascade.top[i])
            clip = PiecewiseLinear(np.array([top - 1, top, top + 1]), np.array([top - 1, top, top]))
            after[i] = added(clip, z)
        elif np.isfinite(cascade.half[i]):
            h, rest = float(cascade.half[i]), float(cascade.rest[i])
            ends, sticks = np.array([-h - 1, -h, h, h + 1]), np.array([-1.0, 0.0, 0.0, 1.0])
            after[i] = added(PiecewiseLinear(ends, rest + sticks), z)
        if i + 1 < cells:
            values = np.concatenate([[0.0], np.cumsum(cascade.g[i + 1] * widths)])
            onward = added(PiecewiseLinear(knots, values), state)
            onward = onward + cascade.gamma[i + 1] * (z - after[i]) * saturates[i]
    output = scales[3] * _unit(m + cells - 1, width) + scales[2] * _unit(width - 1, width)
    first = train.trajectories[0]
    return CellNetwork(
        maps=tuple(maps),
        into=np.array(into),
        next=after,
        output=output[None],
        start=cascade.x0.mean(axis=0),
        start_samples=model_class.start_samples,
        period=train.period,
        y=signals_of(first, "y"),
        u=signals_of(first, "u"),
        bags=train.bags,
    )


def _unit(i: int, size: int) -> FloatArray:
    row: FloatArray = np.zeros(size)
    row[i] = 1.0
    return row
