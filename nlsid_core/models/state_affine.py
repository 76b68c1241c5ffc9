"""`StateAffineModel`: a difference equation, linear in the outputs, polynomial in the inputs.

    0 = Σ_{k=0..n} G_k(w(t)) y(t-k) + p(w(t))

w(t) stacks delayed inputs. Outputs and inputs are normalised, (y - offset)/scale, inside the
equation. What is proved, is proved for inputs in a declared range: the model clips its inputs to
it, so that it holds for every input, or refuses inputs beyond it, as declared.
Source: thesis (4.1).
"""

from dataclasses import dataclass
from typing import Literal, cast, get_args

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, freeze
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.models.signal import (
    FORMAT,
    Recorded,
    Signal,
    head,
    objects,
    recorded,
    tail,
    window_of,
)

KIND = "state_affine"
OutOfRange = Literal["clip", "refuse"]


@dataclass(frozen=True, eq=False)
class StateAffineModel(Recorded):
    """0 = Σ_k G_k(w) ȳ(t-k) + p(w), ȳ = (y - y_offset)/y_scale, the same for u.

    G: n+1 polynomials with (n_y, n_y) coefficients; p: polynomials with (n_y,) coefficients.
    window: (input, delay) of each entry of w, delays in 0 … n. u_range: (n_u, 2), to which inputs
    are clipped, or beyond which they are refused (`on_out_of_range`).

    Raises ShapeError or DataError on parts that do not fit.
    """

    G: tuple[Polynomials, ...]
    p: Polynomials
    window: tuple[tuple[int, int], ...]
    y_offset: FloatArray
    y_scale: FloatArray
    u_offset: FloatArray
    u_scale: FloatArray
    u_range: FloatArray
    y: tuple[Signal, ...]
    u: tuple[Signal, ...]
    on_out_of_range: OutOfRange = "clip"

    def __post_init__(self) -> None:
        if self.on_out_of_range not in get_args(OutOfRange):
            raise DataError(f"on_out_of_range is '{self.on_out_of_range}'; known: clip, refuse")
        n_y, n_u = len(self.y), len(self.u)
        freeze(
            self,
            "model",
            {
                "y_offset": (n_y,),
                "y_scale": (n_y,),
                "u_offset": (n_u,),
                "u_scale": (n_u,),
                "u_range": (n_u, 2),
            },
        )
        if (self.y_scale <= 0).any() or (self.u_scale <= 0).any():
            raise DataError("scales should be positive")
        self.require_period()
        if (self.u_range[:, 0] >= self.u_range[:, 1]).any():
            raise DataError(f"input range {self.u_range.tolist()} is empty")
        if len(self.G) < 2:
            raise ShapeError(f"{len(self.G)} left coefficients; a model has at least one lag")
        for polynomials, shape in (*((g, (n_y, n_y)) for g in self.G), (self.p, (n_y,))):
            if polynomials.coefficients.shape[1:] != shape:
                raise ShapeError(f"coefficients {polynomials.coefficients.shape}, wanted {shape}")
            if polynomials.exponents.shape[1] != len(self.window):
                raise ShapeError(f"exponents for {polynomials.exponents.shape[1]} window entries")
        if any(not (0 <= i < n_u and 0 <= d <= len(self)) for i, d in self.window):
            raise DataError(f"window {self.window} names inputs or delays that are not there")

    def __len__(self) -> int:
        """The number of lags n."""
        return len(self.G) - 1

    def __str__(self) -> str:
        terms = sum(len(g.exponents) for g in self.G) + len(self.p.exponents)
        return (
            f"state-affine model: {len(self)} lags, {len(self.y)} outputs, {len(self.u)} inputs, "
            f"{terms} terms, {self.period:g} s a sample"
        )

    def windows(self, u: FloatArray) -> FloatArray:
        """(..., N - n, n_w): normalised windows w(t), t = n …, of inputs (..., N, n_u).

        Raises DataError on an input beyond its range if the model refuses them.
        """
        n, (low, high) = len(self), self.u_range.T
        if self.on_out_of_range == "refuse":
            self._refuse_out_of_range(u)
        scaled = (np.clip(u, low, high) - self.u_offset) / self.u_scale
        N = scaled.shape[-2]
        return np.stack([scaled[..., n - d : N - d, i] for i, d in self.window], axis=-1)

    def _refuse_out_of_range(self, u: FloatArray) -> None:
        low, high = self.u_range.T
        beyond = np.argwhere(~((low <= u) & (u <= high)))
        if len(beyond):
            *_, t, i = where = tuple(beyond[0])
            raise DataError(
                f"input {self.u[i].name or i} is {u[where]:g} at sample {t}, outside "
                f"[{low[i]:g}, {high[i]:g}] where this model is proved; it refuses such inputs "
                f"({len(beyond)} here). Keep to the range, or declare on_out_of_range: clip"
            )

    def window_range(self) -> FloatArray:
        """(n_w, 2): the box that every window lies in."""
        box: FloatArray = (self.u_range - self.u_offset[:, None]) / self.u_scale[:, None]
        return np.asarray(box[[i for i, _ in self.window]])

    def simulate(self, u: ArrayLike, y_start: ArrayLike | None = None) -> FloatArray:
        """Outputs for inputs u, from the first n outputs y_start (None: the offsets).

        u: (N, n_u), or (B, N, n_u) for B trajectories of equal length at once, y_start (n, n_y) or
        (B, n, n_y); returns (N, n_y) or (B, N, n_y), the first n as given.
        """
        inputs = np.asarray(u, dtype=np.float64)
        n, n_y = len(self), len(self.y)
        if inputs.ndim == 2:
            start = None if y_start is None else np.asarray(y_start, dtype=np.float64)[None]
            return np.asarray(self.simulate(inputs[None], start)[0])
        if inputs.ndim != 3 or inputs.shape[2] != len(self.u) or inputs.shape[1] < n:
            raise ShapeError(f"u should be (B, N >= {n}, {len(self.u)}), is {inputs.shape}")
        B, N, _ = inputs.shape
        scaled = np.zeros((B, N, n_y))
        if y_start is not None:
            start = np.asarray(y_start, dtype=np.float64)
            if start.shape != (B, n, n_y):
                raise ShapeError(f"y_start should be {(B, n, n_y)}, is {start.shape}")
            scaled[:, :n] = (start - self.y_offset) / self.y_scale
        gains, forcing = self.explicit(self.windows(inputs))
        if B == n_y == 1:
            past = scaled[0, :n, 0][::-1].tolist()
            scaled[0, n:, 0] = _recursion(gains[0, :, 0].tolist(), forcing[0, :, 0].tolist(), past)
        else:
            for t in range(n, N):
                past = scaled[:, t - n : t][:, ::-1].reshape(B, n * n_y, 1)
                scaled[:, t] = (gains[:, t - n] @ past)[..., 0] + forcing[:, t - n]
        return scaled * self.y_scale + self.y_offset

    def explicit(self, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ȳ(t) = gains [ȳ(t-1); …; ȳ(t-n)] + forcing at windows w (..., n_w).

        gains (..., n_y, n·n_y) is also the Jacobian with respect to the lagged outputs.
        """
        lead = self.G[0](w)
        lags = np.concatenate([g(w) for g in self.G[1:]], axis=-1)
        right = np.concatenate([lags, self.p(w)[..., None]], axis=-1)
        solved = right / lead if lead.shape[-1] == 1 else np.linalg.solve(lead, right)
        return -solved[..., :-1], -solved[..., -1]

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            **head(self, KIND, "0 = sum G[k](w) ybar(t-k) + p(w), ybar = (y - y_offset)/y_scale"),
            "window": [list(entry) for entry in self.window],
            "G": [g.document() for g in self.G],
            "p": self.p.document(),
            "y_offset": self.y_offset.tolist(),
            "y_scale": self.y_scale.tolist(),
            "u_offset": self.u_offset.tolist(),
            "u_scale": self.u_scale.tolist(),
            "u_range": self.u_range.tolist(),
            "on_out_of_range": self.on_out_of_range,
            **tail(self),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "StateAffineModel":
        """Raises DocumentError if the document is not a state-affine model."""
        files.header(document, FORMAT, source=source, kind=KIND)
        window = window_of(document, source=source)
        y, u = (files.member(document, key, list, source=source) for key in ("y", "u"))
        n_w, n_y = len(window), len(y)
        left = objects(document, "G", source=source)
        right = files.member(document, "p", dict, source=source)
        return cls(
            G=tuple(
                Polynomials.from_document(g, n_w, (n_y, n_y), source=f"{source} G") for g in left
            ),
            p=Polynomials.from_document(right, n_w, (n_y,), source=f"{source} p"),
            window=window,
            y_offset=files.array(document, "y_offset", (n_y,), source=source),
            y_scale=files.array(document, "y_scale", (n_y,), source=source),
            u_offset=files.array(document, "u_offset", (len(u),), source=source),
            u_scale=files.array(document, "u_scale", (len(u),), source=source),
            u_range=files.array(document, "u_range", (len(u), 2), source=source),
            on_out_of_range=cast(
                OutOfRange, files.member(document, "on_out_of_range", str, source=source)
            ),
            **recorded(document, several=("y", "u"), source=source),
        )


def _recursion(gains: list[list[float]], forcing: list[float], past: list[float]) -> list[float]:
    """y(t) = gains(t)·[y(t-1), y(t-2), …] + forcing(t): plain floats beat small arrays tenfold."""
    outputs = []
    for row, value in zip(gains, forcing, strict=True):
        y = value + sum(map(float.__mul__, row, past))
        past = [y, *past[:-1]]
        outputs.append(y)
    return outputs
