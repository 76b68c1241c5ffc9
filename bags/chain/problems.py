"""Funnel problems in files: dynamics, nominal, goal and weights as one JSON document."""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bags.monitoring.catching import Breaking, breaking
from bags.signals.grid import read_dataset
from bags.signals.sampling import Grid
from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design import ContinuousTracking, FunnelDesign, Goal, design
from nlsid_core.designs import Wiring
from nlsid_core.dynamics import (
    MeasuredPush,
    Nominal,
    PiecewisePolynomial,
    VectorField,
    measured_push,
)
from nlsid_core.errors import DocumentError
from nlsid_core.progress import Progress, silent

FORMAT = "nlsid/funnel_problem"
MEMBERS = (
    "format",
    "version",
    "shape",
    "vector_field",
    "nominal",
    "goal",
    "Q",
    "R",
    "limits",
    "hold",
    "error",
    "push",
)


@dataclass(frozen=True, eq=False)
class FunnelProblem:
    """`ContinuousTracking` with a vector field, in its words.

    limits: (L, 3) rows (input, low, high) at which inputs saturate. push: what recordings differ
    from `field` by, for which the funnel is proved too. A file has format, version,
    vector_field, nominal and goal; the rest may be left out.
    """

    field: VectorField
    nominal: Nominal
    goal: Goal
    Q: FloatArray | None = None
    R: FloatArray | None = None
    shape: str = "rho"
    limits: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    hold: float | Literal["largest"] | None = None
    error: FloatArray | None = None
    push: MeasuredPush | None = None

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "shape": self.shape,
            "vector_field": self.field.document(),
            "nominal": {
                "t": self.nominal.t.tolist(),
                "x": self.nominal.x.control.tolist(),
                "u": self.nominal.u.control.tolist(),
            },
            "goal": {"centre": self.goal.centre.tolist(), "P": self.goal.P.tolist()},
            "Q": None if self.Q is None else self.Q.tolist(),
            "R": None if self.R is None else self.R.tolist(),
            "limits": self.limits.tolist(),
            "hold": self.hold,
            "error": None if self.error is None else self.error.tolist(),
            "push": None if self.push is None else self.push.document(),
        }

    @classmethod
    def load(cls, path: Path) -> "FunnelProblem":
        """Raises DocumentError if the file is not a funnel problem."""
        source = path.name
        document = files.load_document(path)
        files.header(document, FORMAT, source=source)
        for name in document:
            if name not in MEMBERS:
                raise DocumentError(
                    f"{source}: '{name}' is no member of a funnel problem; it has: "
                    f"{', '.join(MEMBERS)}"
                )
        field = VectorField.from_document(
            files.member(document, "vector_field", dict, source=source), source=source
        )
        motion = files.member(document, "nominal", dict, source=source)
        t = files.array(motion, "t", (None,), source=source)
        parts = [
            PiecewisePolynomial(t, files.array(motion, key, (None, None, None), source=source))
            for key in ("x", "u")
        ]
        hold = document.get("hold")
        if hold is not None:
            hold = files.member(document, "hold", (int, float, str), source=source)
        words = {"shape": "rho"} | document
        return cls(
            field,
            Nominal(*parts),
            _goal(document, field.n, source),
            _array(document, "Q", (field.n, field.n), source),
            _array(document, "R", (field.m, field.m), source),
            files.member(words, "shape", str, source=source),
            _limits(document, source),
            hold,
            _array(document, "error", (field.n,), source),
            _push(document, field.n, source),
        )

    def design(
        self, progress: Progress = silent, *, executor: Executor | None = None
    ) -> FunnelDesign:
        """Solve it, its L-steps shared by an executor; raises as `nlsid_core.design.design`."""
        problem = ContinuousTracking(
            self.field if self.push is None else self.field.pushed(self.push.box),
            self.nominal,
            goal=self.goal,
            shape=self.shape,  # type: ignore[arg-type]  # checked by the problem
            Q=self.Q,
            R=self.R,
            limits=self.limits if len(self.limits) else None,
            hold=self.hold,
            error=self.error,
        )
        return design(problem, executor=executor, progress=progress)


def measured(
    path: Path,
    bags: Sequence[Path],
    wiring: Wiring,
    *,
    seconds: float | None,
    safety_factor: float,
    resample: str = "none",
) -> tuple[FunnelProblem, Breaking]:
    """The problem of a file with what its equations leave out of bags; and what would break that.

    wiring: where its states and inputs are; period 0: as the samples come. For the rest see
    `measured_push` and `read_dataset`, whose errors pass through.
    """
    problem = FunnelProblem.load(path)
    grid = Grid(period=wiring.period or None, resample=resample)
    trials = read_dataset(bags, responses=wiring.response, excitations=wiring.command, grid=grid)
    push = measured_push(problem.field, trials, seconds=seconds, safety_factor=safety_factor)
    found = breaking(trials, lambda trial: push.used(problem.field, trial))
    return dataclasses.replace(problem, push=push), found


def _array(
    document: Json, name: str, shape: tuple[int | None, ...], source: str
) -> FloatArray | None:
    """The array, None where it is left out or null."""
    if document.get(name) is None:
        return None
    return files.array(document, name, shape, source=source)


def _limits(document: Json, source: str) -> FloatArray:
    if "limits" not in document:
        return np.zeros((0, 3))
    rows = files.member(document, "limits", list, source=source)
    return files.array(document, "limits", (len(rows), 3), source=source)


def _goal(document: Json, n: int, source: str) -> Goal:
    goal = files.member(document, "goal", dict, source=source)
    centre = files.array(goal, "centre", (n,), source=source)
    return Goal(np.array(centre), np.array(files.array(goal, "P", (n, n), source=source)))


def _push(document: Json, n: int, source: str) -> MeasuredPush | None:
    if document.get("push") is None:
        return None
    given = files.member(document, "push", dict, source=source)
    push = MeasuredPush.from_document(given, source=f"{source} push")
    if push.largest.shape[1] != n:
        raise DocumentError(f"{source}: the push is of {push.largest.shape[1]} states, not {n}")
    return push
