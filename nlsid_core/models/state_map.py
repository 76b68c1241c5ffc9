"""`StateModel`: an identified polynomial map of a measured state, and the box of its data."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json, freeze, keep, objects
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.models.signal import FORMAT, Signal, signals
from nlsid_core.polynomial import Polynomial

KIND = "state_map"
MAX_DEGREE = 15  # of one variable in a file; a larger one would only be there to waste our time


@dataclass(frozen=True, eq=False)
class StateModel:
    """x⁺ = Σ_i coefficients[i]·(x, u)^exponents[i]: one sample of `period` s ahead.

    exponents: (m, n + p) of the monomials in [x; u], coefficients: (m, n), both in the signals'
    units. x_range (n, 2) and u_range (p, 2) are the box of the data it was fitted on: outside
    it the model is not a claim about anything. noise (n,) and disturbance (n,) are standard
    deviations, of the measurement and of what one step ahead leaves unexplained. `bags` names
    (name, digest) the recordings it was fitted on.

    Source: (2.1). Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    exponents: IntArray
    coefficients: FloatArray
    period: float
    x: tuple[Signal, ...]
    u: tuple[Signal, ...]
    x_range: FloatArray
    u_range: FloatArray
    noise: FloatArray
    disturbance: FloatArray
    bags: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        exponents = np.array(self.exponents, dtype=np.int64)
        keep(self, {"exponents": exponents})
        n, p = len(self.x), len(self.u)
        shapes = {
            "coefficients": (len(exponents), n),
            "x_range": (n, 2),
            "u_range": (p, 2),
            "noise": (n,),
            "disturbance": (n,),
        }
        freeze(self, "model", shapes)
        if exponents.shape != (len(exponents), n + p) or (exponents < 0).any():
            raise ShapeError(f"model: exponents should be (m, {n + p}) and not negative")
        empty = (self.x_range[:, 0] >= self.x_range[:, 1]).any()
        if empty or (self.u_range[:, 0] >= self.u_range[:, 1]).any():
            raise DataError("model: the box of its data is empty")
        if not (np.isfinite(self.period) and self.period > 0):
            raise DataError(f"model: period is {self.period} s")
        if (self.noise < 0).any() or (self.disturbance < 0).any():
            raise DataError("model: noise and disturbance should not be negative")

    def __len__(self) -> int:
        """The number of states n."""
        return len(self.x)

    def __call__(self, x: ArrayLike, u: ArrayLike) -> FloatArray:
        """x⁺ (..., n) for states (..., n) and inputs (..., p)."""
        points = np.concatenate(
            [np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)], axis=-1
        )
        return np.asarray(self._monomials(points, self.exponents) @ self.coefficients)

    def linearised(self, x: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """∂f/∂x (n, n) and ∂f/∂u (n, p) at one state (n,) and input (p,)."""
        point = np.concatenate([np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)])
        columns = []
        for j in range(len(point)):
            power = self.exponents[:, j]
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(power - 1, 0)
            columns.append((power * self._monomials(point, lowered)) @ self.coefficients)
        jacobian = np.array(columns).T
        return jacobian[:, : len(self)], jacobian[:, len(self) :]

    def simulate(self, x_start: ArrayLike, u: ArrayLike) -> FloatArray:
        """States (N + 1, n) from x_start under inputs u (N, p); may overflow to infinity."""
        inputs = np.asarray(u, dtype=np.float64)
        states = np.empty((len(inputs) + 1, len(self)))
        states[0] = x_start
        with np.errstate(over="ignore", invalid="ignore"):
            for k, u_k in enumerate(inputs):
                states[k + 1] = self(states[k], u_k)
        return states

    def polynomials(self) -> NDArray[np.object_]:
        """(n,) the equations as polynomials in x0…, u0…."""
        names = [f"x{i}" for i in range(len(self))] + [f"u{i}" for i in range(len(self.u))]
        columns = self.coefficients.T
        return objects([Polynomial(self.exponents, each, tuple(names)) for each in columns])

    @staticmethod
    def _monomials(points: FloatArray, exponents: IntArray) -> FloatArray:
        return np.asarray(np.prod(points[..., None, :] ** exponents, axis=-1))

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "equation": "x+ = sum_i coefficients[i] * prod_j [x; u][j] ^ exponents[i][j]",
            "period": self.period,
            "x": [signal.document() for signal in self.x],
            "u": [signal.document() for signal in self.u],
            "exponents": self.exponents.tolist(),
            "coefficients": self.coefficients.tolist(),
            "x_range": self.x_range.tolist(),
            "u_range": self.u_range.tolist(),
            "noise": self.noise.tolist(),
            "disturbance": self.disturbance.tolist(),
            "bags": [{"name": name, "digest": digest} for name, digest in self.bags],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "StateModel":
        """Raises DocumentError if the document is not a state map."""
        files.header(document, FORMAT, source=source, kind=KIND)
        x, u = (signals(document, key, source=source) for key in ("x", "u"))
        exponents = files.array(document, "exponents", (None, len(x) + len(u)), source=source)
        if (exponents != np.round(exponents)).any() or (exponents > MAX_DEGREE).any():
            raise DocumentError(f"{source}: exponents should be integers up to {MAX_DEGREE}")
        bags = files.member(document, "bags", list, source=source)
        sizes: dict[str, tuple[int | None, ...]] = {
            "coefficients": (len(exponents), None),
            "x_range": (len(x), 2),
            "u_range": (len(u), 2),
            "noise": (len(x),),
            "disturbance": (len(x),),
        }
        arrays = {key: files.array(document, key, s, source=source) for key, s in sizes.items()}
        return cls(
            exponents=exponents.astype(np.int64),
            period=files.number(document, "period", source=source),
            x=x,
            u=u,
            bags=tuple(files.named_digests(bags, source=source)),
            **arrays,
        )
