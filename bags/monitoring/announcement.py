"""`Run`: a controller's word on which funnel it tracks and since when, so that nobody guesses."""

from dataclasses import dataclass

from nlsid_core import _json
from nlsid_core._types import Json

FORMAT = "nlsid/run"
VERSION = 1


@dataclass(frozen=True)
class Run:
    """Sample 0 of the policy's plan is the response stamped `start_ns`; funnel: its digest."""

    start_ns: int
    funnel: str

    def document(self) -> Json:
        """The JSON form."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "start_ns": self.start_ns,
            "funnel": self.funnel,
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "run") -> "Run":
        """Raises DocumentError if the document is not a run."""
        _json.header(document, FORMAT, VERSION, source=source)
        return cls(
            start_ns=_json.member(document, "start_ns", int, source=source),
            funnel=_json.member(document, "funnel", str, source=source),
        )
