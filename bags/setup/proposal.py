"""A proposed configuration: its keys, the reason of each, and what later steps will meet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from bags.chain.config import Config
from bags.pictures.tables import in_unit
from nlsid_core.identification import Choice

POOR: Final = 50.0  # % of error in simulation, above which a model says little
GRADES: Final = ((10.0, "good"), (25.0, "fair"), (POOR, "weak: the tube will be wide"))


@dataclass
class Proposal:
    """A configuration as nested keys (`content`), a reason for keys (`why`), and later walls.

    doubts: what seems wrong with what was given, as questions to who gave it.
    """

    content: dict[str, Any]
    why: dict[str, str] = field(default_factory=dict)
    walls: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    choice: Choice | None = None  # of everything that was tried, if something was taken

    @property
    def error(self) -> float:
        """% of the response's spread; infinite if nothing is promised."""
        return math.inf if self.choice is None else self.choice.promise.percent

    @property
    def expectation(self) -> str:
        """How good a model will be, as far as what was tried says."""
        if self.choice is None:
            return (
                "nothing is promised: no model could be held against data that it was not fitted to"
            )
        grade = next((word for most, word in GRADES if self.error <= most), "poor: it says little")
        promise = self.choice.promise
        said = (
            f"expect an error in simulation of {promise}"
            f"{in_unit(self.choice.held_out.data, promise.low, promise.high)}: {grade}"
        )
        return f"{said}, if the question above is answered" if self.doubts else said

    def config(self, definitions: Sequence[Path] = ()) -> Config:
        """As the later steps read it."""
        return Config.model_validate(self.content).model_copy(
            update={"definitions": tuple(definitions)}
        )
