"""`two_runs`: a pair of runs of a model that shows how tight a proved gain or index is.

Around inputs at rest, a small pulse gives the model's response there; where that is the largest (or
its real part the least), a long wave that swells and fades is put on one of two runs. What these
two reach is a bound from the other side: no gain below it is true of the model, up to rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.models import DifferenceEquation, StableModel
from nlsid_core.running.stepping import Stepper

PULSE = 1e-4  # of an input's range
FADED = 1e-5  # of a response's largest sample: from there on it is over
LONGEST = 4000  # samples of a response
PERIODS = 12  # memories that a wave lasts
SHORTEST = 400  # samples of a wave
ROUNDED = 1e-6  # of the outputs: a smaller difference is taken for rounding
LARGE = (1e-3, 0.1, 0.5)  # waves, of an input's range


@dataclass(frozen=True)
class TwoRuns:
    """What a pair of runs reaches: a gain is at least `value`, an index of passivity at most.

    frequency: of the wave, Hz. around: the inputs (n_u,) of the other run; amplitude: of the wave,
    in each input's unit, (n_u,).
    """

    value: float
    frequency: float
    around: tuple[float, ...]
    amplitude: tuple[float, ...]


def two_runs(
    model: StableModel,
    kind: str,
    reach: FloatArray,
    *,
    u_scales: FloatArray,
    y_scales: FloatArray,
    y_box: Sequence[Sequence[float]] | None = None,
) -> TwoRuns | None:
    """The best pair that is found, or None if no run settles or no input can move.

    kind: gain or passivity. reach: (n_u, 2), the range of each input. u_scales (n_u,), y_scales
    (n_y,): units of the differences. y_box: of the outputs, (n_y, 2), which both runs keep to.
    """
    found: TwoRuns | None = None
    low, high = reach.T
    if not (high > low).all():
        return None
    linear = isinstance(model, DifferenceEquation)
    centre = np.zeros(len(low))
    if isinstance(model, DifferenceEquation):  # its differences have no constant, nor its rounding
        model, centre = replace(model, c=0.0), (low + high) / 2
        low, high, reach = low - centre, high - centre, reach - centre[:, None]
    for part in (0.5,) if linear else (0.5, 0.1, 0.9):
        around = low + part * (high - low)
        try:
            start = _Rest.at(model, around)
            h = _response(start, around, PULSE * (high - low), u_scales, y_scales)
            frequency, direction = _best(h, kind)
            for amplitude in LARGE[:1] if linear else LARGE:
                size = 0.5 * amplitude * (high - low)
                seen = _pair(start, around, size, frequency, direction, len(h), reach)
                if y_box is not None and not _inside(seen[1:], np.array(y_box)):
                    continue
                if np.ptp(seen[1] - seen[2]) < ROUNDED * np.abs(seen[1]).max():
                    continue
                value = _value(seen[0] / u_scales, (seen[2] - seen[1]) / y_scales, kind)
                better = found is None or (
                    value > found.value if kind == "gain" else value < found.value
                )
                if better:
                    found = TwoRuns(
                        value, frequency / model.period, tuple(around + centre), tuple(size)
                    )
        except (NlsidError, ArithmeticError, np.linalg.LinAlgError):
            continue  # it does not come to rest here, or has no next output
    return found


@dataclass(frozen=True, eq=False)
class _Rest:
    """A model at rest: its stepper, and its state (n,)."""

    stepper: Stepper
    x: FloatArray

    @classmethod
    def at(cls, model: StableModel, u: FloatArray) -> "_Rest":
        """Under constant inputs u; DataError if it does not settle."""
        stepper = Stepper(model)
        lags = max(stepper.lags, 1)
        x = stepper.begin(np.zeros((lags, len(stepper.y))), np.tile(u, (lags, 1)))
        stepper.rest(u)
        for _ in range(5 * LONGEST):
            before = x
            x = stepper.advance(x[None], u)[1][0]
            if np.abs(x - before).max(initial=0.0) <= 1e-13 * np.abs(x).max(initial=1.0):
                return cls(stepper, x)
        raise DataError("the model does not come to rest")

    def run(self, u: FloatArray) -> FloatArray:
        """The outputs (N, p) under the inputs (N, n_u)."""
        stepper, x, y = self.stepper.ahead(), self.x[None], []
        for now in u:
            after, x = stepper.advance(x, now)
            y.append(after[0])
        return np.array(y)


def _response(
    start: _Rest, around: FloatArray, pulse: FloatArray, u_scales: FloatArray, y_scales: FloatArray
) -> FloatArray:
    """(T, p, q): outputs after a pulse of each input, per unit of it, in the scales."""
    rest = start.run(around[None])[0]
    found = []
    for i, size in enumerate(pulse):
        stepper, x, y = start.stepper.ahead(), start.x[None], []
        largest = 0.0
        for t in range(LONGEST):
            now = around.copy()
            now[i] += size * (t == 0)
            after, x = stepper.advance(x, now)
            y.append((after[0] - rest) / y_scales * (u_scales[i] / size))
            largest = max(largest, float(np.abs(y[-1]).max()))
            if t >= 50 and np.abs(y[-20:]).max() <= FADED * largest:
                break
        found.append(np.array(y))
    length = max(map(len, found))
    padded = [np.vstack([h, np.zeros((length - len(h), h.shape[1]))]) for h in found]
    return np.stack(padded, axis=2)


def _best(h: FloatArray, kind: str) -> tuple[float, FloatArray]:
    """The frequency, per sample, at which the response is worst, and the inputs' phases there."""
    count = 1 << (4 * len(h)).bit_length()
    G = np.fft.rfft(h, count, axis=0)
    if kind == "gain":
        _, s, V = np.linalg.svd(G)
        k = int(s[:, 0].argmax())
        return k / count, np.conj(V[k, 0])
    values, vectors = np.linalg.eigh((G + np.conj(G.transpose(0, 2, 1))) / 2.0)
    k = int(values[:, 0].argmin())
    return k / count, vectors[k, :, 0]


def _pair(
    start: _Rest,
    around: FloatArray,
    size: FloatArray,
    frequency: float,
    direction: FloatArray,
    memory: int,
    reach: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The difference of the inputs (N, n_u), and the outputs (N, p) of the two runs."""
    lasting = max(SHORTEST, PERIODS * memory)
    t = np.arange(lasting)
    swelling = np.sin(np.pi * (t + 0.5) / lasting)[:, None]
    wave = (direction * np.exp(2j * np.pi * frequency * t[:, None])).real * swelling
    wave = np.vstack([size * wave / np.abs(wave).max(), np.zeros((memory, len(around)))])
    moved = np.clip(around + wave, *reach.T)
    return moved - around, start.run(np.tile(around, (len(wave), 1))), start.run(moved)


def _inside(runs: Sequence[FloatArray], box: FloatArray) -> bool:
    return all(bool(((y >= box[:, 0]) & (y <= box[:, 1])).all()) for y in runs)


def _value(u: FloatArray, y: FloatArray, kind: str) -> float:
    if kind == "gain":
        return float(np.sqrt((y**2).sum() / (u**2).sum()))
    return float((u * y).sum() / (u**2).sum())
