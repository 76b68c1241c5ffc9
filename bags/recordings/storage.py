"""Where a bag's messages are: MCAP files read block by block, anything else through rosbags."""

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol, TypeAlias

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader

from bags.recordings.batch import Batch, BatchBuilder
from bags.recordings.definitions import Definition
from bags.recordings.mcap_file import McapFile
from bags.recordings.mcap_records import Block
from bags.recordings.message_types import ros2_definition, types_in_bag
from bags.recordings.quality import KEY, LATCHED, Profile, offered, profile_of
from nlsid_core.errors import BagError

FORMATS: Final = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
}
MAX_OVERLAP_BYTES: Final = 256 * 2**20  # chunks that overlap in time are sorted in memory


@dataclass(frozen=True)
class Channel:
    """One recorded stream of messages; a topic has one, or several if it was recorded in parts.

    key: its place in `Storage.channels`. count: messages it has. metadata: the recorder's own.
    offered: what its publishers offered, as far as the file says so.
    """

    key: int
    topic: str
    msgtype: str
    encoding: str
    definition: MessageDefinition
    count: int
    metadata: Mapping[str, str] = field(default_factory=dict)
    offered: tuple[Profile, ...] = ()


@dataclass(frozen=True)
class Raw:
    """One message: the key of its channel, times in ns, its data."""

    key: int
    log_ns: int
    publish_ns: int
    data: bytes


# log time (ns), file, block, place in it, channel's key, publish time (ns), data: in this order
Entry: TypeAlias = tuple[int, int, int, int, int, int, bytes]


def _raw(entry: Entry) -> Raw:
    log_ns, *_, key, publish_ns, data = entry
    return Raw(key, log_ns, publish_ns, data)


def defined(channel: Channel, definitions: Mapping[str, Definition]) -> Channel:
    """The channel, with the given definition of its type where its file has none."""
    given = definitions.get(channel.msgtype)
    if given is None or channel.definition.format != MessageDefinitionFormat.NONE:
        return channel
    return replace(channel, definition=MessageDefinition(MessageDefinitionFormat.MSG, given.text))


class Storage(Protocol):
    """An open bag's messages."""

    channels: list[Channel]
    custom: dict[str, str]
    ending: str | None

    @property
    def start_ns(self) -> int:
        """The first log time; 0 if there are no messages."""

    def batches(self, keys: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """(channel key, messages), in the order of the files."""

    def messages(self, keys: Collection[int]) -> Iterator[Raw]:
        """The messages by log time; equal log times as recorded."""

    def recorded(self, keys: Collection[int]) -> Iterator[Raw]:
        """The messages in the order of the files, where the storage tells it; else by log time."""

    def close(self) -> None:
        """Close the files."""


class McapStorage:
    """MCAP files, the parts of one recording. Memory: one chunk, or the chunks that overlap."""

    def __init__(self, files: Sequence[Path], custom_record: str, *, salvage: bool = False) -> None:
        self.channels: list[Channel] = []
        self.custom: dict[str, str] = {}
        self.files: list[McapFile] = []
        self.ending: str | None = None
        self._keys: list[dict[int, int]] = []
        try:
            for path in files:
                with reading(path):
                    self._add(McapFile(path, salvage=salvage), custom_record)
        except BaseException:
            self.close()
            raise

    def _add(self, file: McapFile, custom_record: str) -> None:
        self.files.append(file)
        found = file.contents
        if found.ending is not None:
            self.ending = f"{file.path}: {found.ending}"
        for record in found.metadata:
            if record.name == custom_record:
                self.custom.update(record.metadata)
        keys = {}
        for channel_id, channel in found.channels.items():
            schema = found.schemas.get(channel.schema_id)
            if schema is None and channel.schema_id:
                raise BagError(f"channel {channel_id} has schema {channel.schema_id}, not declared")
            keys[channel_id] = len(self.channels)
            self.channels.append(
                Channel(
                    key=keys[channel_id],
                    topic=channel.topic,
                    msgtype=_type_name(schema.name if schema else ""),
                    encoding=channel.message_encoding,
                    definition=_definition(schema),
                    count=found.counts.get(channel_id, 0),
                    metadata=channel.metadata,
                    offered=offered(channel.metadata.get(KEY, "")),
                )
            )
        self._keys.append(keys)

    @property
    def start_ns(self) -> int:
        """The first log time, as the chunks state it; 0 if there are no messages."""
        return min((b.start_ns for file in self.files for b in file.contents.blocks), default=0)

    def batches(self, keys: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """(channel key, messages), in the order of the files."""
        for file, known in zip(self.files, self._keys, strict=True):
            wanted = {channel: key for channel, key in known.items() if key in keys}
            with reading(file.path):
                for channel, batch in file.batches(wanted):
                    yield wanted[channel], batch

    def recorded(self, keys: Collection[int]) -> Iterator[Raw]:
        """The messages in the order of the files."""
        for n, file in enumerate(self.files):
            for i, block in enumerate(file.contents.blocks):
                for entry in sorted(self._entries(n, i, block, keys), key=lambda entry: entry[3]):
                    yield _raw(entry)

    def messages(self, keys: Collection[int]) -> Iterator[Raw]:
        """The messages by log time; equal log times as recorded.

        Raises BagError if so many chunks overlap in time that sorting needs MAX_OVERLAP_BYTES.
        """
        parts: list[tuple[int, int, int, Block]] = []
        for n, file in enumerate(self.files):
            parts += [(b.start_ns, n, i, b) for i, b in enumerate(file.contents.blocks)]
        parts.sort(key=lambda part: part[:3])
        waiting: list[Entry] = []
        held = 0
        for start_ns, n, i, block in parts:
            while waiting and waiting[0][0] < start_ns:
                entry = heapq.heappop(waiting)
                held -= len(entry[-1])
                yield _raw(entry)
            for entry in self._entries(n, i, block, keys):
                heapq.heappush(waiting, entry)
                held += len(entry[-1])
            if held > MAX_OVERLAP_BYTES:
                raise BagError(
                    f"{self.files[n].path}: chunks of more than {MAX_OVERLAP_BYTES} bytes overlap "
                    "in time; sort the file first (`mcap sort`)"
                )
        while waiting:
            yield _raw(heapq.heappop(waiting))

    def _entries(self, n: int, i: int, block: Block, keys: Collection[int]) -> Iterator[Entry]:
        file, known = self.files[n], self._keys[n]
        wanted = {channel: key for channel, key in known.items() if key in keys}
        with reading(file.path):
            for channel, batch in file.block_batches(block, wanted):
                for k in range(len(batch)):
                    times = int(batch.log_ns[k]), int(batch.publish_ns[k])
                    at = int(batch.start[k])
                    yield times[0], n, i, at, wanted[channel], times[1], batch.data(k)

    def close(self) -> None:
        """Close the files."""
        for file in self.files:
            file.close()


class RosbagsStorage:
    """A bag that rosbags reads: sqlite3, compressed whole, ROS 1.

    Each file is opened by itself: given the folder, rosbags leaves out topics whose quality of
    service reads otherwise in metadata.yaml than in the file.
    """

    ending: str | None = None

    def __init__(self, paths: Sequence[Path]) -> None:
        self.channels: list[Channel] = []
        self.custom: dict[str, str] = {}
        self._readers: list[tuple[Path, Any, list[Connection]]] = []
        for path in paths:
            with reading(path):
                ros1 = path.suffix == ".bag"
                reader: Any = Ros1Reader(path) if ros1 else Ros2Reader(path)
                reader.open()
                connections = list(reader.connections)
            self._readers.append((path, reader, connections))
            for connection in connections:
                self.channels.append(_channel(len(self.channels), connection, ros1=ros1))

    @property
    def start_ns(self) -> int:
        """The first log time; 0 if there are no messages."""
        starts = [reader.start_time for _, reader, _ in self._readers if reader.message_count]
        return int(min(starts, default=0))

    def batches(self, keys: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """(channel key, messages), in the order of log time."""
        builders = {key: BatchBuilder() for key in keys}
        for message in self.messages(keys):
            builder = builders[message.key]
            builder.add(message.data, message.log_ns)
            if builder.full:
                yield from ((message.key, batch) for batch in builder.take())
        for key, builder in builders.items():
            yield from ((key, batch) for batch in builder.take())

    def messages(self, keys: Collection[int]) -> Iterator[Raw]:
        """The messages by log time; equal log times as recorded."""
        first, streams = 0, []
        for path, reader, connections in self._readers:
            wanted = [c for key, c in enumerate(connections, first) if key in keys]
            if wanted:
                place = {id(c): key for key, c in enumerate(connections, first)}
                streams.append(self._read(path, reader, wanted, place))
            first += len(connections)
        return heapq.merge(*streams, key=lambda raw: raw.log_ns)

    recorded = messages  # rosbags tells no other order

    def _read(
        self, path: Path, reader: Any, wanted: Sequence[Connection], place: Mapping[int, int]
    ) -> Iterator[Raw]:
        with reading(path):
            for connection, log_ns, data in reader.messages(wanted):
                if not 0 <= log_ns < 2**63:
                    raise BagError(f"a message on {connection.topic} has log time {log_ns} ns")
                channel = self.channels[place[id(connection)]]
                if path.suffix == ".bag" and channel.encoding == "cdr":
                    types = types_in_bag(channel.msgtype, channel.definition)
                    data = types.ros1_to_cdr(data, channel.msgtype)
                yield Raw(channel.key, log_ns, log_ns, bytes(data))

    def close(self) -> None:
        """Close the files."""
        for _, reader, _ in self._readers:
            reader.close()
        self._readers = []


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what rosbags and mcap raise on damaged input into a BagError that names the bag.

    They raise nearly anything there (struct.error, KeyError, TypeError, decompression errors), so
    every Exception is caught, but only around calls into them.
    """
    try:
        yield
    except OSError:
        raise
    except BagError as error:
        if str(path) in str(error):
            raise
        raise BagError(f"{path} is damaged or not a bag: {error}") from error
    except Exception as error:
        raise BagError(
            f"{path} is damaged or not a bag: {type(error).__name__}: {str(error)[:200]}"
        ) from error


def _channel(key: int, connection: Connection, *, ros1: bool) -> Channel:
    encoding, definition = "cdr", connection.msgdef
    profiles: tuple[Profile, ...] = ()
    if isinstance(connection.ext, ConnectionExtRosbag2):
        encoding = connection.ext.serialization_format
        profiles = tuple(profile_of(found) for found in connection.ext.offered_qos_profiles)
    elif connection.ext.latching:
        profiles = (LATCHED,)
    if ros1:
        try:
            definition = ros2_definition(connection.msgtype, definition)
        except BagError:
            encoding = "ros1"  # of a type that cannot be translated; the others can be read
    msgtype = _type_name(connection.msgtype)
    return Channel(
        key,
        connection.topic,
        msgtype,
        encoding,
        definition,
        connection.msgcount,
        offered=profiles,
    )


def _definition(schema: Any) -> MessageDefinition:
    if schema is None or schema.encoding not in FORMATS:
        return MessageDefinition(MessageDefinitionFormat.NONE, "")
    return MessageDefinition(FORMATS[schema.encoding], schema.data.decode("utf-8", "replace"))


def _type_name(name: str) -> str:
    """`package/msg/Type`; early recorders left out the middle."""
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}" if kind and "/" not in kind else name
