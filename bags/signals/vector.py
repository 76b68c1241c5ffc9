"""`SignalVector`: several signals of one topic, read as one vector."""

from collections.abc import Iterable
from dataclasses import dataclass

from rosbags.typesys.store import Typestore

from bags.signals.expressions import Expression
from bags.signals.message_reader import MessageReader
from bags.signals.signal import SignalPath
from nlsid_core.errors import BagError


@dataclass(frozen=True)
class SignalVector:
    """Signals in the messages of one topic, such as all positions and rates of a JointState."""

    paths: tuple[SignalPath, ...]

    @classmethod
    def parse(cls, texts: Iterable[str]) -> "SignalVector":
        """Read where each expression is; BagError if they are not all on one topic."""
        paths = tuple(Expression.parse(text).path for text in texts)
        topics = {path.topic for path in paths}
        if len(topics) != 1:
            raise BagError(
                f"live and replayed samples come from one topic, not {', '.join(sorted(topics))}; "
                "publish the whole state in one message"
            )
        return cls(paths)

    def __str__(self) -> str:
        fields = [str(path).removeprefix(f"{self.topic}:") for path in self.paths]
        return f"{self.topic}:{', '.join(fields)}"

    @property
    def topic(self) -> str:
        """The one topic."""
        return self.paths[0].topic

    def check(self, msgtype: str, types: Typestore) -> None:
        """BagError unless messages of `msgtype` have a number at each."""
        for path in self.paths:
            path.check(msgtype, types)

    def reader(self, msgtype: str, types: Typestore) -> MessageReader:
        """What reads the numbers in serialised messages of this type."""
        return MessageReader(self.paths, msgtype, types)
