"""`MonotoneEquation`: an implicit difference equation, e(y(t)) = affine in the past, e increasing.

    e(ȳ(t)) = c + Σ_{k=1..n} a[k-1] ȳ(t-k) + Σ_j b[j] w_j(t),   e(v) = e[0] v + e[1] v² + e[2] v³

ȳ = y - y_offset; w stacks delayed inputs minus their offsets; e'(v) > 0 for every v, so that the
next output is unique.
Source: thesis (3.14).
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, freeze
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models.signal import FORMAT, Recorded, Signal, head, recorded, tail, window_of

KIND = "monotone_equation"
NEWTON_STEPS = 100  # far from the solution a cubic takes a third off the distance a step
BRACKET_ROOM = 1.0 + 1e-9  # for rounding in the bracket's ends
POSITIVE = 1e-9  # of the larger eigenvalue of a slope's matrix: what solvers round by
ROUNDING = 4 * float(np.finfo(float).eps)  # relative change of v below which it is found


@dataclass(frozen=True, eq=False)
class MonotoneEquation(Recorded):
    """e: (3,), a: (n,), b: (n_w,), c; window: (input, delay ≥ 0) of each entry of w.

    One output, n_u inputs, u_offset: (n_u,).
    Raises ShapeError or DataError on parts that do not fit, or if e is not increasing.
    """

    e: FloatArray
    a: FloatArray
    b: FloatArray
    c: float
    window: tuple[tuple[int, int], ...]
    y_offset: float
    u_offset: FloatArray
    y: Signal
    u: tuple[Signal, ...]

    def __post_init__(self) -> None:
        sizes = {"e": (3,), "a": (None,), "b": (len(self.window),), "u_offset": (len(self.u),)}
        freeze(self, "model", sizes)
        if not np.isfinite([self.c, self.y_offset]).all():
            raise DataError("a model's numbers should be finite")
        self.require_period()
        if not len(self.a):
            raise ShapeError("a monotone equation has at least one lag")
        if any(not (0 <= i < len(self.u) and d >= 0) for i, d in self.window):
            raise DataError(f"window {self.window} names inputs or delays that are not there")
        if not is_increasing(self.e):
            raise DataError(f"e = {self.e.tolist()} is not increasing everywhere")

    def __len__(self) -> int:
        """The number of lags n."""
        return len(self.a)

    def __str__(self) -> str:
        return (
            f"monotone equation: {len(self)} lags, {len(self.window)} inputs in its window, "
            f"{self.period:g} s a sample"
        )

    @property
    def history(self) -> int:
        """How many past samples a step looks back: the larger of n and the longest delay."""
        return max(len(self), *(d for _, d in self.window), 0)

    def forcing(self, u: FloatArray) -> FloatArray:
        """c + Σ_j b[j] w_j(t) for t = history … of inputs u (N, n_u); (N - history,)."""
        h, scaled = self.history, u - self.u_offset
        total = np.full(len(u) - h, self.c)
        for weight, (i, d) in zip(self.b, self.window, strict=True):
            total += weight * scaled[h - d : len(u) - d, i]
        return total

    def simulate(self, u: ArrayLike, y_start: ArrayLike | None = None) -> FloatArray:
        """Outputs (N,) for inputs u (N, n_u) or (N,), the first `history` outputs being y_start.

        None starts from y_offset, that is ȳ = 0. Raises ShapeError on shapes that do not fit.
        """
        inputs = np.asarray(u, dtype=np.float64)
        inputs = inputs[:, None] if inputs.ndim == 1 else inputs
        h = self.history
        if inputs.ndim != 2 or inputs.shape[1] != len(self.u) or len(inputs) < h:
            raise ShapeError(f"u should be (N, {len(self.u)}), N >= {h}; has {inputs.shape}")
        start = np.full(h, self.y_offset) if y_start is None else np.asarray(y_start, np.float64)
        if start.shape != (h,):
            raise ShapeError(f"y_start should be ({h},); has {start.shape}")
        outputs: list[float] = (start - self.y_offset).tolist()
        e, backwards, n = tuple(self.e.tolist()), self.a[::-1].tolist(), len(self)
        for force in self.forcing(inputs).tolist():
            for weight, past in zip(backwards, outputs[-n:], strict=True):
                force += weight * past
            outputs.append(solve_increasing(e, force, outputs[-1]))
        return np.array(outputs) + self.y_offset

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            **head(self, KIND),
            "e": self.e.tolist(),
            "a": self.a.tolist(),
            "b": self.b.tolist(),
            "c": self.c,
            "window": [list(entry) for entry in self.window],
            "y_offset": self.y_offset,
            "u_offset": self.u_offset.tolist(),
            **tail(self),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "MonotoneEquation":
        """Raises DocumentError if the document is not a monotone equation."""
        files.header(document, FORMAT, source=source, kind=KIND)
        window = window_of(document, source=source)
        return cls(
            e=files.array(document, "e", (3,), source=source),
            a=files.array(document, "a", (None,), source=source),
            b=files.array(document, "b", (len(window),), source=source),
            c=files.number(document, "c", source=source),
            window=window,
            y_offset=files.number(document, "y_offset", source=source),
            u_offset=files.array(document, "u_offset", (None,), source=source),
            **recorded(document, several=("u",), source=source),
        )


def is_increasing(e: FloatArray) -> bool:
    """e'(v) = e₁ + 2 e₂ v + 3 e₃ v² > 0 for every v, decided exactly."""
    first, second, third = (Fraction(float(entry)) for entry in e)
    return first > 0 and (second == third == 0 or 3 * first * third > second**2)


def increasing(e: FloatArray) -> FloatArray:
    """The nearest e (3,) that increases everywhere, of one that a solver keeps there to rounding.

    e'(v) = [1 v] G [1 v]', and what is negative in G's eigenvalues is made positive.
    """
    if is_increasing(e):
        return e

    values, vectors = np.linalg.eigh([[e[0], e[1]], [e[1], 3.0 * e[2]]])
    G = vectors * np.maximum(values, POSITIVE * values[-1]) @ vectors.T
    return np.array([G[0, 0], G[0, 1], G[1, 1] / 3.0])


def solve_increasing(e: tuple[float, ...], target: float, guess: float) -> float:
    """The v with e₁v + e₂v² + e₃v³ = target: Newton's method kept inside a bracket.

    The first bracket: with d = v - guess, |residual| = |e(v) - e(guess)| ≥ |d| min e' and, as
    e(v) - e(guess) = d(e' at some point ≥ 0 + e₃d²/4), also ≥ e₃|d|³/4.
    Source: thesis Section 2.2.2.
    """
    first, second, third = e
    if third == 0.0:
        return target / first
    least = first - second * second / (3.0 * third)
    residual = ((third * guess + second) * guess + first) * guess - target
    if math.isnan(residual):
        return math.nan
    reach = (4.0 * abs(residual) / third) ** (1.0 / 3.0)
    if least > 0.0:
        reach = min(reach, abs(residual) / least)
    reach *= BRACKET_ROOM
    low, high, v = guess - reach, guess + reach, guess
    for _ in range(NEWTON_STEPS):
        residual = ((third * v + second) * v + first) * v - target
        if residual > 0.0:
            high = v
        elif residual < 0.0:
            low = v
        else:
            return v
        moved = v - residual / ((3.0 * third * v + 2.0 * second) * v + first)
        if not low <= moved <= high:
            moved = 0.5 * (low + high)
        if abs(moved - v) <= ROUNDING * (abs(moved) + abs(v)):
            return moved
        v = moved
    return v
