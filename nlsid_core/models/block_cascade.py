"""`BlockCascade`: a linear filter, a static nonlinearity, a linear filter (Wiener-Hammerstein).

    v(t) = u(t) + Σ_{k=1..n₁} a1[k-1] v(t-k),   x_j(t) = Σ_i b1[j, i] v(t-i),   j = 0 … M-1
    y(t) = Σ_{k=1..n₂} a2[k-1] y(t-k) + Σ_j Σ_i b2[j, i] f(x_j(t-i))

The M phases see the signal between the filters at M instants a sample: f makes harmonics beyond
the sampled band, and what folds back is then described rather than left over. One lag and f linear
is a linear filter; n₁ = 0 a Hammerstein, n₂ = 0 a Wiener model.
Source: Schoukens and Tiels, "Identification of block-oriented nonlinear systems", Automatica 2017.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, freeze
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models.signal import FORMAT, Recorded, Signal, head, recorded, tail
from nlsid_core.models.spline import Spline

KIND = "block_cascade"
MAX_PHASES = 8  # a proof visits 2^M vertices


@dataclass(frozen=True, eq=False)
class BlockCascade(Recorded):
    """a1: (n₁,), b1: (M, m₁+1), f: the nonlinearity, a2: (n₂,), b2: (M, m₂+1).

    One input, one output; t counts samples of `period` s.
    Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    a1: FloatArray
    b1: FloatArray
    f: Spline
    a2: FloatArray
    b2: FloatArray
    y: Signal
    u: Signal

    def __post_init__(self) -> None:
        row, table = (None,), (None, None)
        freeze(self, "model", {"a1": row, "b1": table, "a2": row, "b2": table})
        if self.b1.size == 0 or self.b2.size == 0 or len(self.b1) != len(self.b2):
            raise ShapeError(f"b1 {self.b1.shape} and b2 {self.b2.shape} should have equal phases")
        if len(self.b1) > MAX_PHASES:
            raise DataError(f"{len(self.b1)} phases; at most {MAX_PHASES}")
        self.require_period()

    def __str__(self) -> str:
        phases = "1 phase" if self.phases == 1 else f"{self.phases} phases"
        return (
            f"block cascade: filters of orders {len(self.a1)} and {len(self.a2)}, "
            f"{self.f.intervals} knot intervals, {phases}, {self.period:g} s a sample"
        )

    @property
    def phases(self) -> int:
        """M, the instants a sample at which f is evaluated."""
        return len(self.b1)

    @property
    def poles(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Poles of the first and of the second filter."""
        first, second = (
            np.roots(np.concatenate([[1.0], -a])).astype(np.complex128) for a in (self.a1, self.a2)
        )
        return first, second

    def simulate(self, u: ArrayLike, y_start: ArrayLike | None = None) -> FloatArray:
        """Outputs (N,) for inputs u (N,), from rest or from the first n₂ measured outputs.

        y_start None: from rest, u, v and f's outputs zero before the first sample. y_start (n₂,):
        in motion, u before the first sample held at its first value for ever, and the second
        filter's state from y_start; the first n₂ outputs are y_start itself.
        Raises ShapeError on other shapes, DataError if no state goes with a held input.
        """
        inputs = np.asarray(u, dtype=np.float64)
        if inputs.ndim != 1:
            raise ShapeError(f"u should be (N,); has shape {inputs.shape}")
        if y_start is None or not len(inputs):
            held, start = 0.0, np.zeros(0)
        else:
            held, start = self._held(float(inputs[0])), np.asarray(y_start, dtype=np.float64)
            if start.shape != self.a2.shape or len(inputs) < len(start):
                raise ShapeError(
                    f"y_start has shape {start.shape} and u {inputs.shape}; y_start should be "
                    f"({len(self.a2)},), u no shorter"
                )
        v = _recursion(self.a1, inputs, np.full(len(self.a1), held))
        forcing = np.zeros(len(inputs))
        for b1, b2 in zip(self.b1, self.b2, strict=True):
            w = self.f(_moving_sum(b1, v, held))
            forcing += _moving_sum(b2, w, 0.0 if y_start is None else w[:1])
        if y_start is None:
            return _recursion(self.a2, forcing, np.zeros(len(self.a2)))
        n = len(start)
        return np.concatenate([start, _recursion(self.a2, forcing[n:], start[::-1])])

    def _held(self, u: float) -> float:
        """The first filter's v under the constant input u."""
        rest = 1.0 - float(self.a1.sum())
        if rest == 0.0:
            raise DataError("the first filter has a pole at 1: no state goes with a held input")
        return u / rest

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            **head(self, KIND),
            "a1": self.a1.tolist(),
            "b1": self.b1.tolist(),
            "f": self.f.document(),
            "a2": self.a2.tolist(),
            "b2": self.b2.tolist(),
            **tail(self),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "BlockCascade":
        """Raises DocumentError if the document is not a block cascade."""
        files.header(document, FORMAT, source=source, kind=KIND)
        return cls(
            a1=files.array(document, "a1", (None,), source=source),
            b1=files.array(document, "b1", (None, None), source=source),
            f=Spline.from_document(
                files.member(document, "f", dict, source=source), source=f"{source} f"
            ),
            a2=files.array(document, "a2", (None,), source=source),
            b2=files.array(document, "b2", (None, None), source=source),
            **recorded(document, several=(), source=source),
        )


def _moving_sum(b: FloatArray, signal: FloatArray, before: float | FloatArray) -> FloatArray:
    """Σ_i b[i] signal(t - i), the signal `before` until its first sample."""
    return np.asarray(np.convolve(signal - before, b)[: len(signal)] + before * b.sum())


def _recursion(a: FloatArray, forcing: FloatArray, newest: FloatArray) -> FloatArray:
    """x(t) = Σ_k a[k-1] x(t-k) + forcing(t), from newest = x(-1), x(-2), …."""
    coefficients, past = a.tolist(), newest.tolist()
    outputs = []
    for value in forcing.tolist():
        for coefficient, x in zip(coefficients, past, strict=True):
            value += coefficient * x
        outputs.append(value)
        if past:
            past.insert(0, value)
            past.pop()
    return np.array(outputs)
