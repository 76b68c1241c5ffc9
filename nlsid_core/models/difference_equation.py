"""`DifferenceEquation`: a linear model with one input and one output."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, freeze
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.models.signal import FORMAT, Recorded, Signal, head, recorded, tail

KIND = "difference_equation"


@dataclass(frozen=True, eq=False)
class DifferenceEquation(Recorded):
    """y(t) = Σ_{k=1..n} a_k y(t-k) + Σ_{j=0..n} b_j u(t-j) + c, one output, one input.

    Source: (4.1) with constant G and affine p. a: (n,), b: (n+1,), c in the output's unit;
    t counts samples of `period` s, u(t) acts from sample t on. `u_range` is the range of the
    input the model was fitted on.

    Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    a: FloatArray
    b: FloatArray
    c: float
    y: Signal
    u: Signal
    u_range: tuple[float, float]

    def __post_init__(self) -> None:
        freeze(self, "model", {"a": (None,)})
        freeze(self, "model", {"b": (len(self.a) + 1,)})
        if not len(self.a):
            raise ShapeError("a model has at least one lag")
        if not np.isfinite([self.c, *self.u_range]).all():
            raise DataError("a model's coefficients should be finite")
        if self.u_range[0] > self.u_range[1]:
            raise DataError(f"input range {self.u_range} is not valid")
        self.require_period()

    def __len__(self) -> int:
        """The number of lags n."""
        return len(self.a)

    def __str__(self) -> str:
        return f"linear difference equation: {len(self)} lags, {self.period:g} s a sample"

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Roots of zⁿ - a₁zⁿ⁻¹ - … - a_n."""
        return np.roots(np.concatenate([[1.0], -self.a])).astype(np.complex128)

    @property
    def equation(self) -> str:
        """The equation with its numbers, in four digits."""
        past = [f"{a:+.4g} y(t-{k})" for k, a in enumerate(self.a.tolist(), 1)]
        driven = [f"{b:+.4g} u(t-{j})" for j, b in enumerate(self.b.tolist())]
        return f"y(t) = {' '.join((*past, *driven))} {self.c:+.4g}".replace("(t-0)", "(t)")

    # Observer form, the state of every later proof: x_i is the part of y(t+i-1) that is already
    # determined before sample t. With ŷ = x₁ + b₀u + c,
    #   x⁺ = a ŷ + shift(x) + b₁..ₙ u = A x + B u + f,   y = C x + D u + c.

    @property
    def A(self) -> FloatArray:
        """(n, n): first column a, ones above the diagonal."""
        A = np.diag(np.ones(len(self) - 1), 1)
        A[:, 0] = self.a
        return A

    @property
    def B(self) -> FloatArray:
        """(n, 1): b_i + a_i b_0."""
        return np.asarray((self.b[1:] + self.a * self.b[0])[:, None])

    @property
    def C(self) -> FloatArray:
        """(1, n): the first state is what the past says of the output."""
        return np.eye(1, len(self))

    @property
    def D(self) -> float:
        """b_0."""
        return float(self.b[0])

    @property
    def offset(self) -> FloatArray:
        """(n,): a_i c, the constant in the state's equation."""
        return self.a * self.c

    def state_after(self, y: ArrayLike, u: ArrayLike) -> FloatArray:
        """The state (n,) that the last n samples y(t-n)…y(t-1), u(t-n)…u(t-1) determine.

        Sums go from the newest sample to the oldest, one after another, as in the monitor in C.
        """
        y_lags, u_lags = np.asarray(y, dtype=np.float64), np.asarray(u, dtype=np.float64)
        n = len(self)
        if y_lags.shape != (n,) or u_lags.shape != (n,):
            raise ShapeError(f"y and u should have shape ({n},); {y_lags.shape}, {u_lags.shape}")
        newest = slice(None, None, -1)
        return np.array(
            [
                np.cumsum(self.a[i:] * y_lags[newest][: n - i])[-1]
                + np.cumsum(self.b[i + 1 :] * u_lags[newest][: n - i])[-1]
                for i in range(n)
            ]
        )

    def simulate(self, u: ArrayLike, y_start: ArrayLike) -> FloatArray:
        """Outputs (N,) for inputs u (N,), from the first n measured outputs y_start (n,).

        The first n outputs are y_start itself.
        """
        inputs, start = (np.atleast_1d(np.squeeze(np.array(x, float))) for x in (u, y_start))
        n = len(self)
        if inputs.ndim != 1 or len(inputs) < n or start.shape != (n,):
            raise ShapeError(
                f"u should be (N,), N >= {n}, y_start ({n},): {inputs.shape}, {start.shape}"
            )
        forcing = np.convolve(inputs, self.b)[n : len(inputs)] + self.c
        outputs = np.concatenate([start, forcing])
        backwards = self.a[::-1]
        for t in range(n, len(outputs)):
            outputs[t] += backwards @ outputs[t - n : t]
        return outputs

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            **head(self, KIND, "y(t) = sum a[k-1] y(t-k) + sum b[j] u(t-j) + c"),
            "a": self.a.tolist(),
            "b": self.b.tolist(),
            "c": self.c,
            "u_range": list(self.u_range),
            **tail(self),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "DifferenceEquation":
        """Raises DocumentError if the document is not a difference equation."""
        files.header(document, FORMAT, source=source)
        if (kind := document.get("kind")) != KIND:
            raise DocumentError(
                f"{source}: kind is {kind!r}, expected '{KIND}', which `model: linear` identifies"
            )
        a = files.array(document, "a", (None,), source=source)
        lo, hi = files.array(document, "u_range", (2,), source=source)
        return cls(
            a=a,
            b=files.array(document, "b", (len(a) + 1,), source=source),
            c=files.number(document, "c", source=source),
            u_range=(float(lo), float(hi)),
            **recorded(document, several=(), source=source),
        )
