"""The records of an MCAP file: the layout of a message, chunk contents, and checks on both.

Source: the MCAP specification, https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, Final, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from bags.recordings.batch import Batch, Buffer
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

MAGIC: Final = b"\x89MCAP0\r\n"
CUSTOM_DATA: Final = "custom_data"  # the Metadata record with a bag's own key-value pairs
ROSBAG2: Final = "rosbag2"  # the Metadata record that names the release of ROS 2
NEVER: Final = 2**63 - 1  # ns: after every message
MAX_CHUNK_BYTES: Final = 128 * 2**20  # recorders close a chunk at about 1 MB or after one message
RECORD: Final = struct.Struct("<BQ")
CHUNK_FIXED: Final = RECORD.size + 40  # of a chunk's record, before the name of its compression
MESSAGE: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
INDEX: Final = struct.Struct("<BQHI")  # a message index record before its entries
INDEX_ENTRY: Final = np.dtype([("log", "<u8"), ("offset", "<u8")])
MESSAGE_FIXED: Final = MESSAGE.itemsize - RECORD.size  # of a message's content, before its data

DECLARES: Final[dict[int, Callable[[Any], Any]]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
}

Record = TypeVar("Record")


@dataclass(frozen=True, eq=False)
class Block:
    """A chunk, or a run of records outside chunks, which reads like an uncompressed one.

    offset, size: bytes of its content in the file. start_ns, end_ns: no log time is outside.
    index: the channels that it has messages of, and what finds them: in MCAP (offset, bytes) of the
    message index record in the file. None: unknown.
    """

    offset: int
    size: int
    compression: str = ""
    uncompressed_size: int = 0
    crc: int = 0
    start_ns: int = 0
    end_ns: int = NEVER
    index: dict[int, tuple[int, int]] | None = None

    @property
    def end(self) -> int:
        """The byte after it."""
        return self.offset + self.size

    @property
    def record(self) -> int:
        """Where the chunk's record begins."""
        return self.offset - CHUNK_FIXED - len(self.compression.encode())

    @property
    def last(self) -> int:
        """Where the last of its message index records ends."""
        return max((at + length for at, length in (self.index or {}).values()), default=self.end)

    def has(self, channels: Collection[int]) -> bool:
        """Whether it may have messages of these channels."""
        return self.index is None or any(channel in self.index for channel in channels)


@dataclass
class Declared:
    """The schemas and channels of a file by their ids."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def add(self, record: Schema | Channel) -> None:
        """Keep one; BagError if its id already names another."""
        if isinstance(record, Schema):
            kept, kind = self.schemas.setdefault(record.id, record), "schema"
        else:
            kept, kind = self.channels.setdefault(record.id, record), "channel"  # type: ignore[assignment]
        if kept != record:
            raise BagError(f"{kind} {record.id} is declared twice, and differently")

    def knows(self, channel_id: int) -> bool:
        """Whether a channel and its schema have been declared so far."""
        channel = self.channels.get(channel_id)
        return channel is not None and (channel.schema_id == 0 or channel.schema_id in self.schemas)


@dataclass
class Contents:
    """What a file holds. `ending`: why the file stops early, None if it is finished."""

    declared: Declared = field(default_factory=Declared)
    counts: dict[int, int] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[tuple[int, int]] = field(default_factory=list)  # offset, bytes of the content
    stated: dict[int, int] | None = None  # the statistics' count of messages per channel
    ending: str | None = None
    lost: list[str] = field(default_factory=list)


def uncompressed(block: Block, raw: bytes) -> bytes:
    """The block's records from its bytes in the file.

    Raises BagError if they are damaged, not what the chunk's header states, or more than
    MAX_CHUNK_BYTES; nothing larger than the header states is allocated.
    """
    where, size = f"the chunk at byte {block.offset}", block.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise BagError(f"{where} unpacks to {size} bytes; at most {MAX_CHUNK_BYTES} are read")
    try:
        content = _decompress(block.compression, raw, size)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BagError(f"{where} cannot be decompressed: {error}") from error
    if len(content) != size:
        raise BagError(f"{where} holds {len(content)} bytes, its header says {size}")
    if block.crc and zlib.crc32(content) != block.crc:
        raise BagError(f"{where} is damaged: its checksum differs")
    return content


def walk_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset of the record, its end) of each record in a chunk; BagError if one is cut."""
    at = 0
    while at < len(content):
        if at + RECORD.size > len(content):
            raise BagError(f"a chunk ends inside a record, at {at} of {len(content)} bytes")
        opcode, length = RECORD.unpack_from(content, at)
        end = at + RECORD.size + length
        if end > len(content):
            raise BagError(f"a record in a chunk runs past its end, at {at} of {len(content)}")
        yield opcode, at, end
        at = end


def walk_chunk(content: bytes) -> tuple[list[Schema | Channel], dict[int, IntArray]]:
    """What a chunk declares, and each channel's message records, as offsets, without an index."""
    declared: list[Schema | Channel] = []
    found: dict[int, list[int]] = {}
    for opcode, at, end in walk_records(content):
        if opcode in DECLARES:
            declared.append(parse(DECLARES[opcode], content[at + RECORD.size : end]))
        elif opcode == Opcode.MESSAGE:
            if end - at < MESSAGE.itemsize:
                raise BagError(f"a message record of {end - at} bytes")
            channel = int.from_bytes(content[at + RECORD.size : at + RECORD.size + 2], "little")
            found.setdefault(channel, []).append(at)
    return declared, {channel: np.array(at, np.int64) for channel, at in found.items()}


def rest_said(rest: int) -> str:
    """What is behind the last whole record of a file that stops early, in words."""
    return f"; the last {rest} bytes hold no whole chunk" if rest > 0 else ""


def messages_at(
    content: Buffer, offsets: IntArray, channel: int, where: str, edges: IntArray | None = None
) -> Batch:
    """The messages whose records are at `offsets`; BagError unless all are messages of `channel`.

    Gathered through overlapping views, so that no message costs a step of Python. edges: ascending,
    where records begin or end, the last end among them; no message goes past the next (None: where
    those of the channel begin).
    """
    last = len(content) - MESSAGE.itemsize
    if last < 0 or (offsets < 0).any() or (offsets > last).any():
        raise BagError(f"{where} points outside it")
    if (np.diff(offsets) <= 0).any():
        offsets = np.sort(offsets)
        if (np.diff(offsets) == 0).any():
            raise BagError(f"{where} lists a message twice")
    overlapping = np.ndarray((last + 1,), f"V{MESSAGE.itemsize}", content, strides=(1,))
    header = overlapping[offsets].view(MESSAGE)
    if (header["opcode"] != Opcode.MESSAGE).any() or (header["channel"] != channel).any():
        raise BagError(f"{where} does not point at messages of channel {channel}")
    length = header["length"]
    if (length < MESSAGE_FIXED).any() or (length > len(content)).any():
        raise BagError(f"{where} points at messages that are no messages")
    start = offsets + MESSAGE.itemsize
    size = length.astype(np.int64) - MESSAGE_FIXED
    ends = start + size
    edges = np.append(offsets, len(content)) if edges is None else edges
    if (ends > edges[np.searchsorted(edges, offsets, side="right")]).any():
        raise BagError(f"{where} points at messages that overlap")
    return Batch(
        content,
        start,
        size,
        _time(header["log"], where),
        _time(header["publish"], where),
        header["sequence"].astype(np.int64),
    )


def index_entries(record: bytes, channel: int, where: str) -> Any:
    """Read INDEX_ENTRY of each message that a channel has in a chunk, from its index record.

    Raises BagError if that is damaged.
    """
    if len(record) < INDEX.size:
        raise BagError(f"{where} is damaged")
    opcode, length, of, size = INDEX.unpack_from(record)
    fits = INDEX.size + size <= len(record) and INDEX.size + size <= RECORD.size + length
    if opcode != Opcode.MESSAGE_INDEX or of != channel or not fits or size % INDEX_ENTRY.itemsize:
        raise BagError(f"{where} is damaged")
    return np.frombuffer(record, INDEX_ENTRY, size // INDEX_ENTRY.itemsize, INDEX.size)


def index_offsets(record: bytes, channel: int, where: str) -> IntArray:
    """Read where the same messages begin in the chunk."""
    return np.asarray(index_entries(record, channel, where)["offset"].astype(np.int64))


def index_times(record: bytes, channel: int, where: str) -> IntArray:
    """Read their log times in ns."""
    return _time(index_entries(record, channel, where)["log"], where)


def parse(read: Callable[[Any], Record], content: bytes) -> Record:
    """One record by mcap's own parser; BagError if it is damaged."""
    try:
        return read(ReadDataStream(BytesIO(content)))
    except Exception as error:  # mcap raises what the bytes make struct and codecs raise
        raise BagError(f"a damaged record: {type(error).__name__}: {error}") from error


def unpack(layout: struct.Struct, content: bytes) -> tuple[Any, ...]:
    """The start of `content` by `layout`; BagError if it is too short."""
    if len(content) < layout.size:
        raise BagError(f"a record ends after {len(content)} bytes, {layout.size} are needed")
    return layout.unpack_from(content)


def _decompress(compression: str, raw: bytes, size: int) -> bytes:
    if compression == "":
        return raw
    if compression == "zstd":
        stated = zstandard.frame_content_size(raw)
        if stated not in (-1, size):
            raise BagError(f"a zstd frame of {stated} bytes where the header says {size}")
        if size == 0:
            return b""
        return zstandard.ZstdDecompressor().decompress(raw, max_output_size=size)
    if compression == "lz4":
        # one byte more than stated, to see that there is none
        content: bytes = lz4.frame.LZ4FrameDecompressor().decompress(raw, max_length=size + 1)
        return content
    raise BagError(f"a chunk is compressed by '{compression}'; known are zstd and lz4")


def _time(stamps: Any, where: str) -> IntArray:
    if len(stamps) and stamps.max() >= 2**63:
        raise BagError(f"{where} points at a message with time {stamps.max()} ns")
    return np.asarray(stamps.astype(np.int64))
