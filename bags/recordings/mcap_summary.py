"""What a finished MCAP file says of itself at its end: read first where every byte is fetched.

The summary lists channels, counts and chunks. A chunk that is wanted is fetched with its message
index; of an uncompressed one only the index and then the messages, at the places that it names.
Source: the MCAP specification, https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from bags.recordings.mcap_records import (
    INDEX_ENTRY,
    MAGIC,
    RECORD,
    Block,
    Contents,
    add_channel,
    add_schema,
    parse,
    uncompressed,
    walk_records,
)
from bags.recordings.remote import GAP_BYTES, TAIL_BYTES, RemotePath
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

MAX_SUMMARY_BYTES: Final = 64 * 2**20  # of some 100 bytes a chunk
WINDOW_BYTES: Final = 32 * 2**20  # of chunks that are prepared, and held, together
WHOLE_BYTES: Final = TAIL_BYTES + GAP_BYTES  # a file no longer than this is one request
_FOOTER: Final = RECORD.size + 20 + len(MAGIC)


@dataclass(frozen=True, eq=False)
class ListedBlock(Block):
    """A chunk as the summary lists it: `index` has (offset, bytes) of its channels' index records.

    record, end: bytes in the file where its record begins, and where its message indexes end.
    """

    record: int = 0
    end: int = 0

    @property
    def indexes(self) -> int:
        """The byte where its message indexes begin."""
        return self.offset + self.size


def summarised(path: RemotePath) -> Contents | None:
    """What the file's summary says; None if it has none that lists every channel and count.

    Raises BagError if the summary is damaged.
    """
    size = path.entry.size
    if size < len(MAGIC) + _FOOTER:
        return None
    tail = path.read_range(size - TAIL_BYTES if size > WHOLE_BYTES else 0, size)
    if not tail.endswith(MAGIC):
        return None
    opcode, length = RECORD.unpack_from(tail, len(tail) - _FOOTER)
    if opcode != Opcode.FOOTER or length != 20:
        return None
    footer = parse(Footer.read, tail[len(tail) - _FOOTER + RECORD.size : len(tail) - len(MAGIC)])
    start, end = footer.summary_start, size - _FOOTER
    if not start:
        return None
    if not len(MAGIC) <= start <= end or end - start > MAX_SUMMARY_BYTES:
        raise BagError("the footer's summary offset is damaged")
    summary = path.read_range(start, end)
    if footer.summary_crc:
        signed = summary + path.read_range(end, end + RECORD.size + 16)
        if zlib.crc32(signed) != footer.summary_crc:
            raise BagError("the summary is damaged: its checksum differs")
    return _contents(path, summary, start)


def _contents(path: RemotePath, summary: bytes, start: int) -> Contents | None:
    found = Contents(good_bytes=path.entry.size)
    metadata: list[MetadataIndex] = []
    for opcode, at, record_end in walk_records(summary):
        content = summary[at + RECORD.size : record_end]
        if opcode == Opcode.SCHEMA:
            add_schema(found.schemas, parse(Schema.read, content))
        elif opcode == Opcode.CHANNEL:
            add_channel(found.channels, parse(Channel.read, content))
        elif opcode == Opcode.STATISTICS:
            statistics = parse(Statistics.read, content)
            found.stated = found.counts = dict(statistics.channel_message_counts)
        elif opcode == Opcode.CHUNK_INDEX:
            found.blocks.append(_listed(parse(ChunkIndex.read, content), start))
        elif opcode == Opcode.METADATA_INDEX:
            metadata.append(parse(MetadataIndex.read, content))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            found.attachments.append(_attachment(parse(AttachmentIndex.read, content), start))
    if found.stated is None:
        return None
    named = {channel for block in found.blocks for channel in block.index or ()}
    declared = {
        c.id for c in found.channels.values() if not c.schema_id or c.schema_id in found.schemas
    }
    counted = {channel for channel, count in found.counts.items() if count}
    if not named | counted <= declared or not counted <= named:  # some are told elsewhere
        return None
    if any(not (len(MAGIC) <= m.offset <= m.offset + m.length <= start) for m in metadata):
        raise BagError("the summary names metadata outside the file")
    path.fetch((m.offset, m.offset + m.length) for m in metadata)
    for m in metadata:
        record = path.read_range(m.offset, m.offset + m.length)
        found.metadata.append(parse(Metadata.read, record[RECORD.size :]))
    return found


def _listed(chunk: ChunkIndex, limit: int) -> ListedBlock:
    """The chunk of an index; BagError unless it lies before `limit`, with its message indexes."""
    record, letters = chunk.chunk_start_offset, len(chunk.compression.encode())
    offset = record + RECORD.size + 40 + letters
    data_end = record + chunk.chunk_length
    end = data_end + chunk.message_index_length
    if record < len(MAGIC) or end > limit or offset + chunk.compressed_size != data_end:
        raise BagError(f"the summary's chunk at byte {record} does not lie in the file")
    places = sorted(chunk.message_index_offsets.items(), key=lambda entry: entry[1])
    if not chunk.compression and chunk.uncompressed_size != chunk.compressed_size:
        raise BagError(
            f"the chunk at byte {record} has {chunk.compressed_size} bytes without compression, "
            f"and says {chunk.uncompressed_size}"
        )
    edges = [at for _, at in places] + [end]
    if places and (edges[0] < data_end or edges[-2] > end):
        raise BagError(f"the message indexes of the chunk at byte {record} are not behind it")
    index = {c: (at, after - at) for (c, at), after in zip(places, edges[1:], strict=True)}
    return ListedBlock(
        offset, chunk.compressed_size, chunk.compression, chunk.uncompressed_size, 0,
        chunk.message_start_time, index, record, end,
    )  # fmt: skip


def _attachment(index: AttachmentIndex, limit: int) -> Attachment:
    """The attachment's header; `data` holds (offset, size) of its data, which stay in place."""
    names = len(index.name.encode()) + len(index.media_type.encode())
    offset = index.offset + RECORD.size + 16 + 4 + 4 + names + 8
    if offset + index.data_size > min(limit, index.offset + index.length):
        raise BagError(f"the attachment at byte {index.offset} is longer than its record")
    place = struct.pack("<QQ", offset, index.data_size)
    return Attachment(index.create_time, index.log_time, index.name, index.media_type, place)


class Prepared:
    """The chunks of a file that were fetched for some channels, a window of them at a time."""

    def __init__(self, path: RemotePath, blocks: Sequence[Block]) -> None:
        self._path = path
        self._blocks = [block for block in blocks if isinstance(block, ListedBlock)]
        self._place = {block.offset: i for i, block in enumerate(self._blocks)}
        self._channels: frozenset[int] = frozenset()
        self._ready: dict[int, dict[int, IntArray]] = {}  # byte of a chunk -> its message indexes
        self._runs: dict[int, tuple[IntArray, IntArray]] = {}  # and what is fetched of it

    def records(
        self, block: ListedBlock, channels: Collection[int]
    ) -> tuple[bytes, dict[int, IntArray], IntArray]:
        """Records of the block, where in them each channel's messages begin, and where any of
        them ends at the latest.

        They are those of the wanted messages, one behind the other; of a compressed block, all.
        """
        if not self._channels.issuperset(channels):
            self._channels, self._ready = frozenset(channels), {}
        if block.offset not in self._ready:
            window = list(self._window(block))
            self._path.fetch(_span(ahead) for ahead in window)
            self._ready = {ahead.offset: self._entries_of(ahead) for ahead in window}
            plain = [ahead for ahead in window if not ahead.compression]
            self._runs = {ahead.offset: self._runs_of(ahead) for ahead in plain}
            self._path.fetch(
                (at + start, at + end)
                for at, (starts, ends) in self._runs.items()
                for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
            )
        offsets = self._ready[block.offset]
        if block.compression:
            header = self._path.read_range(block.record, block.end)
            crc = int.from_bytes(header[RECORD.size + 24 : RECORD.size + 28], "little")
            at = block.offset - block.record
            content = uncompressed(replace(block, crc=crc), header[at : at + block.size])
            return content, offsets, _sorted(*offsets.values(), [len(content)])
        starts, ends = self._runs[block.offset]
        after = np.cumsum(ends - starts)
        content = b"".join(
            self._path.read_range(block.offset + start, block.offset + end)
            for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
        )
        placed = {}
        for channel in self._channels & offsets.keys():
            run = np.searchsorted(starts, offsets[channel], side="right") - 1
            placed[channel] = offsets[channel] - ends[run] + after[run]
        return content, placed, _sorted(*placed.values(), after)

    def _window(self, first: ListedBlock) -> Iterator[ListedBlock]:
        held = 0
        for block in self._blocks[self._place[first.offset] :]:
            if held and held + block.size > WINDOW_BYTES:
                return
            if self._channels & (block.index or {}).keys():
                held += block.size
                yield block

    def _runs_of(self, block: ListedBlock) -> tuple[IntArray, IntArray]:
        """First bytes and ends, in the block, of the wanted messages' records: of runs without a
        gap of GAP_BYTES. A record ends where the next record of a message begins.
        """
        every = self._ready[block.offset]
        starts = _sorted(*every.values(), [block.size])
        first = _sorted(*(every[channel] for channel in self._channels & every.keys()))
        if not len(first):
            return first, first
        ends = starts[np.searchsorted(starts, first, side="right")]
        gaps = np.flatnonzero(first[1:] > ends[:-1] + GAP_BYTES)
        return first[np.r_[0, gaps + 1]], ends[np.r_[gaps, -1]]

    def _entries_of(self, block: ListedBlock) -> dict[int, IntArray]:
        return {channel: self._entries(block, channel) for channel in block.index or ()}

    def _entries(self, block: ListedBlock, channel: int) -> IntArray:
        """Offsets of the channel's messages in the chunk, as its index record has them."""
        at, length = (block.index or {})[channel]
        record = self._path.read_range(at, at + length)
        where = f"the message index at byte {at}"
        if length < RECORD.size + 6:
            raise BagError(f"{where} is damaged")
        opcode, size = RECORD.unpack_from(record)
        of, entries = struct.unpack_from("<HI", record, RECORD.size)
        fits = RECORD.size + size <= length and 6 + entries == size
        if opcode != Opcode.MESSAGE_INDEX or of != channel or not fits or entries % 16:
            raise BagError(f"{where} is damaged")
        found: Any = np.frombuffer(record, INDEX_ENTRY, entries // 16, RECORD.size + 6)
        if len(found) and found["offset"].max() >= block.uncompressed_size:
            raise BagError(f"{where} points outside its chunk")
        offsets: IntArray = found["offset"].astype(np.int64)
        return offsets


def _sorted(*places: Any) -> IntArray:
    """All of them in order, each once."""
    return np.unique(np.concatenate([np.empty(0, np.int64), *places]).astype(np.int64))


def _span(block: ListedBlock) -> tuple[int, int]:
    """What is fetched of a chunk before its indexes are known."""
    return (block.record if block.compression else block.indexes), block.end
