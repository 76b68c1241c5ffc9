"""Read signals from the serialised messages of one topic, one after another as they come.

A node decodes no messages: where the lengths in them stay as they were, the numbers are where they
were. The values are those of `bags.signals.reader`, bit for bit.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from rosbags.typesys.store import Typestore

from bags.recordings.cdr import PADDING, Gatherer, Layout
from bags.recordings.message_types import decode
from bags.signals.expressions import Expression
from bags.signals.signal import SignalPath
from nlsid_core.errors import BagError


class MessageReader:
    """Reads the numbers at `paths`, all on one topic, whose messages are of the type `msgtype`."""

    def __init__(self, paths: Sequence[SignalPath], msgtype: str, types: Typestore) -> None:
        self._paths, self._kind = paths, (msgtype, types)
        self._framed = any(path.framed for path in paths)
        self._targets = [path.targets(msgtype, types) for path in paths]
        targets = [target for group in self._targets for target in group]
        self._gatherer = Gatherer(msgtype, types, targets)
        self._layout: _Laid | None = None

    def numbers(self, data: bytes) -> list[float]:
        """The numbers in a serialised message, in the order of the paths.

        A number is NaN if no message in an array has the name. Raises BagError if the message
        cannot be read, a dynamic array is too short, or it lacks the element that is named.
        """
        if self._framed:  # which message of an array is meant differs from message to message
            message = decode(data, *self._kind)
            return [path.value(message) for path in self._paths]
        if self._layout is None or not self._layout.fits(data):
            self._layout = _Laid(self._gatherer.layout(data))
        found = self._layout.numbers(data)
        if len(found) == len(self._paths):
            return found
        left = iter(found)
        parts = ([np.array([next(left)]) for _ in group] for group in self._targets)
        return [float(p.combine(part)[0]) for p, part in zip(self._paths, parts, strict=True)]


class _Laid:
    """A layout as one message is compared with it and read by it."""

    def __init__(self, layout: Layout) -> None:
        words = zip(layout.words.tolist(), layout.expected, strict=True)
        fixed = [*layout.spans, *((at, word.tobytes()) for at, word in words)]
        self._fixed = [(at, at + len(wanted), wanted) for at, wanted in fixed]
        self._least = layout.end
        self._most = layout.end + PADDING if layout.whole else np.inf
        leaves = [
            (target, at, np.dtype(group.kind.of), group.kind.is_bool)
            for group in layout.groups
            for target, at in zip(group.targets.tolist(), group.offsets.tolist(), strict=True)
        ]
        self._leaves = [leaf[1:] for leaf in sorted(leaves, key=lambda leaf: leaf[0])]

    def fits(self, data: bytes) -> bool:
        """Whether a message has this layout."""
        known = (data[start:end] == wanted for start, end, wanted in self._fixed)
        return self._least <= len(data) <= self._most and all(known)

    def numbers(self, data: bytes) -> list[float]:
        """The numbers of a message that fits, in the order of the gatherer's targets."""
        found = (
            (np.frombuffer(data, kind, 1, at).item(), is_bool) for at, kind, is_bool in self._leaves
        )
        return [float(bool(number) if is_bool else number) for number, is_bool in found]


@dataclass(frozen=True)
class SignalVector:
    """Signals in the messages of one topic, such as all positions and rates of a JointState."""

    paths: tuple[SignalPath, ...]

    @classmethod
    def parse(cls, texts: Iterable[str], also: str = "unit") -> "SignalVector":
        """Read where each expression is.

        Raises BagError if they are not all on one topic, or if more is done to one than to name its
        unit or `also`: what is meant then is not the number in a message.
        """
        signals = list(map(Expression.parse, texts))
        for signal in signals:
            if done := [each for each in signal.operations if each.name not in ("unit", also)]:
                raise BagError(
                    f"{signal}: |{done[0]} makes other numbers than those in messages; such a "
                    "signal can be monitored, and not driven"
                )
        topics = {signal.path.topic for signal in signals}
        if len(topics) != 1:
            raise BagError(
                f"live and replayed samples come from one topic, not {', '.join(sorted(topics))}; "
                "publish the whole state in one message"
            )
        return cls(tuple(signal.path for signal in signals))

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
