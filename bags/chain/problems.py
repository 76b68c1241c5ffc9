"""Funnel problems in files: dynamics, nominal, goal and weights as one JSON document."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.continuous import Nominal, PiecewisePolynomial, VectorField
from nlsid_core.errors import DocumentError
from nlsid_core.funnels import FunnelDesign, Goal, design_funnel
from nlsid_core.funnels.sweep import Progress

FORMAT = "nlsid/funnel_problem"
VERSION = 1


@dataclass(frozen=True, eq=False)
class FunnelProblem:
    """What `design_funnel` takes, in its words. Q: (n, n), R: (m, m), rho: (K,) or none.

    limits: (L, 3) rows (input, low, high) at which inputs saturate. In a file, search, objective,
    rho and limits may be left out.
    """

    field: VectorField
    nominal: Nominal
    Q: FloatArray
    R: FloatArray
    goal: Goal | None = None
    shape: str = "rho"
    gain: str = "constant"
    search: str = "sweep"
    objective: str = "volume"
    rho: FloatArray | None = None
    limits: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        goal = self.goal and {"centre": self.goal.centre.tolist(), "P": self.goal.P.tolist()}
        return {
            "format": FORMAT,
            "version": VERSION,
            "shape": self.shape,
            "gain": self.gain,
            "search": self.search,
            "objective": self.objective,
            "rho": None if self.rho is None else self.rho.tolist(),
            "vector_field": self.field.document(),
            "nominal": {
                "t": self.nominal.t.tolist(),
                "x": self.nominal.x.control.tolist(),
                "u": self.nominal.u.control.tolist(),
            },
            "goal": goal,
            "Q": self.Q.tolist(),
            "R": self.R.tolist(),
            "limits": self.limits.tolist(),
        }

    @classmethod
    def load(cls, path: Path) -> "FunnelProblem":
        """Raises DocumentError if the file is not a funnel problem."""
        source = path.name
        document = _json.load_document(path)
        _json.header(document, FORMAT, VERSION, source=source)
        field = VectorField.from_document(
            _json.member(document, "vector_field", dict, source=source), source=source
        )
        motion = _json.member(document, "nominal", dict, source=source)
        t = _json.array(motion, "t", (None,), source=source)
        parts = [
            PiecewisePolynomial(t, _json.array(motion, key, (None, None, None), source=source))
            for key in ("x", "u")
        ]
        return cls(
            field,
            Nominal(*parts),
            _json.array(document, "Q", (field.n, field.n), source=source),
            _json.array(document, "R", (field.m, field.m), source=source),
            _goal(document, field.n, source),
            _json.member(document, "shape", str, source=source),
            _json.member(document, "gain", str, source=source),
            _json.member({"search": "sweep"} | document, "search", str, source=source),
            _json.member({"objective": "volume"} | document, "objective", str, source=source),
            None
            if document.get("rho") is None
            else _json.array(document, "rho", (None,), source=source),
            _limits(document, source),
        )

    def design(self, progress: Progress | None = None) -> FunnelDesign:
        """See `design_funnel`."""
        return design_funnel(
            self.field,
            self.nominal,
            goal=self.goal,
            shape=self.shape,
            gain=self.gain,
            search=self.search,
            objective=self.objective,
            rho=self.rho,
            Q=self.Q,
            R=self.R,
            limits=self.limits if len(self.limits) else None,
            progress=progress,
        )


def _limits(document: Json, source: str) -> FloatArray:
    if "limits" not in document:
        return np.zeros((0, 3))
    rows = _json.member(document, "limits", list, source=source)
    return _json.array(document, "limits", (len(rows), 3), source=source)


def _goal(document: Json, n: int, source: str) -> Goal | None:
    if "goal" not in document:
        raise DocumentError(f"{source}: 'goal' is missing; null asks for the largest at the end")
    if document["goal"] is None:
        return None
    goal = _json.member(document, "goal", dict, source=source)
    centre = _json.array(goal, "centre", (n,), source=source)
    return Goal(np.array(centre), np.array(_json.array(goal, "P", (n, n), source=source)))
