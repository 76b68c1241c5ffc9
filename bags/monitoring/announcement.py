"""`Run`: a controller's word on which funnel it tracks and since when, so that nobody guesses."""

from dataclasses import dataclass

from nlsid_core import files
from nlsid_core.arrays import Json

FORMAT = "nlsid/run"


@dataclass(frozen=True)
class Run:
    """Sample 0 of the policy's plan is the response stamped `start_ns`; funnel: its digest."""

    start_ns: int
    funnel: str

    def document(self) -> Json:
        """The JSON form."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "start_ns": self.start_ns,
            "funnel": self.funnel,
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "run") -> "Run":
        """Raises DocumentError if the document is not a run."""
        files.header(document, FORMAT, source=source)
        return cls(
            start_ns=files.member(document, "start_ns", int, source=source),
            funnel=files.member(document, "funnel", str, source=source),
        )
