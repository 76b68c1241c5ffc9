"""Every number in a bag as a signal that can be copied: joints by name, angles, ranges, units.

Memory: one chunk, and two numbers a signal.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from rosbags.typesys.store import Typestore

from bags.recordings.bag import Bag
from bags.recordings.cdr import Step, is_strings
from bags.recordings.message_types import decode, fields_of
from bags.signals.columns import TopicReader
from bags.signals.signal import ANGLES, QUATERNION, SignalPath, numeric_paths
from bags.signals.units import implied_unit
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

MAX_NAMED: Final = 64  # elements of one array that are listed by name
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
TRANSFORMS_READ: Final = 1000  # messages in which frames are looked for
MAX_ELEMENTS: Final = 4096  # of one array whose range is found; more is an image


@dataclass(frozen=True)
class Listed:
    """A signal: its text, type of number and unit; low, high: NaN where they are not known.

    elements: how many signals a text with `[*]` stands for (0: there is no message), 1 without.
    note: why nothing is known.
    """

    signal: str
    number: str
    unit: str
    elements: int = 1
    low: float = float("nan")
    high: float = float("nan")
    note: str = ""


def bag_signals(bag: Bag, *, progress: Progress = silent) -> list[Listed]:
    """Every number of every topic, in the order of the topics; reads the whole bag once."""
    topics = {topic: _Topic(bag, topic) for topic in bag.topics}
    wanted = [topic for topic, listing in topics.items() if listing.names]
    for channel, batch in bag.batches(wanted, progress=progress):
        topics[channel.topic].read(batch)
    return [listed for listing in topics.values() for listed in listing.listed()]


@dataclass
class _Topic:
    bag: Bag
    topic: str
    names: dict[str, list[str]] = field(default_factory=dict)  # text -> the columns it stands for

    def __post_init__(self) -> None:
        self._rows: list[Listed] = []
        self._low: dict[str, float] = {}
        self._high: dict[str, float] = {}
        self._reader: TopicReader | None = None
        try:
            msgtype, types = self.bag.types_on(self.topic)
            first = next((batch for _, batch in self.bag.batches([self.topic])), None)
            message: Any = None if first is None else decode(first.data(0), msgtype, types)
            if msgtype == TRANSFORMS and first is not None:  # each publisher sends its own frames
                rows = range(min(len(first), TRANSFORMS_READ))
                message = [decode(first.data(k), msgtype, types) for k in rows]
            columns: dict[str, SignalPath] = {}
            for listed, elements in _paths(self.topic, msgtype, types, message):
                count = len(elements) if "[*]" in listed.signal else 1
                self._rows.append(replace(listed, elements=count))
                if 0 < len(elements) <= MAX_ELEMENTS:
                    self.names[listed.signal] = [str(path) for path in elements]
                    columns |= {str(path): path for path in elements}
            if columns:
                self._reader = TopicReader(self.bag, self.topic, columns)
        except BagError as error:
            self._rows = [Listed(self.topic, "", "", note=str(error)[:200])]
            self.names = {}

    def read(self, batch: Any) -> None:
        if self._reader is None:
            return
        try:
            values = self._reader.read(batch).values
        except BagError as error:  # arrays that change their length have no columns
            self._reader, self._low = None, {}
            self._rows = [replace(row, note=str(error)[:200]) for row in self._rows]
            return
        for name, column in values.items():
            finite = column[np.isfinite(column)]
            if len(finite):
                self._low[name] = min(self._low.get(name, np.inf), float(finite.min()))
                self._high[name] = max(self._high.get(name, -np.inf), float(finite.max()))

    def listed(self) -> list[Listed]:
        """The rows with what was found."""
        found = []
        for row in self._rows:
            known = [name for name in self.names.get(row.signal, ()) if name in self._low]
            low = min((self._low[name] for name in known), default=row.low)
            high = max((self._high[name] for name in known), default=row.high)
            found.append(replace(row, low=low, high=high))
        return found


def _paths(
    topic: str, msgtype: str, types: Typestore, message: Any
) -> Iterator[tuple[Listed, Sequence[SignalPath]]]:
    """Each signal, and the single signals in the first message that it stands for."""
    if msgtype == TRANSFORMS:
        yield from _transforms(topic, message)
        return
    last_angle = ""
    for text, number, owners in numeric_paths(msgtype, types):
        path = SignalPath.parse(f"{topic}:{text}")
        listed = Listed(str(path), number, implied_unit(owners))
        elements = [] if message is None else path.expand(message) if path.every else [path]
        named = _named(path, elements, msgtype, types, message)
        if named:
            for single in named:
                yield replace(listed, signal=str(single)), [single]
            continue
        yield listed, elements
        if len(owners) > 1 and owners[-1][0] == QUATERNION and path.steps[-1].field == "w":
            for angle in ANGLES:
                turned = replace(path, steps=(*path.steps[:-1], Step(angle)))
                if str(turned) != last_angle and not turned.every:
                    last_angle = str(turned)
                    yield Listed(str(turned), number, "rad"), [turned] if message else []


def _transforms(topic: str, message: Any) -> Iterator[tuple[Listed, Sequence[SignalPath]]]:
    """Position and angles of each frame."""
    sent = [part.child_frame_id for each in message or () for part in each.transforms]
    for frame in dict.fromkeys(sent):
        if not frame or set("[]=|") & set(frame):
            continue  # a path cannot name it
        for text, unit in (
            *((f"translation.{axis}", "m") for axis in "xyz"),
            *((f"rotation.{angle}", "rad") for angle in ANGLES),
        ):
            path = SignalPath.parse(f"{topic}:transforms[child_frame_id={frame}].transform.{text}")
            yield Listed(str(path), "float64", unit), [path]


def _named(
    path: SignalPath,
    elements: Sequence[SignalPath],
    msgtype: str,
    types: Typestore,
    message: Any,
) -> list[SignalPath]:
    """The elements by the strings beside them, if each has one of its own: joints by name."""
    if not path.every or len(path.steps) != 1 or not 0 < len(elements) <= MAX_NAMED:
        return []
    for name, description in fields_of(msgtype, types).items():
        if name == path.steps[0].field:
            break
        texts = list(getattr(message, name)) if is_strings(description) else []
        if len(texts) == len(elements) == len(set(texts)) and all(texts):
            steps = [Step(path.steps[0].field, key=(name, text)) for text in texts]
            return [replace(path, steps=(step,)) for step in steps if "]" not in str(step)[:-1]]
    return []
