"""Claims of kind `hybrid_funnel` of one state, whose truth is known: on the guard x is a number.

`switch`: x falls by dx/dt = -1 - x/2 to 0, where the mode changes to dx/dt = -1/2 - x. `cycle`: at
0 it is put back to 1. What arrives is off by up to SLOP.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.design import Goal, compose_jumps, design_funnel, integrate_nominal
from nlsid_core.designs import HYBRID
from nlsid_core.dynamics import Jump, VectorField

SLOP = 0.01
WATCHED = 0.5


def falling(x: Any) -> list[Any]:
    """dx/dt until it is 0."""
    return [-1 - x[0] / 2]


def after(x: Any) -> list[Any]:
    """dx/dt from then on."""
    return [-0.5 - x[0]]


def saved(rate: Any, start: float, t: Any, width: float, folder: Path) -> Path:
    """The proof of a funnel from `start`, of about this half-width at its end."""
    field = VectorField.from_function(rate, 1, 0)
    motion = integrate_nominal(field, lambda _: np.zeros(0), t=t, start=[start])
    end = motion.x.ends()[-1]
    return design_funnel(field, motion, goal=Goal(end, np.eye(1) / width**2)).save(folder)[-1]


def jump(lifted: float) -> Jump:
    """At 0, to `lifted` and up to SLOP beside it."""
    return Jump.of(
        lambda x: [x[0]], lambda x, w: [x[0] + lifted + SLOP * w[0]], 1, start=WATCHED,
        uncertain=[[-1.0, 1.0]],
    )  # fmt: skip


def written(name: str, folder: Path) -> Path:
    """The files of `switch` or `cycle`; the path of the whole proof."""
    first = saved(falling, 1.0, [0.0, WATCHED, 0.85, 1.2], 0.1, folder / "first")
    if name == "cycle":
        return compose_jumps([first], [jump(1.0)], folder / name)
    second = saved(after, 0.0, [0.0, 0.5, 1.0], 0.05, folder / "second")
    return compose_jumps([first, second], [jump(0.0)], folder / name)


def documents(path: Path) -> dict[str, Json]:
    """The documents of a folder by name, the whole proof's among them."""
    found = {p.name: files.load_document(p) for p in path.parent.iterdir()}
    assert HYBRID in found
    return found
