"""What every model document shares: its header and the signals it is about."""

from dataclasses import dataclass

from nlsid_core import files
from nlsid_core.arrays import Json

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
