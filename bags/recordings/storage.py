"""Where a bag's messages are: MCAP, SQLite and ROS 1 files, as one recording.

What a file is, its first bytes say, not its name. Whatever it is, its messages leave here in CDR:
those of ROS 1 are translated, those that rosbag2 compressed one by one are unpacked.
"""

import shutil
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import zstandard
from mcap.records import Attachment, Metadata
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from bags.recordings.batch import Batch, joined
from bags.recordings.definitions import Definition
from bags.recordings.mcap_file import Batches, McapFile, Whole
from bags.recordings.mcap_records import CUSTOM_DATA, MAGIC, MAX_CHUNK_BYTES, NEVER, ROSBAG2, Block
from bags.recordings.message_types import JAZZY, ros2_definition, standard_types, types_in_bag
from bags.recordings.quality import KEY, Profile, offered
from bags.recordings.remote import RemotePath
from bags.recordings.ros1_file import ROS1_MAGIC, Ros1File
from bags.recordings.sqlite_file import BESIDE, SqliteFile
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

FORMATS: Final = {
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
}
SQLITE_MAGIC: Final = b"SQLite format 3\0"
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
MAX_OVERLAP_BYTES: Final = 256 * 2**20  # chunks that overlap in time are sorted in memory
MOST_PADDING: Final = 3  # bytes that rosserial leaves after a message
UNPACKED_BYTES: Final = 2**20  # of a file that was compressed whole, at once
ALWAYS: Final = ((0, NEVER),)

Spans = Sequence[tuple[int, int]]  # ns: from the first to before the second
Takes = Callable[[Block, Mapping[int, int]], bool]  # of a chunk, with its channels' number -> key

DataFile = McapFile | SqliteFile | Ros1File
KINDS: Final = {McapFile: "mcap", SqliteFile: "sqlite3", Ros1File: "ros1"}


@dataclass(frozen=True)
class Channel:
    """One recorded stream of messages; a topic has one, or several if it was recorded in parts.

    key: its place in `Storage.channels`. schema: encoding and data of what defines the type, empty
    where nothing does. count: messages it has. metadata: the recorder's own.
    offered: what its publishers offered, as far as the file says so.
    """

    key: int
    topic: str
    msgtype: str
    encoding: str
    schema: tuple[str, bytes]
    count: int = 0
    metadata: Mapping[str, str] = field(default_factory=dict)
    offered: tuple[Profile, ...] = ()

    @property
    def definition(self) -> MessageDefinition:
        """What the schema says, as far as its encoding is known."""
        encoding, data = self.schema
        if encoding not in FORMATS:
            return MessageDefinition(MessageDefinitionFormat.NONE, "")
        return MessageDefinition(FORMATS[encoding], data.decode("utf-8", "replace"))


class Raw(NamedTuple):
    """One message: times in ns, where it is recorded, the key of its channel, its data.

    place: number of the file, of the block in it, of the byte or message in that. error: why there
    are no data; empty otherwise.
    """

    log_ns: int
    place: tuple[int, int, int]
    key: int
    publish_ns: int
    sequence: int
    data: bytes
    error: str = ""


def defined(channel: Channel, given: Mapping[str, Definition], release: str) -> Channel:
    """The channel, with a definition where its file has none: the given one, or the release's.

    rosbag2 writes those of services' events without the event's own fields: the given one is used.
    """
    if channel.schema[0] in FORMATS and "/srv/" not in channel.msgtype:
        return channel
    if channel.msgtype in given:
        text = given[channel.msgtype].text
    elif f"ros2_{release}" == JAZZY or channel.encoding != "cdr":
        return channel
    else:
        text = _text_of(channel.msgtype, f"ros2_{release}")
    if not text:
        return channel
    return replace(channel, schema=("ros2msg", text.encode()))


@cache
def _text_of(msgtype: str, release: str) -> str:
    types = standard_types(release)
    return types.generate_msgdef(msgtype, ros_version=2)[0] if msgtype in types.fielddefs else ""


class Storage:
    """The files of one recording, by their first log times. Memory: one chunk, or those that
    overlap in time.

    strands: for each channel, which of its
    topic's channels in its file it is: those of one recording are counted on from file to file.
    numbers: those that the channels have in their files.
    """

    def __init__(self, paths: Sequence[Path], *, salvage: bool = False) -> None:
        self.channels: list[Channel] = []
        self.strands: list[int] = []
        self.numbers: list[int] = []
        self.custom: dict[str, str] = {}
        self.records: list[Metadata] = []
        self._refused: list[str] = []
        self.files: list[DataFile] = []
        self._keys: list[dict[int, int]] = []
        self._unpacked: list[TemporaryDirectory[str]] = []
        self._translated: dict[int, Callable[[bytes], bytes]] = {}
        try:
            for path in paths:
                self._open(path, salvage=salvage)
            self.files.sort(key=_first_ns)
            for file in self.files:
                with reading(file.path):
                    self._add(file)
        except BaseException:
            self.close()
            raise

    def _open(self, path: Path, *, salvage: bool) -> None:
        try:
            with reading(path):
                file = self._opened(path, salvage=salvage)
                file.path = path  # also of one that is unpacked elsewhere
                self.files.append(file)
        except BagError as error:
            if not salvage:
                raise
            self._refused.append(str(error))

    def _opened(self, path: Path, *, salvage: bool) -> DataFile:
        if isinstance(path, RemotePath):
            if path.suffix in (".db3", ".bag", ".zstd"):
                raise BagError(
                    "only MCAP is read from where it lies, and not if it is compressed whole; copy "
                    "this bag to this machine"
                )
            return McapFile(path, salvage=salvage)
        with path.open("rb") as stream:
            start = stream.read(len(SQLITE_MAGIC))
            if start.startswith(ZSTD_MAGIC):
                stream.seek(0)
                return self._opened(self._unzipped(path, stream, salvage=salvage), salvage=salvage)
        if start.startswith(SQLITE_MAGIC):
            return SqliteFile(path, salvage=salvage)
        if start.startswith(ROS1_MAGIC):
            return Ros1File(path, salvage=salvage)
        if start.startswith(MAGIC):
            return McapFile(path, salvage=salvage)
        what = f"starts with {start[:8].hex(' ')}" if start else "is empty, or cut off"
        raise BagError(f"it is no MCAP, SQLite or ROS 1 file: it {what}")

    def _unzipped(self, path: Path, stream: BinaryIO, *, salvage: bool) -> Path:
        """A file that was compressed whole, unpacked for as long as this is open."""
        folder = TemporaryDirectory()
        self._unpacked.append(folder)
        target = Path(folder.name) / path.name.removesuffix(".zstd")
        for end in BESIDE:
            beside = path.with_name(f"{target.name}{end}")
            if beside.is_file():
                shutil.copy(beside, folder.name)
        left = shutil.disk_usage(folder.name).free // 2
        with target.open("wb") as unpacked:
            try:
                packed = zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True)
                while part := packed.read(UNPACKED_BYTES):
                    left -= unpacked.write(part)
                    if left < 0:
                        raise BagError("unpacked it fills more than half of the free disk")
            except zstandard.ZstdError as error:
                if not salvage:
                    raise
                self._refused.append(f"{path.name}: {error}")
        return target

    def _add(self, file: DataFile) -> None:
        found = file.contents
        for record in found.metadata:
            if record.name == CUSTOM_DATA:
                self.custom.update(record.metadata)
            elif record not in self.records:
                self.records.append(record)
        keys: dict[int, int] = {}
        strands: dict[str, int] = {}
        for number, recorded in found.declared.channels.items():
            schema = found.declared.schemas.get(recorded.schema_id)
            if schema is None and recorded.schema_id:
                raise BagError(f"channel {number} has schema {recorded.schema_id}, not declared")
            keys[number] = len(self.channels)
            strand = strands[recorded.topic] = strands.get(recorded.topic, -1) + 1
            self.strands.append(strand)
            self.numbers.append(number)
            channel = Channel(
                key=keys[number],
                topic=recorded.topic,
                msgtype=_type_name(schema.name if schema else ""),
                encoding=recorded.message_encoding,
                schema=(schema.encoding, schema.data) if schema else ("", b""),
                count=found.counts.get(number, 0),
                metadata=recorded.metadata,
                offered=offered(recorded.metadata.get(KEY, "")),
            )
            self.channels.append(self._in_cdr(channel))
        self._keys.append(keys)

    def _in_cdr(self, channel: Channel) -> Channel:
        """A channel of ROS 1 as one of ROS 2; as it is if its type cannot be translated."""
        if channel.encoding != "ros1":
            return channel
        try:
            definition = ros2_definition(channel.msgtype, channel.definition)
            types = types_in_bag(channel.msgtype, definition)
        except BagError:
            return channel

        def translate(data: bytes) -> bytes:
            for padding in range(MOST_PADDING + 1):
                try:
                    return bytes(types.ros1_to_cdr(data[: len(data) - padding], channel.msgtype))
                except Exception as error:  # generated code raises what the bytes make it raise
                    reason = f"{type(error).__name__}: {str(error)[:200]}"
            raise BagError(f"not a '{channel.msgtype}' of ROS 1: {reason}")

        self._translated[channel.key] = translate
        return replace(channel, encoding="cdr", schema=("ros2msg", definition.data.encode()))

    @property
    def ending(self) -> str | None:
        """Why the recording stops early; None if all files are finished."""
        ends = [f"{f.path}: {f.contents.ending}" for f in self.files if f.contents.ending]
        return ends[-1] if ends else None

    @property
    def lost(self) -> list[str]:
        """Of what cannot be read, with `salvage=True`, why, as far as it was found by now."""
        found = [*self._refused]
        for file in self.files:
            ending = file.contents.ending
            found += [
                f"{file.path.name}: {what}"
                for what in (*file.contents.lost, *([] if ending is None else [ending]))
            ]
        return found

    @property
    def release(self) -> str:
        """The release of ROS 2 that the files name; empty if they name none."""
        named = [r.metadata.get("ROS_DISTRO", "") for r in self.records if r.name == ROSBAG2]
        return next(filter(None, named), "")

    @property
    def kinds(self) -> dict[str, list[str]]:
        """What the files are, and how what is in them is compressed."""
        return {
            "storage": sorted({KINDS[type(file)] for file in self.files}),
            "compression": sorted(
                {block.compression for file in self.files for block in file.contents.blocks}
                - {"", "none"}
            ),
        }

    @property
    def start_ns(self) -> int:
        """The first log time in ns; 0 if there are no messages."""
        first = min(map(_first_ns, self.files), default=NEVER)
        return 0 if first == NEVER else first

    @property
    def stated(self) -> dict[str, int] | None:
        """Topic -> messages, as the files' statistics and indexes say; None if one says nothing."""
        found: dict[str, int] = {}
        for file, keys in zip(self.files, self._keys, strict=True):
            if file.contents.stated is None:
                return None
            for number, count in file.contents.stated.items():
                if number in keys:
                    topic = self.channels[keys[number]].topic
                    found[topic] = found.get(topic, 0) + count
        return found

    def attachments(self) -> Iterator[Attachment]:
        """The attachments of MCAP files, with their data."""
        for file in self.files:
            if isinstance(file, McapFile):
                yield from file.attachments()

    def parts(self, keys: Collection[int]) -> Iterator[tuple[int, Batch, int]]:
        """(channel key, messages, ns), in the order of the files.

        ns: no part from here on has a message with an earlier log time, as the chunks state them.
        """
        later: dict[tuple[int, int], int] = {}
        earliest = NEVER
        for n in reversed(range(len(self.files))):
            for block in reversed(self.files[n].contents.blocks):
                later[n, block.offset] = earliest
                earliest = min(earliest, block.start_ns)
        for n, file in enumerate(self.files):
            wanted = {number: key for number, key in self._keys[n].items() if key in keys}
            with reading(file.path):
                for block, batches in _runs(file, wanted):
                    for number, batch in batches:
                        yield wanted[number], self._plain(wanted[number], batch), earliest
                    earliest = later[n, block.offset]

    def log_times(self, keys: Collection[int]) -> Iterator[tuple[int, IntArray]]:
        """(channel key, log times in ns), in the order of the files; from indexes if there are."""
        for file, known in zip(self.files, self._keys, strict=True):
            wanted = {number: key for number, key in known.items() if key in keys}
            with reading(file.path):
                if isinstance(file, McapFile):
                    yield from ((wanted[c], log_ns) for c, log_ns in file.log_times(wanted))
                    continue
                for _, batches in _runs(file, wanted):
                    yield from ((wanted[c], batch.log_ns) for c, batch in batches)

    def recorded(self, keys: Collection[int]) -> Iterator[Raw]:
        """The messages in the order of the files."""
        for n, file in enumerate(self.files):
            for i in range(len(file.contents.blocks)):
                yield from sorted(self._raws(n, i, keys), key=attrgetter("place"))

    def messages(
        self,
        keys: Collection[int],
        *,
        nearly: bool = False,
        spans: Spans = ALWAYS,
        takes: Takes | None = None,
    ) -> Iterator[Raw | Whole]:
        """The messages that were logged in one of `spans`, by log time; equal ones as recorded.

        A chunk that is wanted as a whole, and that `takes` has said it takes, comes as it is when
        its first message is due.

        Chunks outside the spans are not read. Raises BagError if so many chunks overlap in time
        that sorting needs MAX_OVERLAP_BYTES; with `nearly` they are sorted as far as that goes.
        """
        order = sorted(
            (block.start_ns, n, i)
            for n, file in enumerate(self.files)
            for i, block in enumerate(file.contents.blocks)
            if any(block.start_ns < end and start <= block.end_ns for start, end in spans)
        )
        waiting: list[Raw] = []
        for (_, n, i), (later_ns, *_) in pairwise([*order, (NEVER,)]):
            whole = self._whole(n, i, keys, spans, takes) if takes else None
            if whole is not None:
                yield whole
            else:
                waiting += self._raws(n, i, keys)
                waiting.sort()
            ready = bisect_left(waiting, later_ns, key=attrgetter("log_ns"))
            if sum(len(raw.data) for raw in waiting[ready:]) > MAX_OVERLAP_BYTES:
                if not nearly:
                    raise BagError(
                        f"{self.files[n].path}: chunks of more than {MAX_OVERLAP_BYTES} bytes "
                        "overlap in time; sort the file first (`mcap sort`)"
                    )
                ready = len(waiting)
            for raw in waiting[:ready]:
                if any(start <= raw.log_ns < end for start, end in spans):
                    yield raw
            waiting = waiting[ready:]

    def _whole(
        self, n: int, i: int, keys: Collection[int], spans: Spans, takes: Takes
    ) -> Whole | None:
        """The block, if all of it is wanted and taken, and nothing in it has to be translated."""
        file, known = self.files[n], self._keys[n]
        block = file.contents.blocks[i]
        inside = any(start <= block.start_ns and block.end_ns < end for start, end in spans)
        numbers = {number: known[number] for number in block.index or ()}
        wanted = inside and set(numbers.values()) <= set(keys) - self._translated.keys()
        if not isinstance(file, McapFile) or not wanted or not takes(block, numbers):
            return None
        with reading(file.path):
            found = file.whole(block)
        if found is None or any(_packed(batch).any() for batch in found.messages.values()):
            return None
        return found

    def _raws(self, n: int, i: int, keys: Collection[int]) -> Iterator[Raw]:
        file = self.files[n]
        wanted = {number: key for number, key in self._keys[n].items() if key in keys}
        with reading(file.path):
            for number, batch in file.block_batches(file.contents.blocks[i], wanted):
                plain = self._plain(wanted[number], batch)
                columns = (batch.log_ns, batch.start, batch.publish_ns, batch.sequence)
                rows = zip(*(column.tolist() for column in columns), strict=True)
                for k, (log_ns, at, publish_ns, sequence) in enumerate(rows):
                    error = plain.unreadable.get(k, "")
                    data = b"" if error else plain.data(k)
                    place = n, i, at
                    yield Raw(log_ns, place, wanted[number], publish_ns, sequence, data, error)

    def _plain(self, key: int, batch: Batch) -> Batch:
        """The messages in CDR."""
        translate = self._translated.get(key)
        if translate is None:
            if self.channels[key].encoding != "cdr" or not _packed(batch).any():
                return batch
            translate = _unpacked
        parts: list[bytes] = []
        unreadable: dict[int, str] = {}
        for i in range(len(batch)):
            data = batch.data(i)
            try:
                parts.append(translate(data))
            except BagError as error:
                parts.append(data)
                unreadable[i] = str(error)
        found = joined(parts, batch.log_ns)
        return replace(
            found,
            publish_ns=batch.publish_ns,
            sequence=batch.sequence,
            unreadable=unreadable,
        )

    def close(self) -> None:
        """Close the files."""
        for file in self.files:
            file.close()
        for folder in self._unpacked:
            folder.cleanup()


def _runs(file: DataFile, channels: Collection[int]) -> Iterator[tuple[Block, Batches]]:
    """(last block, messages by channel), of blocks that are read together."""
    if isinstance(file, McapFile):
        yield from file.runs(channels)
        return
    for block in file.contents.blocks:
        yield block, file.block_batches(block, channels)


def _packed(batch: Batch) -> Any:
    """Which messages begin as a zstd frame does, and as no CDR message."""
    words = len(batch.buffer) - len(ZSTD_MAGIC) + 1
    if words <= 0:
        return np.zeros(len(batch), bool)
    starts = np.ndarray((words,), "<u4", batch.buffer, strides=(1,))
    magic = int.from_bytes(ZSTD_MAGIC, "little")
    there: IntArray = np.minimum(batch.start, words - 1)
    return (starts[there] == magic) & (batch.size >= len(ZSTD_MAGIC))


def _unpacked(data: bytes) -> bytes:
    """A message that may be a zstd frame, as rosbag2 makes one of each."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        if not 0 <= zstandard.frame_content_size(data) <= MAX_CHUNK_BYTES:
            raise BagError("a message in a zstd frame without a size, or with a huge one")
        return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as error:
        raise BagError(f"a message cannot be unpacked: {error}") from error


def _first_ns(file: DataFile) -> int:
    """The first log time, as the blocks state it; NEVER without messages."""
    return min((block.start_ns for block in file.contents.blocks), default=NEVER)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what mcap, SQLite and others raise on damaged input into a BagError that names the bag.

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


def _type_name(name: str) -> str:
    """`package/msg/Type`; early recorders left out the middle."""
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}" if kind and "/" not in kind else name
