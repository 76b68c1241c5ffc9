"""`TubeFunnel`: tubes around a model's own simulation, and the assumption that each rests on.

With a policy, around its plan too: the simulation from the plan's start under the planned inputs.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels.factor import factor_of, rounding_of

FORMAT = "nlsid/funnel"
KIND = "tube"


@dataclass(frozen=True, eq=False)
class Tube:
    """|y_j - y°_j| <= half_widths_j while E <= level, E+ = rho E + e'R e from 0.

    y° is the model's simulation, e = y - ŷ the innovation of the observer with gain L (n, p).
    P: (n, n), R: (p, p), tau, half_widths: (p,), the latter in the outputs' units. samples: the
    number of samples for which an energy (rho = 1) is assumed; None with rho < 1, for ever. level =
    safety_factor² · measured, the largest E on the trials `measured_on`; `designed_on` are those
    that L, rho, P, R were chosen on; each (name, digest). inlet: V = x̄'Px̄ that the start may have.

    Raises ShapeError or DataError on numbers that do not fit.
    """

    rho: float
    L: FloatArray
    P: FloatArray
    R: FloatArray
    tau: FloatArray
    half_widths: FloatArray
    level: float
    measured: float
    safety_factor: float
    designed_on: tuple[tuple[str, str], ...]
    measured_on: tuple[tuple[str, str], ...]
    samples: int | None = None
    inlet: float = 0.0

    def __post_init__(self) -> None:
        for key in ("L", "P", "R", "tau", "half_widths"):
            values = np.array(getattr(self, key), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)
        n, p = len(self.P), len(self.R)
        shapes = tuple(getattr(self, key).shape for key in ("L", "P", "R", "tau", "half_widths"))
        if shapes != ((n, p), (n, n), (p, p), (p,), (p,)):
            raise ShapeError(f"tube: L, P, R, tau, half_widths do not fit: {shapes}")
        finite = all(np.isfinite(values).all() for values in (self.L, self.P, self.R))
        lasting = (self.rho == 1.0) == (self.samples is not None)
        positive = (self.tau > 0).all() and (self.half_widths > 0).all() and self.level > 0
        if not (finite and lasting and positive and 0 < self.rho <= 1 and self.inlet >= 0):
            raise DataError(
                f"tube: rho {self.rho}, samples {self.samples}, level {self.level}, tau "
                f"{self.tau.tolist()}, half-widths {self.half_widths.tolist()} are not a tube"
            )

    @cached_property
    def factor(self) -> FloatArray:
        """F (n, n), F'F = P; DataError if P is not ≻ 0."""
        return factor_of(self.P)

    @cached_property
    def rounding(self) -> float:
        """What rounding can hide of |F x̄|, of itself; DataError if that is too much."""
        return float(rounding_of(self.factor, "the tube's P"))

    def start_size(self, x_bar: FloatArray) -> float:
        """How far out of V <= inlet a start x̄ (n,) is: 1 on its boundary, rounded up."""
        size = float(np.linalg.norm(self.factor @ x_bar)) * (1.0 + self.rounding)
        if self.inlet > 0.0:
            return size / math.sqrt(self.inlet) * (1.0 + self.rounding)
        return math.inf if size != 0.0 else 0.0

    @property
    def assumption(self) -> str:
        """What is assumed, in letters."""
        energy = "e'Re" if len(self.R) > 1 else "e²"
        if self.samples is not None:
            return f"Σ {energy} ≤ {self.level:.4g} over {self.samples} samples"
        return f"E ≤ {self.level:.4g}, E⁺ = {self.rho:.4g} E + {energy}"

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        kind: Json = {"kind": "fading"}
        if self.samples is not None:
            kind = {"kind": "energy", "samples": self.samples}
        return {
            "rho": self.rho,
            "level": self.level,
            "inlet": self.inlet,
            "tau": self.tau.tolist(),
            "half_widths": self.half_widths.tolist(),
            "assumption": kind
            | {
                "measured": self.measured,
                "safety_factor": self.safety_factor,
                "designed_on": _named(self.designed_on),
                "measured_on": _named(self.measured_on),
            },
            "L": self.L.tolist(),
            "R": self.R.tolist(),
            "P": self.P.tolist(),
        }


@dataclass(frozen=True, eq=False)
class TubeFunnel:
    """The output is within every one of `tubes` of the model's simulation, whatever the inputs.

    The simulation starts at the observer's state after `settling` samples. y_box (p, 2), u_box
    (n_u, 2): where outputs, states and inputs have to stay, for implicit models whose increments
    are known on a box only; else None. model: its digest. policy: that of the policy whose plan
    the tubes are around too, None without one.
    """

    tubes: tuple[Tube, ...]
    settling: int
    model: str
    y_box: FloatArray | None = None
    u_box: FloatArray | None = None
    policy: str | None = None

    def __post_init__(self) -> None:
        if not self.tubes:
            raise DataError("a funnel of kind tube holds one tube or more")
        if len({tube.L.shape for tube in self.tubes}) > 1:
            raise ShapeError("the tubes are of models of different sizes")

    @property
    def half_widths(self) -> FloatArray:
        """(p,): the least over the tubes, in the outputs' units."""
        return np.asarray(np.min([tube.half_widths for tube in self.tubes], axis=0))

    @property
    def half_width(self) -> float:
        """The first output's, in its unit."""
        return float(self.half_widths[0])

    @property
    def made_for(self) -> tuple[str, str | None]:
        """The digests of the model, and of the policy if there is one."""
        return self.model, self.policy

    @property
    def last(self) -> float:
        """The last sample that the proof covers; inf where one of the tubes lasts for ever."""
        return max(math.inf if t.samples is None else t.samples - 1 for t in self.tubes)

    @property
    def rounding(self) -> float:
        """What rounding can hide of the size of a start; DataError if that is too much."""
        return max(tube.rounding for tube in self.tubes)

    def start_size(self, x_bar: FloatArray) -> float:
        """How far out of what may start beside the plan x̄ (n,) is: 1 on its boundary."""
        return max(tube.start_size(x_bar) for tube in self.tubes)

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        box: Json = {}
        if self.y_box is not None and self.u_box is not None:
            box = {"box": {"y": self.y_box.tolist(), "u": self.u_box.tolist()}}
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "model": self.model,
            **({} if self.policy is None else {"policy": self.policy}),
            "settling": self.settling,
            **box,
            "tubes": [tube.document() for tube in self.tubes],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "TubeFunnel":
        """Raises DocumentError if the document is not a funnel of this kind."""
        files.header(document, FORMAT, source=source, kind=KIND)
        entries = files.member(document, "tubes", list, source=source)
        policy = None
        if "policy" in document:
            policy = files.member(document, "policy", str, source=source)
        box: dict[str, FloatArray] = {}
        if "box" in document:
            given = files.member(document, "box", dict, source=source)
            box = {f"{k}_box": files.array(given, k, (None, 2), source=source) for k in ("y", "u")}
        return cls(
            tubes=tuple(_tube(entry, f"{source} tubes[{i}]") for i, entry in enumerate(entries)),
            settling=files.member(document, "settling", int, source=source),
            model=files.member(document, "model", str, source=source),
            policy=policy,
            **box,
        )


def _tube(document: Any, source: str) -> Tube:
    if not isinstance(document, dict):
        raise DocumentError(f"{source} should be an object")
    given = files.member(document, "assumption", dict, source=source)
    kind = files.member(given, "kind", str, source=source)
    if kind not in ("fading", "energy"):
        raise DocumentError(f"{source}: assumption is '{kind}'; known: fading, energy")
    samples = files.member(given, "samples", int, source=source) if kind == "energy" else None
    L, P, R = (files.array(document, key, (None, None), source=source) for key in "LPR")
    return Tube(
        rho=files.number(document, "rho", source=source),
        L=L,
        P=P,
        R=R,
        tau=files.array(document, "tau", (None,), source=source),
        half_widths=files.array(document, "half_widths", (None,), source=source),
        level=files.number(document, "level", source=source),
        measured=files.number(given, "measured", source=source),
        safety_factor=files.number(given, "safety_factor", source=source),
        designed_on=_trials(given, "designed_on", source),
        measured_on=_trials(given, "measured_on", source),
        samples=samples,
        inlet=files.number(document, "inlet", source=source),
    )


def _named(trials: tuple[tuple[str, str], ...]) -> list[Json]:
    return [{"name": name, "digest": digest} for name, digest in trials]


def _trials(document: Json, key: str, source: str) -> tuple[tuple[str, str], ...]:
    entries = files.member(document, key, list, source=source)
    return tuple(files.named_digests(entries, source=source))
