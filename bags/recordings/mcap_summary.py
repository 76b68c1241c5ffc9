"""What a finished MCAP file says of itself at its end: read first where every byte is fetched.

The summary lists channels, counts and chunks. A chunk that is wanted is fetched with its message
index; of an uncompressed one only the index and then the messages, at the places that it names.
With an index comes the beginning of the next chunk, as far as the last chunk begins with wanted
messages: it is a large message that fills a chunk, so small ones often follow it in the next.
Source: the MCAP specification, https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby, pairwise
from typing import Any, Final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
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
    MAGIC,
    RECORD,
    Block,
    Contents,
    Record,
    counted,
    index_entries,
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
AHEAD: Final = 1.5  # of what the last chunk begins with; the next may begin with more
KNOWN_BYTES: Final = 16 * 2**10  # of a declaration that is kept for other bags
_FOOTER: Final = RECORD.size + 20 + len(MAGIC)
_INDEX: Final = struct.Struct("<BQHI")  # a message index record before its entries


@dataclass(frozen=True, eq=False)
class ListedBlock(Block):
    """A chunk as the summary lists it: `index` has (offset, bytes) of its channels' index records.

    record, last: bytes in the file where its record begins, and where its message indexes end.
    """

    record: int = 0
    last: int = 0


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
    found = Contents()
    metadata: list[MetadataIndex] = []
    for opcode, at, record_end in walk_records(summary):
        content = summary[at + RECORD.size : record_end]
        if opcode == Opcode.SCHEMA:
            found.declared.add(_declared(Schema.read, content))
        elif opcode == Opcode.CHANNEL:
            found.declared.add(_declared(Channel.read, content))
        elif opcode == Opcode.STATISTICS:
            statistics = parse(Statistics.read, content)
            found.stated = counted(statistics)
            found.counts = found.stated or {}
        elif opcode == Opcode.CHUNK_INDEX:
            found.blocks.append(_listed(parse(ChunkIndex.read, content), start))
        elif opcode == Opcode.METADATA_INDEX:
            metadata.append(parse(MetadataIndex.read, content))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            attached = parse(AttachmentIndex.read, content)
            if attached.offset + attached.length > start:
                raise BagError(f"the attachment at byte {attached.offset} lies outside the file")
            place = attached.offset + RECORD.size, attached.length - RECORD.size
            found.attachments.append(place)
    if found.stated is None:
        return None
    found.blocks.sort(key=lambda block: block.offset)
    for block, after in pairwise(found.blocks):
        if block.offset + block.size > after.offset:
            raise BagError(
                f"the summary's chunks at bytes {block.offset} and {after.offset} overlap"
            )
    named = {channel for block in found.blocks for channel in block.index or ()}
    filled = {channel for channel, count in found.counts.items() if count}
    if not all(map(found.declared.knows, named)) or not filled <= named:  # some stand elsewhere
        return None
    if any(not (len(MAGIC) <= m.offset <= m.offset + m.length <= start) for m in metadata):
        raise BagError("the summary names metadata outside the file")
    path.fetch((m.offset, m.offset + m.length) for m in metadata)
    for m in metadata:
        record = path.read_range(m.offset, m.offset + m.length)
        found.metadata.append(parse(Metadata.read, record[RECORD.size :]))
    return found


def _declared(read: Callable[[Any], Record], content: bytes) -> Record:
    """A schema or a channel; robots of a fleet declare the same ones in every bag."""
    found: Record = (_known if len(content) <= KNOWN_BYTES else parse)(read, content)
    return found


_known = lru_cache(maxsize=256)(parse)


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
        offset,
        chunk.compressed_size,
        chunk.compression,
        chunk.uncompressed_size,
        0,
        chunk.message_start_time,
        index,
        record,
        end,
    )


class Prepared:
    """The chunks of a file that were fetched for some channels, a window of them at a time."""

    def __init__(self, path: RemotePath, blocks: Sequence[Block]) -> None:
        self._path = path
        self._blocks = [block for block in blocks if isinstance(block, ListedBlock)]
        self._place = {block.offset: i for i, block in enumerate(self._blocks)}
        self._channels: frozenset[int] = frozenset()
        self._ready: dict[int, dict[int, IntArray]] = {}  # byte of a chunk -> its message indexes
        self._runs: tuple[IntArray, IntArray] = _sorted(), _sorted()  # first bytes, ends

    def groups(self, channels: Collection[int]) -> Iterator[Sequence[Block]]:
        """What `records` takes, in the order of the file: the chunks of a window that are not
        compressed together, a compressed one alone.
        """
        self._want(channels)
        at = 0
        while window := list(self._window(at)):
            for compressed, run in groupby(window, key=lambda block: bool(block.compression)):
                blocks = list(run)
                yield from ([block] for block in blocks) if compressed else [blocks]
            at = self._place[window[-1].offset] + 1

    def records(
        self, wanted: Sequence[Block], channels: Collection[int]
    ) -> tuple[bytes, dict[int, IntArray], IntArray]:
        """Records of one of the `groups`, or of any one block; where in them each channel's
        messages begin; and where any of them ends at the latest.

        They are those of the wanted messages, one behind the other; of a compressed block, all.
        """
        self._want(channels)
        blocks = [block for block in wanted if isinstance(block, ListedBlock)]
        first, last = blocks[0], blocks[-1]
        if first.offset not in self._ready:
            self._prepare(list(self._window(self._place[first.offset])))
        if first.compression:
            offsets = self._ready[first.offset]
            header = self._path.read_range(first.record, first.last)
            crc = int.from_bytes(header[RECORD.size + 24 : RECORD.size + 28], "little")
            at = first.offset - first.record
            content = uncompressed(replace(first, crc=crc), header[at : at + first.size])
            return content, offsets, _sorted(*offsets.values(), np.array([len(content)]))
        here = slice(*np.searchsorted(self._runs[0], (first.offset, last.offset + last.size)))
        starts, ends = (places[here] for places in self._runs)
        after = np.cumsum(ends - starts)
        content = b"".join(map(self._path.read_range, starts.tolist(), ends.tolist()))
        placed = {}
        for channel in self._channels:
            there = [
                block.offset + offsets[channel]
                for block in blocks
                if channel in (offsets := self._ready[block.offset])
            ]
            if there:
                begins = np.concatenate(there)
                run = np.searchsorted(starts, begins, side="right") - 1
                placed[channel] = begins - ends[run] + after[run]
        return content, placed, _sorted(*placed.values(), after)

    def _want(self, channels: Collection[int]) -> None:
        if not self._channels.issuperset(channels):
            self._channels, self._ready = frozenset(channels), {}

    def _window(self, at: int) -> Iterator[ListedBlock]:
        """Wanted blocks from the one with this number on."""
        held = 0
        for block in self._blocks[at:]:
            if held and held + block.size > WINDOW_BYTES:
                return
            if self._is_wanted(block):
                held += block.size
                yield block

    def _is_wanted(self, block: ListedBlock) -> bool:
        return not self._channels.isdisjoint(block.index or ())

    def _prepare(self, window: Sequence[ListedBlock]) -> None:
        """Fetch what of these blocks is wanted."""
        ahead = self._ahead()
        self._path.fetch(self._span(block, ahead) for block in window)
        self._ready = {block.offset: self._entries_of(block) for block in window}
        self._runs = self._runs_of([block for block in window if not block.compression])
        self._path.fetch(zip(*(places.tolist() for places in self._runs), strict=True))

    def _ahead(self) -> int:
        """Bytes of wanted messages with which a chunk may begin: less than a request costs, and 0
        if the index of the last chunk, which tells, would have to be fetched for it.
        """
        last = self._blocks[-1]
        if last.compression or not self._path.holds(last.end, last.last):
            return 0
        self._ready = {last.offset: self._entries_of(last)}
        _, ends = self._runs_of([last])
        reach = AHEAD * (ends[0] - last.record) if len(ends) else 0.0
        return int(reach) if reach <= GAP_BYTES else 0

    def _span(self, block: ListedBlock, ahead: int) -> tuple[int, int]:
        """What is fetched of a block before its indexes are known; with so much of the next."""
        if block.compression:
            return block.record, block.last
        following = self._place[block.offset] + 1
        if following == len(self._blocks) or not self._is_wanted(self._blocks[following]):
            return block.end, block.last
        return block.end, min(block.last + ahead, self._blocks[following].end)

    def _runs_of(self, blocks: Sequence[ListedBlock]) -> tuple[IntArray, IntArray]:
        """First bytes and ends, in the file, of the wanted messages' records: of runs in a block
        without a gap of GAP_BYTES. A record ends where the next record of a message begins.
        """
        others: list[IntArray] = []
        wanted: list[IntArray] = []
        for block in blocks:
            for channel, offsets in self._ready[block.offset].items():
                (wanted if channel in self._channels else others).append(block.offset + offsets)
        edges = np.array([block.offset + block.size for block in blocks], np.int64)
        first = _sorted(*wanted)
        if not len(first):
            return first, first
        starts = _sorted(*others, first, edges)
        ends = starts[np.searchsorted(starts, first, side="right")]
        of = np.searchsorted(edges, first, side="right")
        gaps = np.flatnonzero((first[1:] > ends[:-1] + GAP_BYTES) | (of[1:] != of[:-1]))
        return first[np.r_[0, gaps + 1]], ends[np.r_[gaps, -1]]

    def _entries_of(self, block: ListedBlock) -> dict[int, IntArray]:
        """Offsets of each channel's messages in the chunk, as its index records have them."""
        records = self._path.read_range(block.end, block.last)
        found = {}
        for channel, (at, length) in (block.index or {}).items():
            start, where = at - block.end, f"the message index at byte {at}"
            listed = index_entries(records[start : start + length], channel, where)
            if len(listed) and listed.max() >= block.uncompressed_size:
                raise BagError(f"{where} points outside its chunk")
            found[channel] = listed
        return found


def _sorted(*places: IntArray) -> IntArray:
    """All of them in order."""
    return np.sort(np.concatenate(places)) if places else np.empty(0, np.int64)
