"""`Policy`: a nominal motion of a model, an observer, and the feedback around the motion."""

from dataclasses import dataclass

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.errors import DataError, ShapeError

FORMAT = "nlsid/policy"
VERSION = 1


@dataclass(frozen=True, eq=False)
class Policy:
    """u = u_k - K(x̂ - x_k), with x̂ kept by the observer x̂⁺ = A x̂ + B u + f + L(y - ŷ).

    x: (N, n) nominal states, u: (N,) nominal inputs, in the units of the model whose digest is
    `model`; K: (n,), L: (n,). Sample k is `period` s after sample k-1. K = 0 means that the nominal
    inputs are played as they are.

    Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    x: FloatArray
    u: FloatArray
    K: FloatArray
    L: FloatArray
    period: float
    model: str

    def __post_init__(self) -> None:
        for key in ("x", "u", "K", "L"):
            values = np.array(getattr(self, key), dtype=np.float64)
            if not np.isfinite(values).all():
                raise DataError(f"policy: {key} holds NaN or infinity")
            values.setflags(write=False)
            object.__setattr__(self, key, values)
        n = len(self.K)
        if self.x.ndim != 2 or self.x.shape != (len(self.u), n) or self.L.shape != (n,):
            raise ShapeError(
                f"policy: x should be (N, n), u (N,), K and L (n,); they are "
                f"{self.x.shape}, {self.u.shape}, {self.K.shape}, {self.L.shape}"
            )

    def __len__(self) -> int:
        """The number of nominal samples N."""
        return len(self.u)

    def __call__(self, k: int, x: FloatArray) -> float:
        """The input at sample k for the observer's state x (n,)."""
        return float(self.u[k] - self.K @ (x - self.x[k]))

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "law": "u = u[k] - K (xhat - x[k]);  xhat+ = A xhat + B u + f + L (y - yhat)",
            "model": self.model,
            "period": self.period,
            "K": self.K.tolist(),
            "L": self.L.tolist(),
            "u": self.u.tolist(),
            "x": self.x.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "policy") -> "Policy":
        """Raises DocumentError if the document is not a policy."""
        _json.header(document, FORMAT, VERSION, source=source)
        K = _json.array(document, "K", (None,), source=source)
        u = _json.array(document, "u", (None,), source=source)
        return cls(
            x=_json.array(document, "x", (len(u), len(K)), source=source),
            u=u,
            K=K,
            L=_json.array(document, "L", (len(K),), source=source),
            period=_json.number(document, "period", source=source),
            model=_json.member(document, "model", str, source=source),
        )
