"""`CellNetwork`: states and static piecewise-linear maps, joined by an acyclic graph of weights.

With s = [ν (m), x (n), u (q), 1],
    ν_j = f_j(into_j·s), by ν_1 … ν_{j-1} at most,    x⁺ = next·s,    y = output·s.
Each f_j is linear between its knots and, with the slopes of its ends, beyond them. So scalar cells
that saturate and flow over into the next, filters around nonlinearities in series or in parallel,
and feedback through a nonlinearity are networks. States may be hidden.
"""

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json, freeze, keep
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models.signal import FORMAT, Recorded, Signal, head, objects, recorded, tail

KIND = "cell_network"
MAX_MAPS = 8  # a proof visits 2^m vertices
START_STEPS, FIRST_DAMPING, FOUND = 40, 1e-3, 1e-7
LEAST_DAMPING = 1e-12  # with less, the matrix of a step can be singular in float64
PRIOR = 1e-3  # weight of the usual start beside one measured sample, both in their spreads


@dataclass(frozen=True, eq=False)
class PiecewiseLinear:
    """knots (K,) ascending, values (K,), K >= 2. Raises ShapeError or DataError otherwise."""

    knots: FloatArray
    values: FloatArray
    slopes: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        knots, values = (np.array(v, dtype=np.float64) for v in (self.knots, self.values))
        if knots.ndim != 1 or len(knots) < 2 or values.shape != knots.shape:
            raise ShapeError(f"knots {knots.shape}, values {values.shape}: both (K,), K >= 2")
        if not (np.isfinite(knots).all() and np.isfinite(values).all()):
            raise DataError("knots and values should be finite")
        if not (np.diff(knots) > 0).all():
            raise DataError("knots should ascend")
        slopes = np.diff(values) / np.diff(knots)
        keep(self, {"knots": knots, "values": values, "slopes": slopes})

    def __call__(self, x: FloatArray) -> FloatArray:
        """f(x), the shape of x."""
        i = self.index(x)
        return np.asarray(self.values[i] + self.slopes[i] * (x - self.knots[i]))

    def index(self, x: FloatArray) -> IntArray:
        """The interval that x is in, the outer ones reaching to infinity."""
        return np.searchsorted(self.knots[1:-1], x, "right")

    def document(self) -> Json:
        """The JSON form."""
        return {"knots": self.knots.tolist(), "values": self.values.tolist()}


@dataclass(frozen=True, eq=False)
class CellNetwork(Recorded):
    """maps: f_j. into (m, m+n+q+1), next (n, m+n+q+1), output (p, m+n+q+1), period in s.

    start (n,): the usual state at the start; it is estimated from the first `start_samples`.
    Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    maps: tuple[PiecewiseLinear, ...]
    into: FloatArray
    next: FloatArray
    output: FloatArray
    start: FloatArray
    start_samples: int
    y: tuple[Signal, ...]
    u: tuple[Signal, ...]

    def __post_init__(self) -> None:
        m, n = len(self.maps), np.size(self.start)
        width = m + n + len(self.u) + 1
        into, after, output = (m, width), (n, width), (len(self.y), width)
        freeze(self, "model", {"into": into, "next": after, "output": output, "start": (n,)})
        if not 1 <= m <= MAX_MAPS or not n or not self.y:
            raise DataError(f"{m} maps, {n} states, {len(self.y)} outputs; 1 to {MAX_MAPS} maps")
        if np.triu(self.into[:, :m]).any():
            raise DataError("a map should depend on earlier maps only")
        if self.start_samples < 1:
            raise DataError(f"start_samples is {self.start_samples}; should be 1 or more")
        self.require_period()

    def __str__(self) -> str:
        counts = {"state": len(self.start), "piecewise-linear map": len(self.maps)}
        states, maps = (f"{n} {what}" + "s" * (n > 1) for what, n in counts.items())
        return (
            f"cell network: {states}, {maps}, "
            f"started from {self.start_samples} samples, {self.period:g} s a sample"
        )

    def advance(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs (B, p) and next states (B, n) of states x (B, n) under one input u (q,)."""
        m, n = len(self.maps), len(self.start)
        s = np.empty((len(x), self.next.shape[1]))
        s[:, :m], s[:, m : m + n], s[:, m + n : -1], s[:, -1] = 0.0, x, u, 1.0
        for j, f in enumerate(self.maps):
            s[:, j] = f(s @ self.into[j])
        return s @ self.output.T, s @ self.next.T

    def states(self, u: ArrayLike, x: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Outputs (N, p) and states (N + 1, n) for inputs u (N, q) from the state x (n,)."""
        inputs, m, n = np.asarray(u, dtype=np.float64), len(self.maps), len(self.start)
        if inputs.ndim != 2 or inputs.shape[1] != len(self.u) or np.shape(x) != (n,):
            raise ShapeError(
                f"u should be (N, {len(self.u)}) and x ({n},); are {inputs.shape}, {np.shape(x)}"
            )
        from_u = inputs @ np.vstack([self.into, self.next])[:, m + n : -1].T
        from_u += np.vstack([self.into, self.next])[:, -1]
        own = [*self.into[:, : m + n], *self.next[:, : m + n]]
        weights = [[(int(k), float(row[k])) for k in np.flatnonzero(row)] for row in own]
        maps = [
            (f.knots[1:-1].tolist(), f.knots.tolist(), f.values.tolist(), f.slopes.tolist())
            for f in self.maps
        ]
        kept = np.empty((len(inputs) + 1, m + n))
        s = [0.0] * m + np.asarray(x, dtype=np.float64).tolist()
        for t, given in enumerate(from_u.tolist()):
            for j, (inner, knots, values, slopes) in enumerate(maps):
                z = given[j]
                for k, weight in weights[j]:
                    z += weight * s[k]
                i = bisect_right(inner, z)
                s[j] = values[i] + slopes[i] * (z - knots[i])
            kept[t] = s
            s[m:] = [
                sum([weight * s[k] for k, weight in weights[m + i]], given[m + i]) for i in range(n)
            ]
        kept[-1] = s
        y = kept[:-1] @ self.output[:, : m + n].T + inputs @ self.output[:, m + n : -1].T
        return y + self.output[:, -1], kept[:, m:]

    def start_from(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """x(0) by least squares on the outputs y (k, p) under u (k, q), near the usual start.

        Levenberg-Marquardt steps; derivatives are exact, of the pieces that the run is in.
        """
        gains = np.abs(self.output[:, :-1])
        # An output that stands still has no spread, and where maps alone lead to it no direct gain.
        gain = gains[:, len(self.maps) :].max() or gains.max() or 1.0
        spread = np.maximum(np.std(y, axis=0), gain)

        def residual(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            outputs, states = self.states(u, x)
            error = ((outputs - y) / spread).ravel()
            return np.concatenate([error, PRIOR * (x - self.start)]), states[:-1]

        x, damping = np.array(self.start), FIRST_DAMPING
        r, states = residual(x)
        for _ in range(START_STEPS):
            moved = self._moved(u, states) / spread[:, None]
            J = np.vstack([moved.reshape(-1, len(x)), PRIOR * np.eye(len(x))])
            normal = J.T @ J
            try:
                step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -J.T @ r)
            except np.linalg.LinAlgError:  # derivatives beyond what float64 holds
                break
            after, further = residual(x + step)
            better = after @ after < r @ r
            damping = max(damping * (0.1 if better else 10.0), LEAST_DAMPING)
            if better:
                x, r, states = x + step, after, further
            if np.abs(step).max() < FOUND * (1.0 + np.abs(x).max()):
                break
        return x

    def _moved(self, u: FloatArray, x: FloatArray) -> FloatArray:
        """(k, p, n): ∂y(t)/∂x(0) along a run with inputs u (k, q) and states x (k, n)."""
        m, n = len(self.maps), len(self.start)
        s = np.hstack([np.zeros((len(x), m)), x, u, np.ones((len(x), 1))])
        of_x = np.zeros((len(x), m, n))  # ∂ν/∂x
        for j, f in enumerate(self.maps):
            z = s @ self.into[j]
            s[:, j] = f(z)
            inner = self.into[j, m : m + n] + self.into[j, :m] @ of_x
            of_x[:, j] = f.slopes[f.index(z)][:, None] * inner
        after, seen = (part[:, m : m + n] + part[:, :m] @ of_x for part in (self.next, self.output))
        moved, found = np.eye(n), []
        for A, C in zip(after, seen, strict=True):
            found.append(C @ moved)
            moved = A @ moved
        return np.array(found)

    def simulate(self, u: ArrayLike, y_start: ArrayLike) -> FloatArray:
        """Outputs (N, p) for inputs u (N, q), from the state that the first outputs y_start show.

        y_start: (k, p), k <= N, such as the first `start_samples`.
        """
        inputs, first = np.asarray(u, dtype=np.float64), np.asarray(y_start, dtype=np.float64)
        if first.ndim != 2 or first.shape[1] != len(self.y) or not 1 <= len(first) <= len(inputs):
            raise ShapeError(f"y_start should be (k, {len(self.y)}), k from 1; is {first.shape}")
        return self.states(inputs, self.start_from(first, inputs[: len(first)]))[0]

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            **head(self, KIND),
            "maps": [f.document() for f in self.maps],
            "into": self.into.tolist(),
            "next": self.next.tolist(),
            "output": self.output.tolist(),
            "start": self.start.tolist(),
            "start_samples": self.start_samples,
            **tail(self),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "CellNetwork":
        """Raises DocumentError if the document is not a cell network."""
        files.header(document, FORMAT, source=source, kind=KIND)
        maps = objects(document, "maps", source=source)
        arrays: dict[str, Any] = {
            key: files.array(document, key, (None, None), source=source)
            for key in ("into", "next", "output")
        }
        return cls(
            maps=tuple(
                PiecewiseLinear(
                    *(files.array(f, key, (None,), source=source) for key in ("knots", "values"))
                )
                for f in maps
            ),
            **arrays,
            start=files.array(document, "start", (None,), source=source),
            start_samples=files.member(document, "start_samples", int, source=source),
            **recorded(document, several=("y", "u"), source=source),
        )
