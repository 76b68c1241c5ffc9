"""`TubePolicy`: a plan for a linear model, an observer, and the feedback around the plan."""

from dataclasses import dataclass

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, freeze
from nlsid_core.errors import ShapeError
from nlsid_core.models import DifferenceEquation

FORMAT = "nlsid/policy"
KIND = "tube"


@dataclass(frozen=True, eq=False)
class TubePolicy:
    """u = u_k - K(x̂ - x_k), with x̂ kept by the observer x̂⁺ = A x̂ + B u + f + L(y - ŷ).

    The plan x_k is the model's own solution from `start` (n,) under the inputs u: (N,), in the
    units of the model whose digest is `model`. K: (n,), L: (n,). Sample k is `period` s after
    sample k-1. K = 0 means that the planned inputs are played as they are.

    Raises ShapeError or DataError on arrays that do not fit or are not finite.
    """

    start: FloatArray
    u: FloatArray
    K: FloatArray
    L: FloatArray
    period: float
    model: str

    def __post_init__(self) -> None:
        n = (len(self.K),)
        freeze(self, "policy", {"start": n, "u": (None,), "K": n, "L": n})
        if not len(self.u):
            raise ShapeError("policy: u should have one sample at least")

    def __len__(self) -> int:
        """The number of planned samples N."""
        return len(self.u)

    @property
    def made_for(self) -> str:
        """The digest of the model."""
        return self.model

    @property
    def last(self) -> float:
        """The last planned sample."""
        return len(self) - 1

    def plan(self, model: DifferenceEquation) -> "Plan":
        """The policy with the motion that it plans for this model."""
        A, B, f = model.A, model.B[:, 0], model.offset
        x = np.empty((len(self), len(self.K)))
        x[0] = self.start
        for k in range(len(self) - 1):
            x[k + 1] = A @ x[k] + B * self.u[k] + f
        return Plan(self, x, x[:, 0] + model.D * self.u + model.c)

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
            "start": self.start.tolist(),
            "u": self.u[:, None].tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "policy") -> "TubePolicy":
        """Raises DocumentError if the document is not a policy of this kind."""
        files.header(document, FORMAT, source=source, kind=KIND)
        K = files.array(document, "K", (1, None), source=source)[0]
        return cls(
            start=files.array(document, "start", (len(K),), source=source),
            u=files.array(document, "u", (None, 1), source=source)[:, 0],
            K=K,
            L=files.array(document, "L", (len(K), 1), source=source)[:, 0],
            period=files.number(document, "period", source=source),
            model=files.member(document, "model", str, source=source),
        )


@dataclass(frozen=True, eq=False)
class Plan:
    """A policy and the states x (N, n) and outputs y (N,) that it plans."""

    policy: TubePolicy
    x: FloatArray
    y: FloatArray

    def __len__(self) -> int:
        """The number of planned samples N."""
        return len(self.policy)

    def __call__(self, k: int, x: FloatArray) -> float:
        """The input at sample k for the observer's state x (n,)."""
        return float(self.policy.u[k] - self.policy.K @ (x - self.x[k]))

    @property
    def planned(self) -> FloatArray:
        """(N,) the planned inputs."""
        return self.policy.u

    @property
    def last(self) -> float:
        """The last planned sample."""
        return self.policy.last

    def covers(self, when: float, x: FloatArray) -> tuple[float, float]:
        """The least and greatest input that the proof covers at sample `when`.

        All between the planned input and the policy's: the proof holds for every part κ in [0, 1]
        of the feedback.
        """
        planned, u = float(self.policy.u[int(when)]), self(int(when), x)
        return min(planned, u), max(planned, u)
