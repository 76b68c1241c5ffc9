"""`Run`: a controller's word on which funnel it tracks and since when, so that nobody guesses.

A monitor says beside every verdict what it is one of: the digest of its funnel and a word, which is
the run's `start_ns`, WAITING while none is announced, or UNANNOUNCED if it follows none.
"""

from dataclasses import dataclass

from nlsid_core import files
from nlsid_core.arrays import Json

FORMAT = "nlsid/run"
WAITING = "waiting"
UNANNOUNCED = "unannounced"


@dataclass(frozen=True)
class Run:
    """Sample 0 of the policy's plan is the response stamped `start_ns`; funnel: its digest.

    ended: why the run is over, empty while it is on. last_ns: then the stamp of the last response
    under the policy's own input.
    """

    start_ns: int
    funnel: str
    ended: str = ""
    last_ns: int = 0

    @property
    def name(self) -> str:
        """How a verdict names it."""
        return f"{self.funnel} {self.start_ns}"

    def document(self) -> Json:
        """The JSON form."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "start_ns": self.start_ns,
            "funnel": self.funnel,
            "ended": self.ended,
            "last_ns": self.last_ns,
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "run") -> "Run":
        """Raises DocumentError if the document is not a run."""
        files.header(document, FORMAT, source=source)
        return cls(
            start_ns=files.member(document, "start_ns", int, source=source),
            funnel=files.member(document, "funnel", str, source=source),
            ended=files.member(document, "ended", str, source=source),
            last_ns=files.member(document, "last_ns", int, source=source),
        )
