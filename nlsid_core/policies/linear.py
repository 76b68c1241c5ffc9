"""`LinearPolicy`: a nominal motion of a model, an observer, and the feedback around the motion."""

from dataclasses import dataclass

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, freeze
from nlsid_core.errors import DocumentError, ShapeError

FORMAT = "nlsid/policy"
KIND = "linear"


@dataclass(frozen=True, eq=False)
class LinearPolicy:
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
        freeze(self, "policy", ("x", "u", "K", "L"))
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

    @property
    def made_for(self) -> str:
        """The digest of the model."""
        return self.model

    @property
    def planned(self) -> FloatArray:
        """(N,) the nominal inputs."""
        return self.u

    @property
    def last(self) -> float:
        """The last nominal sample."""
        return len(self) - 1

    def covers(self, when: float, x: FloatArray) -> tuple[float, float]:
        """The least and greatest input that the proof covers at sample `when`.

        All between the nominal input and the policy's: the proof holds for every part κ in [0, 1]
        of the feedback.
        """
        planned, u = float(self.u[int(when)]), self(int(when), x)
        return min(planned, u), max(planned, u)

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "model": self.model,
            "period": self.period,
            "K": [self.K.tolist()],
            "L": self.L[:, None].tolist(),
            "u": self.u[:, None].tolist(),
            "x": self.x.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "policy") -> "LinearPolicy":
        """Raises DocumentError if the document is not a policy."""
        files.header(document, FORMAT, source=source)
        kind = files.member(document, "kind", str, source=source)
        if kind != KIND:
            raise DocumentError(f"{source}: kind is '{kind}', expected '{KIND}'")
        K = files.array(document, "K", (1, None), source=source)[0]
        u = files.array(document, "u", (None, 1), source=source)[:, 0]
        return cls(
            x=files.array(document, "x", (len(u), len(K)), source=source),
            u=u,
            K=K,
            L=files.array(document, "L", (len(K), 1), source=source)[:, 0],
            period=files.number(document, "period", source=source),
            model=files.member(document, "model", str, source=source),
        )
