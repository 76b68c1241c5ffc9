"""`SampledPolicy`: a nominal motion of a state model, its feedback and observer."""

from dataclasses import dataclass

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, freeze
from nlsid_core.errors import ShapeError
from nlsid_core.policies.tube import FORMAT

KIND = "sampled"


@dataclass(frozen=True, eq=False)
class SampledPolicy:
    """u = u_k - K_k(x̂ - x_k), x̂⁺ = f(x̂, u) + L(y⁺ - f(x̂, u)), y the measured state.

    x: (N + 1, n) nominal states, u: (N, p) nominal inputs, K: (N, p, n), L: (n, n), in the units of
    the model whose digest is `model`. Sample k is `period` s after sample k - 1.

    Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    x: FloatArray
    u: FloatArray
    K: FloatArray
    L: FloatArray
    period: float
    model: str

    def __post_init__(self) -> None:
        freeze(self, "policy", {"x": (None, None), "u": (None, None)})
        n, (steps, p) = self.x.shape[1], self.u.shape
        if not steps:
            raise ShapeError("policy: u should have one step at least")
        freeze(self, "policy", {"x": (steps + 1, n), "K": (steps, p, n), "L": (n, n)})

    def __len__(self) -> int:
        """The number of steps N."""
        return len(self.u)

    def __call__(self, k: int, x: FloatArray) -> FloatArray:
        """The input (p,) at sample k for the observer's state x (n,)."""
        u: FloatArray = self.u[k] - self.K[k] @ (x - self.x[k])
        return u

    @property
    def made_for(self) -> str:
        """The digest of the model."""
        return self.model

    @property
    def planned(self) -> FloatArray:
        """(N, p) the nominal inputs."""
        return self.u

    @property
    def last(self) -> float:
        """The last sample that has an input."""
        return len(self) - 1

    def covers(self, when: float, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The least and greatest input (p,) that the proof covers at sample `when`: its own."""
        u = self(int(when), x)
        return u, u

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "law": "u = u[k] - K[k] (xhat - x[k]);  xhat+ = f(xhat, u) + L (y+ - f(xhat, u))",
            "model": self.model,
            "period": self.period,
            "L": self.L.tolist(),
            "u": self.u.tolist(),
            "x": self.x.tolist(),
            "K": self.K.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "policy") -> "SampledPolicy":
        """Raises DocumentError if the document is not a sampled policy."""
        files.header(document, FORMAT, source=source, kind=KIND)
        u = files.array(document, "u", (None, None), source=source)
        L = files.array(document, "L", (None, None), source=source)
        return cls(
            x=files.array(document, "x", (len(u) + 1, len(L)), source=source),
            u=u,
            K=files.array(document, "K", (len(u), u.shape[1], len(L)), source=source),
            L=L,
            period=files.number(document, "period", source=source),
            model=files.member(document, "model", str, source=source),
        )
