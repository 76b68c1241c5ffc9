"""`DiscreteFunnel`: a tube around a nominal motion of a state model, and what it rests on."""

from dataclasses import dataclass

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnel import FORMAT, VERSION

KIND = "discrete"
FORMS = ("response", "peak", "energy", "fading")  # how the disturbance is bounded


@dataclass(frozen=True)
class DisturbanceAssumption:
    """What the tube rests on: d_k = x̂_{k+1} - f(x̂_k, u_k), the observer's correction, stays small.

    form `response`: r_{k+1} = A_k r_k + d_k, r_0 = 0, and |S_k r_k| ≤ bound. `peak`:
    |S_{k+1} d_k| ≤ bound. `energy` and `fading`: E_{k+1} = rate·E_k + gain·|S_{k+1} d_k|²,
    E_0 = 0, and √E_k ≤ bound; rate is 1 for `energy`, below 1 for `fading`. bound ≥ safety_factor ·
    measured, measured being the largest over the commissioning runs `measured_on` (name, digest),
    none of which the model was fitted on.
    """

    form: str
    bound: float
    measured: float
    safety_factor: float
    measured_on: tuple[tuple[str, str], ...]
    rate: float = 1.0
    gain: float = 1.0

    @property
    def widens(self) -> float:
        """What is added to a radius for it: the bound, but for `peak`, which is in the radius."""
        return 0.0 if self.form == "peak" else self.bound


@dataclass(frozen=True, eq=False)
class DiscreteFunnel:
    """|S_k(x̂_k - x_k)| ≤ radius_k, k = 0 … N, around the nominal (x_k) of a policy.

    S: (N + 1, n, n), upper triangular, S'S the shape. A: (N, n, n), of the disturbance's response.
    tube: (N + 1,) radii of what starts with |S_0 x̄_0| ≤ tube_0 do; inlet: (N + 1,) radii from
    which the goal inlet_N is reached. Unless the form is `peak` the radius is tube + bound. Radii
    are in the norm of S, without unit. roots, of an implicit model only: (N + 1,), at sample k + 1
    the next rates v are claimed to be within |S_vv (v - v_{k+1})| ≤ roots_{k+1}, S_vv the block of
    the rates; farther ones are spurious. `model` and `policy` are digests.

    Raises ShapeError or DataError on numbers that do not fit.
    """

    S: FloatArray
    A: FloatArray
    tube: FloatArray
    inlet: FloatArray
    assumption: DisturbanceAssumption
    model: str
    policy: str
    roots: FloatArray | None = None

    def __post_init__(self) -> None:
        for key in ("S", "A", "tube", "inlet") + (() if self.roots is None else ("roots",)):
            values = np.array(getattr(self, key), dtype=np.float64)
            if not np.isfinite(values).all():
                raise DataError(f"funnel: {key} holds NaN or infinity")
            values.setflags(write=False)
            object.__setattr__(self, key, values)
        n = self.S.shape[-1] if self.S.ndim == 3 else 0
        length = len(self.S)
        shapes = (self.S.shape, self.A.shape, self.tube.shape, self.inlet.shape)
        if length < 2 or shapes != (
            (length, n, n),
            (length - 1, n, n),
            (length,),
            (length,),
        ):
            raise ShapeError(f"funnel: S, A, tube and inlet do not fit: {shapes}")
        if (np.tril(self.S, -1) != 0).any() or (np.diagonal(self.S, axis1=1, axis2=2) == 0).any():
            raise DataError("funnel: S should be upper triangular with a nonzero diagonal")
        if self.roots is not None and (self.roots.shape != (length,) or not (self.roots > 0).all()):
            raise DataError(f"funnel: roots should be {length} positive radii")
        if not ((self.tube > 0).all() and (self.inlet > 0).all() and self.tube[0] <= self.inlet[0]):
            raise DataError("funnel: radii should be positive, and the tube start in the inlet")
        if self.assumption.form not in FORMS or self.assumption.bound < 0:
            raise DataError(f"funnel: unknown form '{self.assumption.form}' or negative bound")

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
        return self.assumption.widens

    @property
    def half_widths(self) -> FloatArray:
        """(N + 1, n): the largest |x̄_i| in the tube, in the signals' units."""
        axes = np.linalg.norm(np.linalg.inv(self.S), axis=2)
        return np.asarray(self.radius[:, None] * axes)

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        a = self.assumption
        roots = {} if self.roots is None else {"roots": self.roots.tolist()}
        return {
            "format": FORMAT,
            "version": VERSION,
            "kind": KIND,
            "set": "|S[k] (xhat - x[k])| <= tube[k] (+ bound, unless form peak)",
            "model": self.model,
            "policy": self.policy,
            "assumption": {
                "form": a.form,
                "bound": a.bound,
                "rate": a.rate,
                "gain": a.gain,
                "measured": a.measured,
                "safety_factor": a.safety_factor,
                "measured_on": [{"name": n, "digest": d} for n, d in a.measured_on],
            },
            "tube": self.tube.tolist(),
            "inlet": self.inlet.tolist(),
            "S": self.S.tolist(),
            "A": self.A.tolist(),
            **roots,
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "DiscreteFunnel":
        """Raises DocumentError if the document is not a discrete funnel."""
        _json.header(document, FORMAT, VERSION, source=source)
        if document.get("kind") != KIND:
            raise DocumentError(f"{source}: kind is {document.get('kind')!r}, expected '{KIND}'")
        nested = _json.member(document, "assumption", dict, source=source)
        where = f"{source} assumption"
        runs = _json.member(nested, "measured_on", list, source=where)
        arrays = {
            key: _json.array(document, key, (None,) * axes, source=source)
            for key, axes in (("S", 3), ("A", 3), ("tube", 1), ("inlet", 1), ("roots", 1))
            if key != "roots" or key in document
        }
        return cls(
            assumption=DisturbanceAssumption(
                form=_json.member(nested, "form", str, source=where),
                bound=_json.number(nested, "bound", source=where),
                rate=_json.number(nested, "rate", source=where),
                gain=_json.number(nested, "gain", source=where),
                measured=_json.number(nested, "measured", source=where),
                safety_factor=_json.number(nested, "safety_factor", source=where),
                measured_on=tuple(_json.named_digests(runs, source=where)),
            ),
            model=_json.member(document, "model", str, source=source),
            policy=_json.member(document, "policy", str, source=source),
            **arrays,
        )
