"""`LinearFunnel`: a tube around every trajectory of a model, and the assumption it rests on."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels.factor import factor_of, rounding_of

FORMAT = "nlsid/funnel"
KIND = "linear"


@dataclass(frozen=True)
class EnergyAssumption:
    """E_{k+1} = ρE_k + e_k'Re_k <= budget at the first `samples` samples, E_0 = 0.

    e = y - ŷ is the observer's innovation; ρ and R are the funnel's. With ρ = 1 it is a bound on
    Σ e'Re (a document calls it `energy`), with ρ < 1 it forgets (`fading`). budget =
    safety_factor² · measured, measured being the largest E that any of the trials `measured_on`
    (name, digest) reaches over its whole length. The funnel was designed on `designed_on`, other
    trials. A digest ends in `[first:end]` where a trial is these samples of a recording.
    """

    budget: float
    samples: int
    measured: float
    safety_factor: float
    measured_on: tuple[tuple[str, str], ...]
    designed_on: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, eq=False)
class LinearFunnel:
    """{(x̄, e) : ρ x̄'Px̄ + e'Re ≤ level} around a trajectory of the model, x̄ = x̂ - x_k.

    Starts with x̄'Px̄ ≤ inlet stay inside while the assumption holds, and then |y_j - y_k,j| ≤
    √(level/tau_j) ≤ half_widths_j, whatever part of the policy is engaged. P: (n, n), R: (p, p)
    symmetric; rho in (0, 1]; tau, half_widths: (p,), the latter in the outputs' units. With one
    output R = 1, so that V = x̄'Px̄ and `level` carry its unit squared. `model` and `policy` are
    digests.

    Raises ShapeError or DataError on numbers that do not fit.
    """

    P: FloatArray
    level: float
    inlet: float
    tau: FloatArray
    half_widths: FloatArray
    assumption: EnergyAssumption
    model: str
    policy: str
    R: FloatArray = field(default_factory=lambda: np.eye(1))
    rho: float = 1.0

    def __post_init__(self) -> None:
        for key in ("P", "R", "tau", "half_widths"):
            values = np.array(getattr(self, key), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)
        n, p = len(self.P), len(self.R)
        shapes = (self.P.shape, self.R.shape, self.tau.shape, self.half_widths.shape)
        if shapes != ((n, n), (p, p), (p,), (p,)):
            raise ShapeError(
                f"funnel: P, R, tau, half_widths should be (n, n), (p, p), (p,), (p,); are {shapes}"
            )
        sizes = self.level > 0 and 0 <= self.inlet <= self.level and 0 < self.rho <= 1
        positive = (self.tau > 0).all() and (self.half_widths > 0).all()
        finite = np.isfinite(self.P).all() and np.isfinite(self.R).all()
        if not (sizes and positive and finite):
            raise DataError(
                f"funnel: P, R, rho {self.rho}, level {self.level}, inlet {self.inlet}, tau "
                f"{self.tau.tolist()}, half-widths {self.half_widths.tolist()} are not a tube"
            )

    def value(self, x_bar: FloatArray, innovation: float) -> float:
        """ρV(x̄) + e'Re of one output, to be held against `level`."""
        return float(self.rho * (x_bar @ self.P @ x_bar) + self.R[0, 0] * innovation**2)

    @property
    def half_width(self) -> float:
        """The most that the first output can be off the trajectory, in its unit."""
        return float(self.half_widths[0])

    @property
    def made_for(self) -> tuple[str, str]:
        """The digests of the model and of the policy."""
        return self.model, self.policy

    @property
    def last(self) -> float:
        """The last sample that the proof covers."""
        return self.assumption.samples - 1

    @cached_property
    def factor(self) -> FloatArray:
        """F (n+p, n+p): |F [x̄, e]| is 1 on the tube's boundary; DataError if P or R is not ≻ 0."""
        n, p = len(self.P), len(self.R)
        F = np.zeros((n + p, n + p))
        F[:n, :n], F[n:, n:] = np.sqrt(self.rho) * factor_of(self.P), factor_of(self.R)
        return np.asarray(F / np.sqrt(self.level))

    @cached_property
    def rounding(self) -> float:
        """What rounding can hide of a size, of itself; DataError if that is too much."""
        return float(rounding_of(self.factor, "the funnel's P"))

    def size(self, _when: float, deviation: FloatArray) -> float:
        """How far out [x̄, e] (n+p,) is: 1 on the boundary, rounded up."""
        return float(np.linalg.norm(self.factor @ deviation)) * (1.0 + self.rounding)

    def start_size(self, x_bar: FloatArray) -> float:
        """How far out of the inlet a start x̄ (n,) is: 1 on its boundary, rounded up."""
        size = self.size(0.0, np.append(x_bar, np.zeros(len(self.R))))
        if self.inlet > 0.0:
            scale = float(np.sqrt(self.level / (self.rho * self.inlet)))
            return size * scale * (1.0 + self.rounding)
        return math.inf if size != 0.0 else 0.0

    def widths(self, _when: float) -> FloatArray:
        """The largest |x̄_i| in the tube, then the largest |e_j|, in the outputs' units."""
        return self.axis_half_widths

    @property
    def axis_half_widths(self) -> FloatArray:
        """(n+p,): the largest |x̄_i| in the tube, then the largest |e_j|, in the outputs' units."""
        shape = np.concatenate(
            [np.diag(np.linalg.inv(self.P)) / self.rho, np.diag(np.linalg.inv(self.R))]
        )
        return np.sqrt(self.level * shape)

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        a = self.assumption
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "model": self.model,
            "policy": self.policy,
            "rho": self.rho,
            "level": self.level,
            "inlet": self.inlet,
            "tau": self.tau.tolist(),
            "half_widths": self.half_widths.tolist(),
            "assumption": {
                "kind": "energy" if self.rho == 1.0 else "fading",
                "budget": a.budget,
                "samples": a.samples,
                "measured": a.measured,
                "safety_factor": a.safety_factor,
                "measured_on": [{"name": n, "digest": d} for n, d in a.measured_on],
                "designed_on": [{"name": n, "digest": d} for n, d in a.designed_on],
            },
            "R": self.R.tolist(),
            "P": self.P.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "LinearFunnel":
        """Raises DocumentError if the document is not a linear funnel."""
        files.header(document, FORMAT, source=source)
        kind = files.member(document, "kind", str, source=source)
        if kind != KIND:
            raise DocumentError(f"{source}: kind is '{kind}', expected '{KIND}'")
        rho = files.number(document, "rho", source=source)
        nested = files.member(document, "assumption", dict, source=source)
        where = f"{source} assumption"
        found = files.member(nested, "kind", str, source=where)
        expected = "energy" if rho == 1.0 else "fading"
        if found != expected:
            raise DocumentError(f"{where}: kind is '{found}', expected '{expected}' for rho {rho}")
        measured_on, designed_on = (
            tuple(files.named_digests(files.member(nested, key, list, source=where), source=where))
            for key in ("measured_on", "designed_on")
        )
        return cls(
            P=files.array(document, "P", (None, None), source=source),
            R=files.array(document, "R", (None, None), source=source),
            rho=rho,
            level=files.number(document, "level", source=source),
            inlet=files.number(document, "inlet", source=source),
            tau=files.array(document, "tau", (None,), source=source),
            half_widths=files.array(document, "half_widths", (None,), source=source),
            assumption=EnergyAssumption(
                budget=files.number(nested, "budget", source=where),
                samples=files.member(nested, "samples", int, source=where),
                measured=files.number(nested, "measured", source=where),
                safety_factor=files.number(nested, "safety_factor", source=where),
                measured_on=measured_on,
                designed_on=designed_on,
            ),
            model=files.member(document, "model", str, source=source),
            policy=files.member(document, "policy", str, source=source),
        )
