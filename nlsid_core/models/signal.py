"""What every model document shares: its header and the signals it is about."""

from dataclasses import dataclass
from typing import Literal

from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DocumentError

FORMAT = "nlsid/model"


@dataclass(frozen=True)
class Signal:
    """A signal's name, unit, and `topic:field.path` it is read from (empty: not from a topic)."""

    name: str
    unit: str = ""
    path: str = ""

    def document(self) -> Json:
        """The JSON form."""
        return {"name": self.name, "unit": self.unit, "path": self.path}

    @classmethod
    def from_document(cls, document: Json, *, source: str) -> "Signal":
        """Raises DocumentError if a part is missing."""
        return cls(
            *(files.member(document, key, str, source=source) for key in ("name", "unit", "path"))
        )


def signals_of(trial: Trajectory, letter: Literal["y", "u"]) -> tuple[Signal, ...]:
    """The responses or the excitations of a trajectory."""
    columns = (getattr(trial, f"{letter}_{key}") for key in ("names", "units", "paths"))
    return tuple(Signal(*labels) for labels in zip(*columns, strict=True))


def objects(document: Json, key: str, *, source: str) -> list[Json]:
    """The objects of the list `document[key]`. Raises DocumentError if it is none."""
    entries: list[Json] = files.member(document, key, list, source=source)
    if not all(isinstance(entry, dict) for entry in entries):
        raise DocumentError(f"{source}: {key} should be a list of objects")
    return entries


def signals(document: Json, key: str, *, source: str) -> tuple[Signal, ...]:
    """The signals of the list `document[key]`. Raises DocumentError if it is none."""
    entries = objects(document, key, source=source)
    return tuple(Signal.from_document(entry, source=f"{source} {key}") for entry in entries)
