"""An open bag: its topics, its metadata, and its messages in log order or in batches.

Bags are untrusted. Whatever is wrong with one leaves here as a BagError that names the bag.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from rosbags.typesys.store import Typestore

from bags.recordings.batch import Batch, LogOrder
from bags.recordings.definitions import Definition
from bags.recordings.folders import COMPRESSED, bag_files
from bags.recordings.mcap_records import MAGIC
from bags.recordings.message_types import are_same, types_in_bag
from bags.recordings.names import did_you_mean, listed
from bags.recordings.part import CUSTOM_DATA
from bags.recordings.quality import Profile
from bags.recordings.remote import RemotePath, place
from bags.recordings.storage import Channel, McapStorage, RosbagsStorage, Storage, defined
from nlsid_core.errors import BagError

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

    A bag is a rosbag2 folder (MCAP or sqlite3, split or not), a single .mcap, or a ROS 1 .bag; of
    MCAP also one in object storage, by its URL (`bags.recordings.remote`).
    Raises BagError if there is no such bag, if it is damaged or not a bag, or if it is unfinished.
    With `unfinished=True` the last is no error: the messages there are can be read, and `ending`
    says why there may be more. definitions: of types that the bag itself does not define.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        unfinished: bool = False,
        definitions: Mapping[str, Definition] | None = None,
    ) -> None:
        self.path = place(path)
        self._described = bag_files(self.path)
        self.files: tuple[Path, ...] = self._described.files
        self.ending: str | None = None
        for file in self.files:
            _check_start(file)
        if not self._described.finished:
            self.ending = "it has no metadata.yaml: the recording was not closed"
        if self._described.storage == "mcap" and not self._described.compressed:
            self._storage: Storage = McapStorage(self.files, CUSTOM_DATA)
        else:
            whole = self._described.compressed
            if isinstance(self.path, RemotePath):
                raise BagError(
                    f"{self.path}: only MCAP is read from where it lies, and not if it is "
                    "compressed whole; copy this bag to this machine"
                )
            self._storage = RosbagsStorage([self.path] if whole else self.files)
        self._storage.channels = [
            defined(channel, definitions or {}) for channel in self._storage.channels
        ]
        if self._storage.ending is not None:  # of a bag that is one file that is said already
            self.ending = self._storage.ending.removeprefix(f"{self.path}: ")
        if self.ending is not None and not unfinished:
            self.close()
            raise BagError(self._unfinished())

    def close(self) -> None:
        """Close the bag's files."""
        self._storage.close()

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def channels(self) -> Sequence[Channel]:
        """The recorded streams; a topic has one, or several in a split bag."""
        return self._storage.channels

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
        """The bag's own metadata: `custom_data` of metadata.yaml or of the MCAP file."""
        return dict(self._described.custom if self.path.is_dir() else self._storage.custom)

    @property
    def start_ns(self) -> int:
        """The first log time in ns; 0 if there are no messages."""
        return self._storage.start_ns

    def types_on(self, topic: str) -> tuple[str, Typestore]:
        """The message type on `topic`, and the types it is made of.

        Raises BagError if the topic does not exist, holds several types or is not CDR.
        """
        found = [c for c in self.channels if c.topic == topic]
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
        stated = self._described.encodings.get(topic, "cdr")
        for encoding in (*(channel.encoding for channel in found), stated):
            if encoding != "cdr":
                raise BagError(
                    f"{self.path}: {topic} is serialised as '{encoding}', only 'cdr' can be read"
                )
        try:
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
        return tuple(dict.fromkeys(self._described.offered.get(topic) or found))

    def count(self, topic: str) -> int:
        """How many messages the bag says it has on `topic`."""
        if self._described.counts is not None and self.ending is None:
            return self._described.counts.get(topic, 0)
        return sum(channel.count for channel in self.channels if channel.topic == topic)

    def batches(self, topics: Sequence[str] | None = None) -> Iterator[tuple[Channel, Batch]]:
        """The messages on `topics` (None: on all), many at once, in the order of the files.

        Memory: one batch. Raises BagError where the bag is damaged.
        """
        for key, batch in self._storage.batches(self._keys(topics)):
            yield self.channels[key], batch

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

        as_recorded: in the order of the files instead. Only MCAP files tell it.
        """
        storage = self._storage
        ordered = storage.recorded if as_recorded else storage.messages
        for raw in ordered(self._keys(topics)):
            channel = self.channels[raw.key]
            yield Message(channel.topic, channel.msgtype, raw.log_ns, raw.data, raw.publish_ns)

    def _keys(self, topics: Sequence[str] | None) -> list[int]:
        wanted = None if topics is None else set(topics)
        return [c.key for c in self.channels if wanted is None or c.topic in wanted]

    def _unfinished(self) -> str:
        if self.path.is_dir() and self._storage.ending is None:
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


def _check_start(file: Path) -> None:
    """BagError if an MCAP file does not begin as one."""
    if file.suffix in (".db3", ".bag", COMPRESSED) or isinstance(file, RemotePath):
        return  # a remote file says what it is at its end
    with file.open("rb") as stream:
        start = stream.read(len(MAGIC))
    if start != MAGIC:
        what = f"starts with {start.hex(' ')}" if start else "is empty"
        raise BagError(f"{file} is not an MCAP file: it {what}")
