"""`Funnel`: a tube around every trajectory of a model, and the assumption it rests on."""

from dataclasses import dataclass

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError

FORMAT = "nlsid/funnel"
VERSION = 1


@dataclass(frozen=True)
class EnergyAssumption:
    """Σ e_k² ≤ budget over `samples` samples from the start, e = y - ŷ the observer's innovation.

    budget = safety_factor² · measured, measured being the largest Σ e_k² over the trials
    `measured_on` (name, digest), in the output's unit squared.
    """

    budget: float
    samples: int
    measured: float
    safety_factor: float
    measured_on: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Funnel:
    """{(x̄, e) : x̄'Px̄ + e² ≤ level} around a trajectory (x_k, u_k) of the model, x̄ = x̂ - x_k.

    Starts with x̄'Px̄ ≤ inlet stay inside while the assumption holds. P: (n, n) symmetric,
    so that V = x̄'Px̄ and `level` carry the output's unit squared. half_width: the most |y - y_k| can
    be in it, in the output's unit, whatever part of the policy is engaged. `model` and `policy` are
    digests.

    Raises ShapeError or DataError on numbers that do not fit.
    """

    P: FloatArray
    level: float
    inlet: float
    half_width: float
    assumption: EnergyAssumption
    model: str
    policy: str

    def __post_init__(self) -> None:
        P = np.array(self.P, dtype=np.float64)
        P.setflags(write=False)
        object.__setattr__(self, "P", P)
        if P.ndim != 2 or P.shape[0] != P.shape[1]:
            raise ShapeError(f"funnel: P should be square, has shape {P.shape}")
        sizes = self.level > 0 and 0 <= self.inlet <= self.level and self.half_width > 0
        if not np.isfinite(P).all() or not sizes:
            raise DataError(
                f"funnel: P, level {self.level}, inlet {self.inlet}, half-width {self.half_width} "
                "are not a tube"
            )

    def value(self, x_bar: FloatArray, innovation: float) -> float:
        """V(x̄) + e², to be held against `level`."""
        return float(x_bar @ self.P @ x_bar + innovation**2)

    @property
    def axis_half_widths(self) -> FloatArray:
        """(n+1,): the largest |x̄_i| in the tube, then the largest |e|, in the output's unit."""
        shape = np.concatenate([np.diag(np.linalg.inv(self.P)), [1.0]])
        return np.sqrt(self.level * shape)

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        a = self.assumption
        return {
            "format": FORMAT,
            "version": VERSION,
            "set": "xbar' P xbar + e^2 <= level",
            "model": self.model,
            "policy": self.policy,
            "level": self.level,
            "inlet": self.inlet,
            "half_width": self.half_width,
            "assumption": {
                "kind": "energy",
                "budget": a.budget,
                "samples": a.samples,
                "measured": a.measured,
                "safety_factor": a.safety_factor,
                "measured_on": [{"name": n, "digest": d} for n, d in a.measured_on],
            },
            "P": self.P.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "Funnel":
        """Raises DocumentError if the document is not a funnel."""
        _json.header(document, FORMAT, VERSION, source=source)
        nested = _json.member(document, "assumption", dict, source=source)
        where = f"{source} assumption"
        kind = _json.member(nested, "kind", str, source=where)
        if kind != "energy":
            raise DocumentError(f"{where}: kind is '{kind}', expected 'energy'")
        trials = _json.member(nested, "measured_on", list, source=where)
        return cls(
            P=_json.array(document, "P", (None, None), source=source),
            level=_json.number(document, "level", source=source),
            inlet=_json.number(document, "inlet", source=source),
            half_width=_json.number(document, "half_width", source=source),
            assumption=EnergyAssumption(
                budget=_json.number(nested, "budget", source=where),
                samples=_json.member(nested, "samples", int, source=where),
                measured=_json.number(nested, "measured", source=where),
                safety_factor=_json.number(nested, "safety_factor", source=where),
                measured_on=tuple(_json.named_digests(trials, source=where)),
            ),
            model=_json.member(document, "model", str, source=source),
            policy=_json.member(document, "policy", str, source=source),
        )
