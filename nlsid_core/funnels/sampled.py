"""`SampledFunnel`: a tube around a nominal motion of a state model, and what it rests on."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, freeze
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels.factor import rounding_of
from nlsid_core.funnels.tube import FORMAT

KIND = "sampled"
_AXES = {"S": 3, "A": 3, "tube": 1, "inlet": 1, "half_widths": 2}
FORM = "response"  # how the disturbance is bounded; the format has others, nothing makes them


@dataclass(frozen=True)
class DisturbanceAssumption:
    """What the tube rests on: d_k = x̂_{k+1} - f(x̂_k, u_k), the observer's correction, stays small.

    r_{k+1} = A_k r_k + d_k, r_0 = 0, and |S_k r_k| ≤ bound. bound ≥ safety_factor · measured,
    measured being the largest over the commissioning runs `measured_on` (name, digest), none of
    which the model was fitted on.
    """

    bound: float
    measured: float
    safety_factor: float
    measured_on: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class SampledFunnel:
    """|S_k(x̂_k - x_k)| ≤ radius_k, k = 0 … N, around the nominal (x_k) of a policy.

    S: (N + 1, n, n), upper triangular, S'S the shape. A: (N, n, n), of the disturbance's response.
    tube: (N + 1,) radii of what starts with |S_0 x̄_0| ≤ tube_0 do; inlet: (N + 1,) radii from
    which the goal inlet_N is reached. The radius is tube + the assumption's bound. Radii are in the
    norm of S, without unit. half_widths: (N + 1, n) the largest |x̄_i| in the tube, in the signals'
    units, rounded up; they are part of what is proved. `model` and `policy` are digests.

    Raises ShapeError or DataError on numbers that do not fit.
    """

    S: FloatArray
    A: FloatArray
    tube: FloatArray
    inlet: FloatArray
    half_widths: FloatArray
    assumption: DisturbanceAssumption
    model: str
    policy: str

    def __post_init__(self) -> None:
        freeze(self, "funnel", {"S": (None, None, None)})
        length, n, _ = self.S.shape
        if length < 2:
            raise ShapeError(f"funnel: S has {length} samples; two are the least")
        freeze(
            self,
            "funnel",
            {
                "S": (length, n, n),
                "A": (length - 1, n, n),
                "tube": (length,),
                "inlet": (length,),
                "half_widths": (length, n),
            },
        )
        if (np.tril(self.S, -1) != 0).any() or (np.diagonal(self.S, axis1=1, axis2=2) == 0).any():
            raise DataError("funnel: S should be upper triangular with a nonzero diagonal")
        if not ((self.tube > 0).all() and (self.inlet > 0).all() and self.tube[0] <= self.inlet[0]):
            raise DataError("funnel: radii should be positive, and the tube start in the inlet")
        if self.assumption.bound < 0:
            raise DataError(f"funnel: the assumption's bound is {self.assumption.bound}")

    def __len__(self) -> int:
        """The number of steps N."""
        return len(self.A)

    @property
    def radius(self) -> FloatArray:
        """(N + 1,): |S_k x̄_k| in the tube, the disturbance's response included."""
        return self.tube + self.margin

    @property
    def margin(self) -> float:
        """What the disturbance adds to a radius."""
        return self.assumption.bound

    @property
    def made_for(self) -> tuple[str, str]:
        """The digests of the model and of the policy."""
        return self.model, self.policy

    @property
    def last(self) -> float:
        """The last sample that the proof covers."""
        return len(self)

    @cached_property
    def rounding(self) -> FloatArray:
        """(N + 1,) what rounding can hide of a size, of itself; DataError if that is too much."""
        return rounding_of(self.S, "the funnel's S")

    def norm(self, when: float, x_bar: FloatArray) -> float:
        """|S_k x̄| of x̄ (n,) at sample `when`, rounded up."""
        k = int(when)
        return float(np.linalg.norm(self.S[k] @ x_bar)) * float(1.0 + self.rounding[k])

    def size(self, when: float, deviation: FloatArray) -> float:
        """How far out x̄ (n,) is at sample `when`: 1 on the boundary, rounded up."""
        return self.norm(when, deviation) / float(self.tube[int(when)] + self.margin)

    def start_size(self, x_bar: FloatArray) -> float:
        """How far out of the tube's start x̄ (n,) is: 1 on its boundary, rounded up."""
        return self.norm(0, x_bar) / float(self.tube[0])

    def widths(self, when: float) -> FloatArray:
        """(n,) the largest |x̄_i| in the tube at sample `when`, in the signals' units."""
        return np.asarray(self.half_widths[int(when)])

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        a = self.assumption
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "set": "|S[k] (xhat - x[k])| <= tube[k] + bound",
            "model": self.model,
            "policy": self.policy,
            "assumption": {
                "form": FORM,
                "bound": a.bound,
                "rate": 1.0,
                "gain": 1.0,
                "measured": a.measured,
                "safety_factor": a.safety_factor,
                "measured_on": [{"name": n, "digest": d} for n, d in a.measured_on],
            },
            "tube": self.tube.tolist(),
            "inlet": self.inlet.tolist(),
            "half_widths": self.half_widths.tolist(),
            "S": self.S.tolist(),
            "A": self.A.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "SampledFunnel":
        """Raises DocumentError if the document is not a sampled funnel."""
        files.header(document, FORMAT, source=source, kind=KIND)
        nested = files.member(document, "assumption", dict, source=source)
        where = f"{source} assumption"
        if (form := files.member(nested, "form", str, source=where)) != FORM:
            raise DocumentError(f"{where}: form is '{form}'; known: {FORM}")
        runs = files.member(nested, "measured_on", list, source=where)
        arrays = {
            key: files.array(document, key, (None,) * axes, source=source)
            for key, axes in _AXES.items()
        }
        return cls(
            assumption=DisturbanceAssumption(
                bound=files.number(nested, "bound", source=where),
                measured=files.number(nested, "measured", source=where),
                safety_factor=files.number(nested, "safety_factor", source=where),
                measured_on=tuple(files.named_digests(runs, source=where)),
            ),
            model=files.member(document, "model", str, source=source),
            policy=files.member(document, "policy", str, source=source),
            **arrays,
        )
