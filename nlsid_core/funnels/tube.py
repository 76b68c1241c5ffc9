"""`TubeFunnel`: tubes around a model's own simulation, and the assumption that each rests on.

With a policy, around its plan too: the simulation from the plan's start under the planned inputs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, freeze
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels.factor import STEPS, UNIT, factor_of, rounding_of
from nlsid_core.funnels.level import CommandLevel
from nlsid_core.models.signal import Signal

FORMAT = "nlsid/funnel"
KIND = "tube"


@dataclass(frozen=True, eq=False)
class Peak:
    """|e_j| <= at_most_j √max(1, g) at every sample, g that of the tube's own level.

    at_most: (p,), in the outputs' units. measured: the largest on the trials of its tube, times
    the factor at most this. direct: (p,) the parts of e_j that the tube bounds by this, in [0, 1];
    where it is 0 the tube's sentence does not need it.
    """

    at_most: FloatArray
    measured: FloatArray
    direct: FloatArray

    def __post_init__(self) -> None:
        freeze(self, "peak", dict.fromkeys(("at_most", "measured", "direct"), (None,)))
        if not (self.at_most > 0.0).all():
            raise DataError(f"the peaks are {self.at_most.tolist()}; they should be positive")


@dataclass(frozen=True)
class Measured:
    """What a tube's level rests on: safety_factor² · largest is at most the level.

    largest: E at the scale that the trials `measured_on` were given, all but rank - 1 of them
    within it; `designed_on` are those that observer and storage were chosen on. Each trial is
    (name, digest).
    """

    largest: float
    safety_factor: float
    designed_on: tuple[tuple[str, str], ...]
    measured_on: tuple[tuple[str, str], ...]
    rank: int = 1


@dataclass(frozen=True, eq=False)
class Tube:
    """|y_j - y°_j| <= half_widths_j while E <= level, E+ = rho E + e'R e from 0.

    y° is the model's simulation, e = y - ŷ the innovation of the observer with gain L (n, p).
    P: (n, n), R: (p, p), tau, half_widths: (p,), the latter in the outputs' units. samples: the
    number of samples for which an energy (rho = 1) is assumed; None with rho < 1, for ever.
    measured: what the level rests on. inlet: V = x̄'Px̄ that the start may have. With `follows`,
    level is multiplied at every sample by g, its one row; half_widths are those where g = 1, which
    it is on average over the trials of the design. peak: what else is assumed, of single samples.

    Raises ShapeError or DataError on numbers that do not fit.
    """

    rho: float
    L: FloatArray
    P: FloatArray
    R: FloatArray
    tau: FloatArray
    half_widths: FloatArray
    level: float
    measured: Measured
    samples: int | None = None
    inlet: float = 0.0
    follows: CommandLevel | None = None
    peak: Peak | None = None

    def __post_init__(self) -> None:
        n, p = len(self.P), len(self.R)
        shapes = {"L": (n, p), "P": (n, n), "R": (p, p), "tau": (p,), "half_widths": (p,)}
        freeze(self, "tube", shapes)
        lasting = (self.rho == 1.0) == (self.samples is not None)
        positive = (self.tau > 0).all() and (self.half_widths > 0).all() and self.level > 0
        if not (lasting and positive and 0 < self.rho <= 1 and self.inlet >= 0):
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

    def hidden(self, largest: FloatArray, y: FloatArray) -> FloatArray:
        """(p,) what rounding of the model's simulation can hide, where |x| <= largest (n,).

        y: (p,) its outputs. A step's rounding, |F| |x| UNIT so many times at most, fades by √rho.
        """
        steps = 1.0 / (1.0 - math.sqrt(self.rho)) if self.samples is None else self.samples
        roundings = 4.0 * (len(self.P) + STEPS) * UNIT * steps
        carried = roundings * np.linalg.norm(np.abs(self.factor) @ largest) / np.sqrt(self.tau)
        return np.asarray(carried + STEPS * UNIT * np.abs(y))

    def energy_unit(self, y: Sequence[Signal]) -> str:
        """The unit of E and the level, after a space; empty unless it is the one output's squared.

        Several outputs are weighed by R, and E has no unit.
        """
        plain = len(y) == 1 and y[0].unit and self.R[0, 0] == 1.0
        return f" ({y[0].unit})²" if plain else ""

    @property
    def assumption(self) -> str:
        """What is assumed, in letters."""
        energy = "e'Re" if len(self.R) > 1 else "e²"
        if self.samples is not None:
            return f"Σ {energy} ≤ {self.level:.4g} over {self.samples} samples"
        g, where = (" g", ", g of the commands") if self.follows is not None else ("", "")
        most = " √max(1, g)" if g else ""
        peaks = [] if self.peak is None else self.peak.at_most.tolist()
        peak = f", |e| ≤ {', '.join(f'{each:.4g}' for each in peaks)}{most}" if peaks else ""
        return f"E ≤ {self.level:.4g}{g}, E⁺ = {self.rho:.4g} E + {energy}{peak}{where}"

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        kind: Json = {"kind": "fading"}
        if self.samples is not None:
            kind = {"kind": "energy", "samples": self.samples}
        beside: Json = {} if self.follows is None else {"follows": self.follows.document()}
        if self.peak is not None:
            named = ("at_most", "measured")
            beside["peak"] = {name: getattr(self.peak, name).tolist() for name in named}
            if self.peak.direct.any():
                beside["direct"] = self.peak.direct.tolist()
        return beside | {
            "rho": self.rho,
            "level": self.level,
            "inlet": self.inlet,
            "tau": self.tau.tolist(),
            "half_widths": self.half_widths.tolist(),
            "assumption": kind
            | {
                "measured": self.measured.largest,
                "rank": self.measured.rank,
                "safety_factor": self.measured.safety_factor,
                "designed_on": _named(self.measured.designed_on),
                "measured_on": _named(self.measured.measured_on),
            },
            "L": self.L.tolist(),
            "R": self.R.tolist(),
            "P": self.P.tolist(),
        }


@dataclass(frozen=True, eq=False)
class Cusum:
    """An alarm that nothing rests on: one-sided sums of the innovation, S⁺ = max(0, S ± z - drift).

    z = e / deviation (p,), of the first tube's observer; it alarms where S is above `threshold`.
    Source: E. S. Page, Continuous Inspection Schemes, Biometrika 41 (1954).
    """

    deviation: FloatArray
    drift: float
    threshold: float

    def __post_init__(self) -> None:
        freeze(self, "cusum", {"deviation": (None,)})
        if not (self.deviation > 0.0).all() or not self.threshold > 0.0:
            raise DataError(
                f"cusum: deviation {self.deviation.tolist()} and threshold {self.threshold} should "
                "be positive"
            )

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "deviation": self.deviation.tolist(),
            "drift": self.drift,
            "threshold": self.threshold,
        }


@dataclass(frozen=True, eq=False)
class TubeFunnel:
    """The output is within every one of `tubes` of the model's simulation, whatever the inputs.

    The simulation starts at the observer's state after `settling` samples. y_box (p, 2), u_box
    (n_u, 2): where outputs, states and inputs have to stay, for implicit models whose increments
    are known on a box only; else None. model: its digest. cusum: a second alarm, which is no
    assumption. policy: the digest of the policy whose plan the tubes are around too, None without
    one. commands: (n_u, 3) the least and the largest that each input was in the trials of design
    and calibration, and its largest change in a sample; no part of the claim.
    """

    tubes: tuple[Tube, ...]
    settling: int
    model: str
    y_box: FloatArray | None = None
    u_box: FloatArray | None = None
    cusum: Cusum | None = None
    policy: str | None = None
    commands: FloatArray | None = None

    def __post_init__(self) -> None:
        if not self.tubes:
            raise DataError("a funnel of kind tube holds one tube or more")
        if self.commands is not None:
            freeze(self, "funnel", {"commands": (None, 3)})
        if len({tube.L.shape for tube in self.tubes}) > 1:
            raise ShapeError("the tubes are of models of different sizes")

    @property
    def half_widths(self) -> FloatArray:
        """(p,): the least over the tubes, in the outputs' units."""
        return np.asarray(np.min([tube.half_widths for tube in self.tubes], axis=0))

    def widths(self, k: float) -> FloatArray:
        """(p,): the least over the tubes whose proof covers sample k."""
        lasting = [tube.half_widths for tube in self.tubes if k < (tube.samples or math.inf)]
        return np.asarray(np.min(lasting, axis=0))

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
        """How far out of the allowed starts x̄ (n,) is, beside the plan: 1 on their boundary."""
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
            **({} if self.cusum is None else {"cusum": self.cusum.document()}),
            **({} if self.commands is None else {"commands": self.commands.tolist()}),
            "tubes": [tube.document() for tube in self.tubes],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "TubeFunnel":
        """Raises DocumentError if the document is not a funnel of this kind."""
        files.header(document, FORMAT, source=source, kind=KIND)
        entries = files.member(document, "tubes", list, source=source)
        beside: dict[str, Any] = {}
        if "policy" in document:
            beside["policy"] = files.member(document, "policy", str, source=source)
        if "box" in document:
            given = files.member(document, "box", dict, source=source)
            for key in ("y", "u"):
                beside[f"{key}_box"] = files.array(given, key, (None, 2), source=source)
        if "commands" in document:
            beside["commands"] = files.array(document, "commands", (None, 3), source=source)
        if "cusum" in document:
            beside["cusum"] = _cusum(document["cusum"], f"{source} cusum")
        return cls(
            tubes=tuple(_tube(entry, f"{source} tubes[{i}]") for i, entry in enumerate(entries)),
            **beside,
            settling=files.member(document, "settling", int, source=source),
            model=files.member(document, "model", str, source=source),
        )


def _tube(document: Any, source: str) -> Tube:
    if not isinstance(document, dict):
        raise DocumentError(f"{source} should be an object")
    given = files.member(document, "assumption", dict, source=source)
    kind = files.member(given, "kind", str, source=source)
    if kind not in ("fading", "energy"):
        raise DocumentError(f"{source}: assumption is '{kind}'; known: fading, energy")
    samples = files.member(given, "samples", int, source=source) if kind == "energy" else None
    follows = None
    if "follows" in document:
        follows = CommandLevel.from_document(document["follows"], source=f"{source} follows")
    L, P, R = (files.array(document, key, (None, None), source=source) for key in "LPR")
    return Tube(
        rho=files.number(document, "rho", source=source),
        L=L,
        P=P,
        R=R,
        tau=files.array(document, "tau", (None,), source=source),
        half_widths=files.array(document, "half_widths", (None,), source=source),
        level=files.number(document, "level", source=source),
        measured=Measured(
            files.number(given, "measured", source=source),
            files.number(given, "safety_factor", source=source),
            _trials(given, "designed_on", source),
            _trials(given, "measured_on", source),
            files.member({"rank": 1} | given, "rank", int, source=source),
        ),
        samples=samples,
        inlet=files.number(document, "inlet", source=source),
        follows=follows,
        peak=_peak(document, source),
    )


def _peak(document: Json, source: str) -> Peak | None:
    if "peak" not in document:
        return None
    given = files.member(document, "peak", dict, source=source)
    at_most, measured = (
        files.array(given, key, (None,), source=source) for key in ("at_most", "measured")
    )
    direct = np.zeros_like(at_most)
    if "direct" in document:
        direct = files.array(document, "direct", (None,), source=source)
    return Peak(at_most, measured, direct)


def _cusum(document: Any, source: str) -> Cusum:
    if not isinstance(document, dict):
        raise DocumentError(f"{source} should be an object")
    deviation = files.array(document, "deviation", (None,), source=source)
    return Cusum(
        deviation, *(files.number(document, key, source=source) for key in ("drift", "threshold"))
    )


def _named(trials: tuple[tuple[str, str], ...]) -> list[Json]:
    return [{"name": name, "digest": digest} for name, digest in trials]


def _trials(document: Json, key: str, source: str) -> tuple[tuple[str, str], ...]:
    entries = files.member(document, key, list, source=source)
    return tuple(files.named_digests(entries, source=source))
