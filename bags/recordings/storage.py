"""The files of a bag: MCAP, SQLite and ROS 1, what their channels are, and how they are opened.

What a file is, its first bytes say, not its name. Whatever it is, its messages leave here in CDR:
those of ROS 1 are translated, those that rosbag2 compressed one by one are unpacked.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
import zstandard
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from bags.recordings.batch import Batch
from bags.recordings.definitions import Definition
from bags.recordings.mcap_file import McapFile
from bags.recordings.mcap_records import MAGIC, MAX_CHUNK_BYTES, NEVER, Block
from bags.recordings.message_types import JAZZY, ros2_definition, standard_types, types_in_bag
from bags.recordings.quality import Profile
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
MOST_PADDING: Final = 3  # bytes that rosserial leaves after a message
UNPACKED_BYTES: Final = 2**20  # of a file that was compressed whole, at once
ALWAYS: Final = ((0, NEVER),)

Spans = Sequence[tuple[int, int]]  # ns: from the first to before the second
Takes = Callable[[Block, Mapping[int, int]], bool]  # of a chunk, with its channels' number -> key

DataFile = McapFile | SqliteFile | Ros1File
KINDS: Final = {McapFile: "mcap", SqliteFile: "sqlite3", Ros1File: "ros1"}
MAGICS: Final[Mapping[bytes, type[DataFile]]] = {
    SQLITE_MAGIC: SqliteFile,
    ROS1_MAGIC: Ros1File,
    MAGIC: McapFile,
}
Translate = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Channel:
    """One recorded stream of messages; a topic has one, or several if it was recorded in parts.

    key: its place in `Bag.channels`. schema: encoding and data of what defines the type, empty
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


def open_file(path: Path, stack: ExitStack, lost: list[str], *, salvage: bool) -> DataFile:
    """The file as what its first bytes say that it is, open until the stack is closed."""
    if isinstance(path, RemotePath):
        if path.suffix in (".db3", ".bag", ".zstd"):
            raise BagError(
                "only MCAP is read from where it lies, and not if it is compressed whole; copy "
                "this bag to this machine"
            )
        return stack.enter_context(closing(McapFile(path, salvage=salvage)))
    with path.open("rb") as stream:
        start = stream.read(len(SQLITE_MAGIC))
        if start.startswith(ZSTD_MAGIC):
            stream.seek(0)
            unzipped = _unzipped(path, stream, stack, lost, salvage=salvage)
            return open_file(unzipped, stack, lost, salvage=salvage)
    for magic, kind in MAGICS.items():
        if start.startswith(magic):
            return stack.enter_context(closing(kind(path, salvage=salvage)))
    what = f"starts with {start[:8].hex(' ')}" if start else "is empty, or cut off"
    raise BagError(
        f"it is no MCAP, SQLite or ROS 1 file: it {what}. `nlsid bag import` makes a bag of a table"
    )


def _unzipped(
    path: Path, stream: BinaryIO, stack: ExitStack, lost: list[str], *, salvage: bool
) -> Path:
    """A file that was compressed whole, unpacked until the stack is closed."""
    folder = Path(stack.enter_context(TemporaryDirectory()))
    target = folder / path.name.removesuffix(".zstd")
    for end in BESIDE:
        beside = path.with_name(f"{target.name}{end}")
        if beside.is_file():
            shutil.copy(beside, folder)
    left = shutil.disk_usage(folder).free // 2
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
            lost.append(f"{path.name}: {error}")
    return target


def in_cdr(channel: Channel) -> tuple[Channel, Translate | None]:
    """A channel of ROS 1 as one of ROS 2, and what translates its messages; as it is if its type
    cannot be translated.
    """
    if channel.encoding != "ros1":
        return channel, None
    try:
        definition = ros2_definition(channel.msgtype, channel.definition)
        types = types_in_bag(channel.msgtype, definition)
    except BagError:
        return channel, None

    def translate(data: bytes) -> bytes:
        for padding in range(MOST_PADDING + 1):
            try:
                return bytes(types.ros1_to_cdr(data[: len(data) - padding], channel.msgtype))
            except Exception as error:  # generated code raises what the bytes make it raise
                reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise BagError(f"not a '{channel.msgtype}' of ROS 1: {reason}")

    schema = "ros2msg", definition.data.encode()
    return replace(channel, encoding="cdr", schema=schema), translate


def packed(batch: Batch) -> Any:
    """Which messages begin as a zstd frame does, and as no CDR message."""
    words = len(batch.buffer) - len(ZSTD_MAGIC) + 1
    if words <= 0:
        return np.zeros(len(batch), bool)
    starts = np.ndarray((words,), "<u4", batch.buffer, strides=(1,))
    magic = int.from_bytes(ZSTD_MAGIC, "little")
    there: IntArray = np.minimum(batch.start, words - 1)
    return (starts[there] == magic) & (batch.size >= len(ZSTD_MAGIC))


def unpacked(data: bytes) -> bytes:
    """A message that may be a zstd frame, as rosbag2 makes one of each."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        if not 0 <= zstandard.frame_content_size(data) <= MAX_CHUNK_BYTES:
            raise BagError("a message in a zstd frame without a size, or with a huge one")
        return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as error:
        raise BagError(f"a message cannot be unpacked: {error}") from error


def first_ns(file: DataFile) -> int:
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


def type_name(name: str) -> str:
    """`package/msg/Type`; early recorders left out the middle."""
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}" if kind and "/" not in kind else name
