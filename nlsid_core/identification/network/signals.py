"""Signals one after the other: what filters and static maps make of inputs, and its derivatives.

    s(t) = Σ_k w_k r(t - k),   r: an input, 1, a signal before it or itself, or a map f of those

So they are simulated one after the other: each by a filter, or by a loop over its samples where its
own past passes a map. With all signals known their derivatives in all parameters pass the same
filters, whose coefficients then vary with the slopes of a signal's own maps: a banded system each.
Source: the sensitivities are those of linear filters, each a filter itself.
"""

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_banded
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.identification.network.maps import Map, as_piecewise_linear
from nlsid_core.models import PiecewiseLinear

NONE: IntArray = np.zeros(0, dtype=np.int64)  # taps without parameters
TOGETHER = 8  # trials whose loops are quicker all at once
DIVERGED = 1e3  # spreads of a signal, at which a loop's simulation is held


@dataclass(frozen=True, eq=False)
class Taps:
    """Σ_k w_k r(t - first - k): w are the parameters `at` times `factor`; without any, `factor`.

    source: the number of r among the inputs, 1, and the nodes.
    """

    source: int
    at: IntArray
    first: int = 0
    factor: float = 1.0

    def weights(self, theta: FloatArray) -> list[tuple[int, float]]:
        """(delay, weight) of each."""
        values = theta[self.at] if len(self.at) else np.ones(1)
        return list(enumerate((self.factor * values).tolist(), self.first))


@dataclass(frozen=True, eq=False)
class Signal:
    """The sum of taps; its first `given` samples are given."""

    taps: tuple[Taps, ...]
    given: int = 0


@dataclass(frozen=True, eq=False)
class Mapped:
    """A map of the signal with number `source`, with the parameters `at`."""

    source: int
    function: Map
    at: IntArray


@dataclass(frozen=True, eq=False)
class Trial:
    """u (N, q) and y (N,), scaled. start: the given first samples of all signals, in their order.

    Or several trials of one length, with one more axis before these. The first `skipped` samples
    are not scored. held: before the trial every input was what it is at the first sample, for ever;
    else all was zero.
    """

    u: FloatArray
    y: FloatArray
    start: FloatArray
    skipped: int
    held: bool = False


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals and maps of them, each after those it depends on; a signal's own maps follow it.

    Numbered from 0: the inputs, 1, the nodes. free: the given samples are parameters, of each trial
    its own. output: the number of y.
    """

    inputs: int
    nodes: tuple[Signal | Mapped, ...]
    output: int
    free: bool = False

    @cached_property
    def given(self) -> int:
        """How many samples are given, of all signals."""
        return sum(node.given for node in self.nodes if isinstance(node, Signal))

    @cached_property
    def parameters(self) -> int:
        """How many there are."""
        return 1 + max(
            int(part.at.max(initial=-1))
            for node in self.nodes
            for part in (node.taps if isinstance(node, Signal) else (node,))
        )

    @cached_property
    def chained(self) -> set[int]:
        """The numbers whose derivatives another one needs, and that of y."""
        later = {
            part.source
            for number, node in enumerate(self.nodes, self.inputs + 1)
            if isinstance(node, Signal)
            for part in node.taps
            if part.source < number
        }
        return later | {self.output}

    def own_maps(self, number: int) -> list[tuple[Taps, Mapped]]:
        """The taps of a signal that are of maps of it."""
        node, first = self.nodes[number - self.inputs - 1], self.inputs + 1
        assert isinstance(node, Signal)
        return [(p, self.nodes[p.source - first]) for p in node.taps if p.source > number]  # type: ignore[misc]

    def own_filter(self, number: int, theta: FloatArray) -> FloatArray:
        """A = [1, -a₁, …] of a signal's own past, its maps left out."""
        taps = self.nodes[number - self.inputs - 1].taps  # type: ignore[union-attr]
        own = [part.weights(theta) for part in taps if part.source == number]
        return np.array([1.0, *(-weight for weights in own for _, weight in weights)])

    def radius(self, theta: FloatArray) -> float:
        """Of the slowest pole of the signals whose past passes no map."""
        slowest = 0.0
        for number, node in enumerate(self.nodes, self.inputs + 1):
            if isinstance(node, Signal) and not self.own_maps(number):
                roots = np.roots(self.own_filter(number, theta))
                slowest = max(slowest, float(np.abs(roots).max(initial=0.0)))
        return slowest

    def run(self, theta: FloatArray, trial: Trial) -> list[FloatArray]:
        """Inputs, 1 and nodes, (N,) each, along a trial; (T, N) along several."""
        sources, first = [*np.moveaxis(trial.u, -1, 0), np.ones(trial.u.shape[:-1])], 0
        for number, node in enumerate(self.nodes, self.inputs + 1):
            if isinstance(node, Mapped):
                x = sources[node.source]
                sources.append(node.function.values(theta[node.at], x.ravel()).reshape(x.shape))
                continue
            start = trial.start[..., first : first + node.given]
            first += node.given
            forcing = np.zeros(trial.u.shape[:-1])
            for part in node.taps:
                if part.source < number:
                    forcing += passed(part.weights(theta), sources[part.source], trial)
            A = self.own_filter(number, theta)
            if own := self.own_maps(number):
                sources.append(_looped(A, own, theta, forcing, start))
            else:
                sources.append(_filtered(A, forcing, start, trial))
        return sources

    def sensitivities(
        self, theta: FloatArray, trial: Trial
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """`run`, and the derivatives (G + P, …) of each in [start; θ]; G: of free starts."""
        sources, first, shape = self.run(theta, trial), 0, trial.u.shape[:-1]
        G = self.given if self.free else 0
        moved: list[FloatArray] = [np.zeros((G + len(theta), *shape))] * (self.inputs + 1)
        live: list[list[int]] = [[]] * (self.inputs + 1)  # the rows that are not zero
        for number, node in enumerate(self.nodes, self.inputs + 1):
            direct = np.zeros((G + len(theta), *shape))
            if isinstance(node, Mapped):
                p, x, rows = theta[node.at], sources[node.source].ravel(), live[node.source]
                if number in self.chained:
                    slopes = node.function.slopes(p, x).reshape(shape)
                    direct[rows] = slopes * moved[node.source][rows]
                    direct[G + node.at] += node.function.moves(p, x).reshape(-1, *shape)
                moved.append(direct)
                live.append(sorted({*rows, *(G + node.at).tolist()}))
                continue
            for part in node.taps:
                source = sources[part.source]
                for k, at in enumerate(part.at, part.first):
                    direct[G + at] += part.factor * delayed(source, k, trial)
                if self.inputs < part.source < number:
                    rows = live[part.source]
                    direct[rows] += passed(part.weights(theta), moved[part.source][rows], trial)
            own, A = self.own_maps(number), self.own_filter(number, theta)
            for part, one in own:
                moves = one.function.moves(theta[one.at], sources[number].ravel())
                direct[G + one.at] += passed(part.weights(theta), moves.reshape(-1, *shape), trial)
            direct[..., : node.given] = 0.0
            if self.free:
                for k in range(node.given):
                    direct[first + k, ..., k] = 1.0
            first += node.given
            rows = np.flatnonzero(direct.reshape(len(direct), -1).any(axis=1)).tolist()
            if own:
                for which in np.ndindex(shape[:-1]):
                    bands = _bands(A, own, theta, sources[number][which], node.given)
                    here = (rows, *which)
                    depth = (len(bands) - 1, 0)
                    direct[here] = solve_banded(depth, bands, direct[here].T, check_finite=False).T
            else:
                direct[rows] = _filtered(A, direct[rows], np.zeros(node.given), trial)
            moved.append(direct)
            live.append(rows)
        return sources, moved


def delayed(signal: FloatArray, samples: int, trial: Trial) -> FloatArray:
    """(…, N): signal(t - samples), before its first sample zero or held."""
    moved = np.zeros_like(signal)
    moved[..., :samples] = signal[..., :1] if trial.held else 0.0
    moved[..., samples:] = signal[..., : signal.shape[-1] - samples]
    return moved


def passed(weights: list[tuple[int, float]], signal: FloatArray, trial: Trial) -> FloatArray:
    """(…, N): Σ weight·signal(t - delay)."""
    total, N = np.zeros_like(signal), signal.shape[-1]
    for k, weight in weights:
        total[..., k:] += weight * signal[..., : N - k]
        if trial.held:
            total[..., :k] += weight * signal[..., :1]
    return total


def _filtered(A: FloatArray, forcing: FloatArray, start: FloatArray, trial: Trial) -> FloatArray:
    """(…, N): forcing through 1/A, from the given first samples, from rest or from a held past."""
    if not forcing.size:  # nothing moves, as in a flat map's first step
        return forcing
    if given := start.shape[-1]:
        forcing = forcing.copy()
        forcing[..., :given] = lfilter(A, [1.0], start)  # what makes them the first samples
        return np.asarray(lfilter([1.0], A, forcing))
    before = forcing[..., :1] if trial.held else np.zeros(1)
    return np.asarray(lfilter([1.0], A, forcing - before) + before / np.sum(A))


def _looped(
    A: FloatArray,
    own: list[tuple[Taps, Mapped]],
    theta: FloatArray,
    forcing: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """(…, N) through its one map, held at DIVERGED where it grows beyond all measure."""
    [(part, one)] = own
    f = as_piecewise_linear(one.function, theta[one.at])
    a, weights = list(enumerate((-A[1:]).tolist(), 1)), part.weights(theta)
    if forcing.ndim == 1:
        return _one_looped(f, a, weights, forcing, start)
    if len(forcing) < TOGETHER:
        pairs = zip(forcing, start, strict=True)
        return np.array([_one_looped(f, a, weights, *each) for each in pairs])
    y, mapped = np.empty_like(forcing.T), np.empty_like(forcing.T)
    given = start.shape[-1]
    y[:given], mapped[:given] = start.T, f(start.T)
    for t in range(given, len(y)):
        value = forcing[:, t].copy()
        for k, weight in a:
            value += weight * y[t - k]
        for k, weight in weights:
            value += weight * mapped[t - k]
        np.minimum(np.maximum(value, -DIVERGED), DIVERGED, out=y[t])
        mapped[t] = f(y[t])
    return y.T


def _one_looped(
    f: PiecewiseLinear,
    a: list[tuple[int, float]],
    weights: list[tuple[int, float]],
    forcing: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """(N,), in plain numbers, which is quicker for one or few."""
    inner, slopes = f.knots[1:-1].tolist(), f.slopes.tolist()
    levels = (f.values[:-1] - f.slopes * f.knots[:-1]).tolist()
    y, mapped = start.tolist(), f(start).tolist()
    for value in forcing[len(y) :].tolist():
        for k, weight in a:
            value += weight * y[-k]
        for k, weight in weights:
            value += weight * mapped[-k]
        if not -DIVERGED <= value <= DIVERGED:
            value = min(max(value, -DIVERGED), DIVERGED)
        y.append(value)
        i = bisect_right(inner, value)
        mapped.append(levels[i] + slopes[i] * value)
    return np.array(y)


def _bands(
    A: FloatArray,
    own: list[tuple[Taps, Mapped]],
    theta: FloatArray,
    signal: FloatArray,
    given: int,
) -> FloatArray:
    """The system of the derivatives of a signal whose own past passes maps, by diagonals."""
    N, terms = len(signal), [(k, np.full(len(signal), a)) for k, a in enumerate(A[1:], 1)]
    for part, one in own:
        slopes = one.function.slopes(theta[one.at], signal)
        terms += [(k, -weight * slopes) for k, weight in part.weights(theta)]
    bands = np.zeros((1 + max(k for k, _ in terms), N))
    bands[0] = 1.0
    for k, values in terms:
        bands[k, given - k : N - k] += values[given - k : N - k]
    return bands
