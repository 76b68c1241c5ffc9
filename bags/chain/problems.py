"""Funnel problems in files: dynamics, nominal, goal and weights as one JSON document."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bags.signals.grid import read_dataset
from bags.signals.sampling import Grid
from nlsid_core import files
from nlsid_core.design import ContinuousTracking, Goal
from nlsid_core.designs import Wiring
from nlsid_core.dynamics import (
    MeasuredPush,
    Nominal,
    PiecewisePolynomial,
    VectorField,
    measured_push,
)
from nlsid_core.errors import DocumentError

FORMAT = "nlsid/funnel_problem"
NEEDED = ("format", "version", "vector_field", "nominal", "goal")
OPTIONS = ("Q", "R", "limits", "error", "hold", "shape")


def load_problem(path: Path) -> ContinuousTracking:
    """Read a problem of a vector field; DocumentError says what is wrong with the file."""
    source = path.name
    document = files.load_document(path)
    files.header(document, FORMAT, source=source)
    for name in document:
        if name not in NEEDED + OPTIONS:
            raise DocumentError(
                f"{source}: '{name}' is no member of a funnel problem; it has: "
                f"{', '.join(NEEDED + OPTIONS)}"
            )

    field = VectorField.from_document(
        files.member(document, "vector_field", dict, source=source), source=source
    )
    motion = files.member(document, "nominal", dict, source=source)
    t = files.array(motion, "t", (None,), source=source)
    x, u = (
        PiecewisePolynomial(t, files.array(motion, key, (None, None, None), source=source))
        for key in ("x", "u")
    )

    shapes = {"Q": (field.n, field.n), "R": (field.m, field.m), "error": (field.n,)}
    kinds: dict[str, Any] = {"hold": (int, float, str), "shape": str}
    options: dict[str, Any] = {}
    for name in OPTIONS:
        if document.get(name) in (None, []):
            continue
        if name in kinds:
            options[name] = files.member(document, name, kinds[name], source=source)
        else:
            options[name] = files.array(document, name, shapes.get(name, (None, 3)), source=source)
    goal = files.member(document, "goal", dict, source=source)
    centre = files.array(goal, "centre", (field.n,), source=source)
    P = files.array(goal, "P", (field.n, field.n), source=source)
    return ContinuousTracking(field, Nominal(x, u), Goal(centre, P), **options)


def measured(
    field: VectorField,
    bags: Sequence[Path],
    wiring: Wiring,
    *,
    seconds: float | None,
    safety_factor: float,
) -> MeasuredPush:
    """What equations leave out of bags.

    wiring: where their states and inputs are; period 0: as the samples come. For the rest see
    `measured_push` and `read_dataset`, whose errors pass through.
    """
    grid = Grid(period=wiring.period or None)
    trials = read_dataset(bags, responses=wiring.response, excitations=wiring.command, grid=grid)
    return measured_push(field, trials, seconds=seconds, safety_factor=safety_factor)
