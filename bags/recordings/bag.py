"""An open bag: its topics, what it states, and its messages in log order or in batches.

Bags are untrusted. Whatever is wrong with one leaves here as a BagError that names the bag.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from mcap.records import Attachment, Metadata
from rosbags.typesys.store import Typestore

from bags.recordings.batch import Batch, LogOrder
from bags.recordings.definitions import Definition
from bags.recordings.folders import METADATA, BagFiles, bag_files, data_files, without_twins
from bags.recordings.mcap_file import Whole
from bags.recordings.message_types import are_same, ros2_definition, types_in_bag
from bags.recordings.names import did_you_mean, listed
from bags.recordings.quality import Profile
from bags.recordings.remote import place
from bags.recordings.storage import ALWAYS, Channel, Raw, Spans, Storage, Takes, defined
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

RECOVER: Final = "`nlsid bag recover`"


class Message(NamedTuple):
    """One recorded message, still serialised."""

    topic: str
    msgtype: str
    log_time_ns: int
    data: bytes
    publish_time_ns: int = 0


class Bag:
    """A bag open for reading. Use as a context manager.

    A bag is a rosbag2 folder, one of its files, or a ROS 1 bag: MCAP, SQLite or ROS 1, split or
    not, compressed or not; of MCAP also one in object storage, by its URL
    (`bags.recordings.remote`).
    Raises BagError if there is no such bag, if it is damaged or not a bag, or if it is unfinished.
    With `unfinished=True` the last is no error: the messages there are can be read, and `ending`
    says why there may be more. With `salvage=True` damage is no error either: what cannot be read
    is listed in `lost`, and every data file in the folder is read, whatever its metadata say.
    definitions: of types that the bag itself does not define.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        unfinished: bool = False,
        salvage: bool = False,
        definitions: Mapping[str, Definition] | None = None,
    ) -> None:
        self.path = place(path)
        self._described, self._damaged = _described(self.path, salvage=salvage)
        self.files: tuple[Path, ...] = self._described.files
        self.ending: str | None = None
        if not self._described.finished:
            self.ending = f"it has no {METADATA}: the recording was not closed"
        self.storage = Storage(self.files, salvage=salvage)
        self.storage.channels = [
            defined(self._encoded(channel), definitions or {}, self.release)
            for channel in self.storage.channels
        ]
        if self.storage.ending is not None:  # of a bag that is one file that is said already
            self.ending = self.storage.ending.removeprefix(f"{self.path}: ")
        if self.ending is not None and not (unfinished or salvage):
            self.close()
            raise BagError(self._unfinished())

    def _encoded(self, channel: Channel) -> Channel:
        """The channel, with the encoding that the metadata state where its file says CDR."""
        described = (self._described.topics or {}).get(channel.topic)
        if described is None or channel.encoding != "cdr":
            return channel
        return replace(channel, encoding=described.encoding)

    def close(self) -> None:
        """Close the bag's files."""
        self.storage.close()

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def channels(self) -> Sequence[Channel]:
        """The recorded streams; a topic has one, or several in a split bag."""
        return self.storage.channels

    @cached_property
    def topics(self) -> dict[str, str]:
        """Topic -> message type, in the order of recording; several types are joined by ' and '."""
        types: dict[str, list[str]] = {}
        for channel in self.channels:
            known = types.setdefault(channel.topic, [])
            if channel.msgtype not in known:
                known.append(channel.msgtype)
        return {topic: " and ".join(names) for topic, names in types.items()}

    @property
    def custom(self) -> dict[str, str]:
        """The bag's own metadata: `custom_data` of the MCAP files and, before it, metadata.yaml."""
        return {**self.storage.custom, **self._described.custom}

    @property
    def release(self) -> str:
        """The release of ROS 2 that recorded it, as it says; empty if it does not."""
        return self._described.release or self.storage.release

    @property
    def lost(self) -> tuple[str, ...]:
        """What cannot be read, as far as it was found by now, and why."""
        return (*self._damaged, *self.storage.lost)

    @property
    def kept_beside(self) -> Iterator[Metadata | Attachment]:
        """The bag's records that are no messages, but for `custom`."""
        yield from self.storage.records
        yield from self.storage.attachments()

    @property
    def statements(self) -> tuple[str, ...]:
        """What in the bag says how many messages there should be."""
        said = {
            METADATA: self._described.topics is not None,
            "the files' statistics and indexes": self.storage.stated is not None,
        }
        return tuple(name for name, there in said.items() if there)

    @property
    def disagreements(self) -> tuple[str, ...]:
        """Where what the bag states and what is there differ, in words."""
        found = [*self._described.notes]
        said = {METADATA: self._counts, "the file": self.storage.stated}
        for name, counts in said.items():
            for topic in {**counts, **self.topics} if counts is not None else ():
                stated, there = (counts or {}).get(topic, 0), self._there(topic)
                if stated != there:
                    found.append(f"{topic}: {name} states {stated} messages, {there} are there")
                elif topic not in self.topics:
                    found.append(f"{topic}: {name} lists it, no file declares it")
        total, there = self._described.total, sum(channel.count for channel in self.channels)
        if total not in (None, there):
            found.append(f"{METADATA} states {total} messages in all, {there} are there")
        return tuple(dict.fromkeys(found))

    def types_on(self, topic: str) -> tuple[str, Typestore]:
        """The message type on `topic`, and the types it is made of.

        Raises BagError if the topic does not exist, holds several types or is not CDR.
        """
        found = [c for c in self.channels if c.topic == topic]
        found = [c for c in found if c.count] or found
        if not found:
            there = listed(f"{name} ({kind})" for name, kind in self.topics.items())
            near = did_you_mean(topic, self.topics)
            cut = "" if self.ending is None else f". It is truncated or unfinished: {self.ending}"
            raise BagError(f"{self.path} has no topic {topic}; it has: {there}{near}{cut}")
        if len({c.msgtype for c in found}) > 1:
            raise BagError(
                f"{self.path}: {topic} holds messages of {self.topics[topic]}; "
                "a signal needs one type on its topic"
            )
        try:
            for channel in found:
                if channel.encoding == "ros1":
                    ros2_definition(channel.msgtype, channel.definition)  # says what is wrong
                if channel.encoding != "cdr":
                    raise BagError(f"it is serialised as '{channel.encoding}', only 'cdr' is read")
            types = [types_in_bag(channel.msgtype, channel.definition) for channel in found]
        except BagError as error:
            raise BagError(f"{self.path}: {topic}: {error}") from error
        if not all(are_same(types[0], other) for other in types):
            raise BagError(f"{self.path}: {topic} has parts with different definitions of its type")
        return found[0].msgtype, types[0]

    def offered(self, topic: str) -> tuple[Profile, ...]:
        """What each publisher of `topic` offered; empty where the bag does not say.

        metadata.yaml goes before the files, as it does for rosbag2.
        """
        found = [p for c in self.channels if c.topic == topic for p in c.offered]
        described = (self._described.topics or {}).get(topic)
        return tuple(dict.fromkeys((described and described.offered) or found))

    def count(self, topic: str) -> int:
        """How many messages the bag says it has on `topic`."""
        if self._counts is not None and self.ending is None:
            return self._counts.get(topic, 0)
        return self._there(topic)

    @cached_property
    def _counts(self) -> dict[str, int] | None:
        """Messages of each topic as metadata.yaml states them."""
        if self._described.topics is None:
            return None
        return {topic: described.messages for topic, described in self._described.topics.items()}

    def _there(self, topic: str) -> int:
        return sum(channel.count for channel in self.channels if channel.topic == topic)

    def batches(
        self, topics: Sequence[str] | None = None, *, progress: Progress = silent
    ) -> Iterator[tuple[Channel, Batch]]:
        """The messages on `topics` (None: on all), many at once, in the order of the files.

        Memory: one batch. Raises BagError where the bag is damaged.
        """
        for channel, batch, _ in self.parts(topics, progress=progress):
            yield channel, batch

    def parts(
        self, topics: Sequence[str] | None = None, *, progress: Progress = silent
    ) -> Iterator[tuple[Channel, Batch, int]]:
        """As `batches`, with the log time in ns that no message from here on goes below."""
        keys = self._keys(topics)
        total, done = max(sum(self.channels[key].count for key in keys), 1), 0
        for key, batch, later_ns in self.storage.parts(keys):
            yield self.channels[key], batch, later_ns
            done += len(batch)
            progress("reading", done / total)

    def log_times(self, topics: Sequence[str]) -> Iterator[tuple[str, IntArray]]:
        """(topic, log times in ns) part by part; of MCAP from its indexes, without a message."""
        for key, log_ns in self.storage.log_times(self._keys(topics)):
            yield self.channels[key].topic, log_ns

    def log_order(self, topics: Sequence[str]) -> LogOrder:
        """Where the log times of `topics` go back inside a file."""
        order = LogOrder()
        for channel, batch in self.batches(topics):
            order.add(channel.key, batch.log_ns)
        return order

    def messages(
        self, topics: Sequence[str] | None = None, *, as_recorded: bool = False
    ) -> Iterator[Message]:
        """The messages on `topics` (None: on all) by log time; equal log times as recorded.

        as_recorded: in the order of the files instead.
        """
        keys = self._keys(topics)
        recorded = self.storage.recorded(keys) if as_recorded else self.storage.messages(keys)
        for raw in recorded:
            assert isinstance(raw, Raw)  # no chunk is taken as a whole
            channel = self.channels[raw.key]
            if raw.error:
                raise BagError(f"{self.path}: {channel.topic}: {raw.error}")
            yield Message(channel.topic, channel.msgtype, raw.log_ns, raw.data, raw.publish_ns)

    def raws(
        self,
        topics: Sequence[str] | None = None,
        *,
        nearly: bool = False,
        spans: Spans = ALWAYS,
        takes: Takes | None = None,
    ) -> Iterator[Raw | Whole]:
        """As `messages`, with all that is recorded of them, and those that cannot be unpacked.

        nearly: where more chunks overlap in time than memory is meant for, do not refuse. spans:
        only what was logged in one of them; nothing else is read. takes: which chunks come whole.
        """
        keys = self._keys(topics)
        return self.storage.messages(keys, nearly=nearly, spans=spans, takes=takes)

    def _keys(self, topics: Sequence[str] | None) -> list[int]:
        wanted = None if topics is None else set(topics)
        return [c.key for c in self.channels if wanted is None or c.topic in wanted]

    def _unfinished(self) -> str:
        if self.path.is_dir() and self.storage.ending is None:
            return (
                f"{self.path} has no metadata.yaml: the recording was not closed; "
                f"read {self.files[0].name} itself, or make a whole bag of it with {RECOVER}"
            )
        bytes_there = sum(file.stat().st_size for file in self.files)
        return (
            f"{self.path} is truncated or unfinished, without the summary that ends a bag: of "
            f"{bytes_there} bytes, {self.ending}; copy it again, or recover its complete chunks "
            f"with {RECOVER}"
        )


def _described(path: Path, *, salvage: bool) -> tuple[BagFiles, list[str]]:
    """What the bag is made of; with `salvage` also if its metadata are damaged, which is said."""
    try:
        found = bag_files(path)
    except BagError as error:
        files = data_files(path) if salvage and path.is_dir() else ()
        if not files:
            raise
        return BagFiles(files), [str(error)]
    if not salvage or not path.is_dir():
        return found, []
    return replace(found, files=tuple(without_twins((*found.files, *data_files(path))))), []
