"""`BlockCascade`: stable filters around a static nonlinearity (Wiener, Hammerstein and both).

    y = Σ_j (B2_j/A2) f((B1_j/A1) u)

One phase j is the Wiener-Hammerstein cascade. Several share poles and f: phase j of M sees the
intermediate signal between the samples, which undoes the folding of its harmonics.
"""

from dataclasses import dataclass

import numpy as np

from nlsid_core import _json
from nlsid_core._types import ArrayLike, FloatArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.models.signal import FORMAT, VERSION, Signal
from nlsid_core.models.spline import Spline

KIND = "block_cascade"


@dataclass(frozen=True, eq=False)
class BlockCascade:
    """y/y_scale = Σ_j (B2_j/A2) f((B1_j/A1) u/u_scale), one input, one output, M phases.

    A1: (n1,), A2: (n2,) coefficients of z⁻¹, z⁻², … after the leading 1; B1: (M, n1+1),
    B2: (M, n2+1) coefficients of 1, z⁻¹, …. u_range is the range of the input it was fitted on;
    bags, training: as in `DifferenceEquation`.

    Raises ShapeError or DataError on parts that do not fit.
    """

    A1: FloatArray
    B1: FloatArray
    f: Spline
    A2: FloatArray
    B2: FloatArray
    y_scale: float
    u_scale: float
    period: float
    y: Signal
    u: Signal
    u_range: tuple[float, float]
    bags: tuple[tuple[str, str], ...] = ()
    training: str = ""

    def __post_init__(self) -> None:
        for key in ("A1", "B1", "A2", "B2"):
            values = np.array(getattr(self, key), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)
            if not np.isfinite(values).all():
                raise DataError(f"{key} should be finite")
        for A, B in ((self.A1, self.B1), (self.A2, self.B2)):
            if A.ndim != 1 or B.ndim != 2 or B.shape[1] != len(A) + 1 or len(B) != len(self.B1):
                raise ShapeError(f"filters {A.shape}, {B.shape} should be (n,) and (M, n+1)")
        if not len(self.B1):
            raise ShapeError("a cascade has at least one phase")
        numbers = [self.y_scale, self.u_scale, self.period, *self.u_range]
        if not np.isfinite(numbers).all() or min(numbers[:3]) <= 0.0:
            raise DataError("scales and the period should be positive and finite")

    @property
    def phases(self) -> int:
        """The number of phases M."""
        return len(self.B1)

    def simulate(self, u: ArrayLike) -> FloatArray:
        """Outputs (N,) for inputs u (N,), both filters from the zero state."""
        inputs = np.asarray(u, dtype=np.float64)
        if inputs.ndim != 1:
            raise ShapeError(f"u should be (N,), is {inputs.shape}")
        poles = recursive_filter(self.A1, inputs / self.u_scale)
        forcing = np.zeros(len(inputs))
        for B1, B2 in zip(self.B1, self.B2, strict=True):
            forcing += moving_sum(B2, self.f(moving_sum(B1, poles)))
        return recursive_filter(self.A2, forcing) * self.y_scale

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "kind": KIND,
            "equation": "y/y_scale = sum_j (B2[j]/A2) f((B1[j]/A1) u/u_scale)",
            "period": self.period,
            "y": self.y.document(),
            "u": self.u.document(),
            "A1": self.A1.tolist(),
            "B1": self.B1.tolist(),
            "A2": self.A2.tolist(),
            "B2": self.B2.tolist(),
            "spline": {"start": self.f.start, "step": self.f.step, "c": self.f.c.tolist()},
            "y_scale": self.y_scale,
            "u_scale": self.u_scale,
            "u_range": list(self.u_range),
            "training": self.training,
            "bags": [{"name": name, "digest": digest} for name, digest in self.bags],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "BlockCascade":
        """Raises DocumentError if the document is not a block cascade."""
        _json.header(document, FORMAT, VERSION, source=source)
        kind = _json.member(document, "kind", str, source=source)
        if kind != KIND:
            raise DocumentError(f"{source}: kind is '{kind}', expected '{KIND}'")
        A1, A2 = (_json.array(document, key, (None,), source=source) for key in ("A1", "A2"))
        spline = _json.member(document, "spline", dict, source=source)
        low, high = _json.array(document, "u_range", (2,), source=source)
        bags = _json.member(document, "bags", list, source=source)
        signals = (
            Signal.from_document(_json.member(document, key, dict, source=source), source=source)
            for key in ("y", "u")
        )
        y, u = signals
        return cls(
            A1=A1,
            B1=_json.array(document, "B1", (None, len(A1) + 1), source=source),
            f=Spline(
                _json.number(spline, "start", source=source),
                _json.number(spline, "step", source=source),
                _json.array(spline, "c", (None,), source=source),
            ),
            A2=A2,
            B2=_json.array(document, "B2", (None, len(A2) + 1), source=source),
            y_scale=_json.number(document, "y_scale", source=source),
            u_scale=_json.number(document, "u_scale", source=source),
            period=_json.number(document, "period", source=source),
            y=y,
            u=u,
            u_range=(float(low), float(high)),
            training=_json.member(document, "training", str, source=source),
            bags=tuple(_json.named_digests(bags, source=source)),
        )


def moving_sum(B: FloatArray, x: FloatArray) -> FloatArray:
    """Σ_k B_k x(t-k) from the zero state."""
    return np.convolve(x, B)[: len(x)]


def recursive_filter(A: FloatArray, x: FloatArray) -> FloatArray:
    """x/A from the zero state: y(t) = x(t) - Σ_k A_k y(t-k)."""
    if not len(A):
        return x.copy()
    coefficients, past, outputs = A.tolist(), [0.0] * len(A), []
    for value in x.tolist():
        y = value - sum(map(float.__mul__, coefficients, past))
        past = [y, *past[:-1]]
        outputs.append(y)
    return np.array(outputs)
