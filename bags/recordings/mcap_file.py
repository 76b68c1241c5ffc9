"""An MCAP file as blocks of messages that NumPy can index, whatever state the file is in.

What a finished file's summary lists is read from there: channels, counts and chunks, and where each
chunk's message indexes are. It is used if it lists everything. Any other file is walked record by
record from its start, hopping over the chunks' contents, so one that was never finished or that
lost its end reads like any other up to there. Of a file that is not on this machine, what is wanted
of several chunks is fetched together.
Every length is held against the bytes that are there before anything is allocated.

Source: the MCAP specification, https://mcap.dev/spec.
"""

import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, TypeVar

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    Footer,
    Metadata,
    MetadataIndex,
    Statistics,
)

from bags.recordings.batch import Batch, Buffer
from bags.recordings.mcap_fetch import Fetching
from bags.recordings.mcap_records import (
    CHUNK_FIXED,
    DECLARES,
    INDEX,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_FIXED,
    NEVER,
    RECORD,
    Block,
    Contents,
    index_offsets,
    index_times,
    messages_at,
    parse,
    rest_said,
    uncompressed,
    unpack,
    walk_chunk,
    walk_records,
)
from bags.recordings.remote import GAP_BYTES, TAIL_BYTES, RemotePath, place
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

OF_SUMMARY: Final = (*DECLARES, Opcode.STATISTICS)
ATTACHMENT_FIXED: Final = 8 + 8 + 4 + 4 + 8  # bytes of two times and three lengths
CHECKSUM_AT: Final = RECORD.size + 24  # of a chunk's record, its checksum
SEARCH_BYTES: Final = 2**20
MAX_RECORD_BYTES: Final = (
    128 * 2**20
)  # of the records read whole: schemas, metadata, loose messages
MAX_WHOLE_BYTES: Final = 256 * 2**20  # of a remote file without a summary
LOOSE_RUN_BYTES: Final = 4 * 2**20  # messages outside chunks are read in runs of about this size

MAX_SUMMARY_BYTES: Final = 64 * 2**20  # of some 100 bytes a chunk
WHOLE_BYTES: Final = TAIL_BYTES + GAP_BYTES  # a file no longer than this is one request
KNOWN_BYTES: Final = 16 * 2**10  # of a declaration that is kept for other bags
_FOOTER: Final = RECORD.size + 20 + len(MAGIC)

READS: Final[dict[int, Callable[[Any], Any]]] = {
    **DECLARES,
    Opcode.STATISTICS: Statistics.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
}

_CHUNK: Final = struct.Struct("<QQQII")
_COMPRESSION: Final = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4", re.DOTALL)

Record = TypeVar("Record")
Read = Callable[[int, int], bytes]  # offset, bytes
Batches = Iterator[tuple[int, Batch]]  # channel id, messages


class Whole(NamedTuple):
    """A chunk as it lies in the file, when it begins, its messages by their channels' numbers."""

    log_ns: int
    chunk: Chunk
    messages: dict[int, Batch]


class McapFile:
    """An MCAP file open for reading; close it.

    Raises BagError if it is not an MCAP file or if a record is damaged; a file that merely stops
    early opens, and says so in `contents.ending`. With `salvage=True` what is damaged is left out
    and listed in `contents.lost`, and indexes and summary are not used.
    """

    def __init__(self, path: Path | str, *, salvage: bool = False) -> None:
        self.path = place(path)
        self._salvage = salvage
        self._size = self.path.stat().st_size
        self._stream: BinaryIO | None = None
        self._fetching: Fetching | None = None
        self._statistics: Statistics | None = None  # of a file that is walked
        try:
            if not isinstance(self.path, RemotePath):
                self._stream = self.path.open("rb", buffering=0)
            found = None if salvage else summarised(self._read, self._size)
            if found is None or not self._is_as_listed(found):
                self._fetch_whole()
                self.contents = self._walk()
                self._find_channels()
                return
            self.contents = found
            if isinstance(self.path, RemotePath):
                self._fetching = Fetching(self.path, found.blocks)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()

    def _is_as_listed(self, found: Contents) -> bool:
        """Whether all messages lie in the chunks that the summary lists; the data are checked.

        A remote file is taken at its word: to look costs a request for each gap between chunks.
        """
        if self._stream is None:
            return True
        gaps = [len(MAGIC), *(block.last for block in found.blocks)]
        for at, until in zip(gaps, [*(b.record for b in found.blocks), self._size], strict=True):
            while at + RECORD.size <= until:
                opcode, length = RECORD.unpack(self._read(at, RECORD.size))
                if opcode in (0, Opcode.MESSAGE, Opcode.CHUNK):
                    return False
                at += RECORD.size
                if opcode == Opcode.DATA_END:
                    self._check_data(found, at)
                    return True
                at += length
        return False

    def _fetch_whole(self) -> None:
        """Fetch a remote file that has to be walked; BagError if it is too large for that."""
        if not isinstance(self.path, RemotePath):
            return
        if self._size > MAX_WHOLE_BYTES:
            raise BagError(
                f"it has {self._size} bytes and no summary that lists its chunks; copy it to this "
                "machine, and mend it with `nlsid bag recover`"
            )
        self.path.fetch([(0, self._size)])

    def block_batches(self, block: Block, channels: Collection[int]) -> Batches:
        """The messages of one block, one batch per channel that has any.

        Raises BagError if it is damaged or not what its index says.
        """
        if not block.has(channels):
            return
        where = f"the message index of the chunk at byte {block.offset}"
        buffer: Buffer
        edges = None
        plan = None if self._fetching is None else self._fetching.hold(block, channels)
        if self._fetching is not None and plan is not None:
            buffer, offsets, edges = self._fetching.content(block, plan), plan.offsets, plan.edges
        else:
            buffer = self.content(block)
            offsets = self._offsets(block, buffer, channels)
        for channel in channels:
            found = offsets.get(channel)
            if found is not None and len(found):
                batch = messages_at(buffer, found, channel, where, edges)
                if batch.log_ns.min() < block.start_ns:  # they would come out of order
                    raise BagError(f"{where} points at messages before the time it states")
                yield channel, batch

    def _offsets(
        self, block: Block, content: bytes, channels: Collection[int]
    ) -> dict[int, IntArray]:
        """Where the messages of each channel begin, by the block's index if it has one."""
        if block.index is None:
            return walk_chunk(content)[1]
        where = f"the message index of the chunk at byte {block.offset}"
        wanted = [c for c in channels if c in block.index]
        return {c: index_offsets(self._read(*block.index[c]), c, where) for c in wanted}

    def log_times(self, channels: Collection[int]) -> Iterator[tuple[int, IntArray]]:
        """Read (channel id, log times in ns), chunk by chunk, from indexes where there are some.

        Raises BagError if an index, or a block without one, is damaged.
        """
        blocks = [block for block in self.contents.blocks if block.has(channels)]
        if isinstance(self.path, RemotePath):
            self.path.fetch((block.end, block.last) for block in blocks if block.index is not None)
        for block in blocks:
            if block.index is None:
                yield from ((c, batch.log_ns) for c, batch in self.block_batches(block, channels))
                continue
            where = f"the message index of the chunk at byte {block.offset}"
            indexes = self._read(block.end, block.last - block.end)
            for channel in block.index.keys() & set(channels):
                at, length = block.index[channel]
                yield channel, index_times(indexes[at - block.end :][:length], channel, where)

    def whole(self, block: Block) -> Whole | None:
        """A chunk that can be copied as it is: its checksum is right, and it holds messages only,
        which its indexes list, within the times that it states. Else None.

        Raises BagError if it is damaged.
        """
        if block.index is None or self._fetching is not None:
            return None
        messages = dict(self.block_batches(block, block.index))
        listed = sum(len(b) * MESSAGE.itemsize + int(b.size.sum()) for b in messages.values())
        last_ns = max((int(b.log_ns.max()) for b in messages.values()), default=NEVER)
        if listed != block.uncompressed_size or last_ns > block.end_ns:
            return None
        chunk = Chunk(
            compression=block.compression,
            data=self._packed(block),
            message_end_time=block.end_ns,
            message_start_time=block.start_ns,
            uncompressed_crc=zlib.crc32(next(iter(messages.values())).buffer),
            uncompressed_size=block.uncompressed_size,
        )
        return Whole(block.start_ns, chunk, messages)

    def content(self, block: Block) -> bytes:
        """The block's records, decompressed; BagError if they are not what the chunk states."""
        return uncompressed(replace(block, crc=self._checksum(block)), self._packed(block))

    def _packed(self, block: Block) -> bytes:
        raw = self._read(block.offset, block.size)
        if len(raw) != block.size:
            raise BagError(f"the chunk at byte {block.offset} is cut off")
        return raw

    def _checksum(self, block: Block) -> int:
        """What the chunk's header states, which a summary does not list."""
        if block.index is None:
            return block.crc
        return int.from_bytes(self._read(block.record + CHECKSUM_AT, 4), "little")

    def attachments(self) -> Iterator[Attachment]:
        """The attachments, whose data are read only now."""
        for offset, length in self.contents.attachments:
            content = self._read(offset, length)
            try:
                found = parse(Attachment.read, content)
                names = len(found.name.encode()) + len(found.media_type.encode())
                end = ATTACHMENT_FIXED + names + len(found.data)
                crc = int.from_bytes(content[end : end + 4], "little")
                if crc and crc != zlib.crc32(content[:end]):
                    raise BagError(f"the attachment {found.name} is damaged: its checksum differs")
            except BagError as error:
                if not self._salvage:
                    raise
                self.contents.lost.append(str(error))
                continue
            yield found

    def _walk(self) -> Contents:
        found = Contents(ending="it stops without the end of an MCAP file")
        if self._read(0, len(MAGIC)) != MAGIC:
            raise BagError("not an MCAP file")
        at = good_bytes = len(MAGIC)
        repeating = False
        while at + RECORD.size <= self._size:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            content, end = at + RECORD.size, at + RECORD.size + length
            if end > self._size or opcode == 0:
                what = "runs past the end of the file" if opcode else "is no record"
                found.ending = f"what starts at byte {at} {what}"
                following = self._next_chunk(at + 1) if self._salvage and not repeating else None
                if following is None:
                    break
                found.lost.append(f"bytes {at} to {following}: no records")
                at = following
                continue
            try:
                if not repeating or opcode in OF_SUMMARY:  # of what is there twice, the first
                    self._note(found, opcode, content, length)
            except BagError as error:
                if not self._salvage:
                    raise
                found.lost.append(str(error))
            at = good_bytes = end
            repeating |= self._salvage and opcode == Opcode.DATA_END
            if opcode == Opcode.FOOTER:
                if self._read(at, len(MAGIC)) == MAGIC:
                    found.ending = None
                break
        if repeating:
            found.ending = None
        if found.ending is not None:
            found.ending += rest_said(self._size - good_bytes)
        return found

    def _next_chunk(self, start: int) -> int | None:
        """The first byte from `start` on where a compressed chunk's record begins."""
        before = RECORD.size + _CHUNK.size - 4  # from there to the length of the compression's name
        keep = before + 16
        for at in range(start, self._size, SEARCH_BYTES):
            for match in _COMPRESSION.finditer(self._read(at, SEARCH_BYTES + keep), before):
                place = at + match.start() - before
                opcode, length = RECORD.unpack(self._read(place, RECORD.size))
                if opcode == Opcode.CHUNK and place + RECORD.size + length <= self._size:
                    return place
        return None

    def _note(self, found: Contents, opcode: int, content: int, length: int) -> None:
        """Keep what a record outside chunks says."""
        if opcode == Opcode.MESSAGE:
            at = content - RECORD.size
            if length < MESSAGE_FIXED:
                raise BagError(f"the message at byte {at} has {length} bytes")
            _add_loose(found.blocks, at, content + length)
        elif opcode == Opcode.CHUNK:
            found.blocks.append(self._chunk(content, length))
        elif opcode in DECLARES:
            found.declared.add(self._parse(DECLARES[opcode], content, length))
        elif opcode == Opcode.METADATA:
            found.metadata.append(self._parse(Metadata.read, content, length))
        elif opcode == Opcode.ATTACHMENT:
            found.attachments.append((content, length))
        elif opcode == Opcode.STATISTICS:
            self._statistics = statistics = self._parse(Statistics.read, content, length)
            found.lost += [
                f"it has {there} {what}, its statistics say {said}"
                for what, said, there in (
                    ("attachments", statistics.attachment_count, len(found.attachments)),
                    ("metadata records", statistics.metadata_count, len(found.metadata)),
                )
                if said != there
            ]
        elif opcode == Opcode.DATA_END:
            self._check_data(found, content)

    def _chunk(self, content: int, length: int) -> Block:
        _, _, uncompressed, crc, letters = unpack(_CHUNK, self._read(content, _CHUNK.size))
        if letters > 32 or length < _CHUNK.size + letters + 8:
            raise BagError(f"the chunk at byte {content} has no valid header")
        rest = self._read(content + _CHUNK.size, letters + 8)
        size = int.from_bytes(rest[letters:], "little")
        offset = content + _CHUNK.size + letters + 8
        if offset + size > content + length:
            raise BagError(f"the chunk at byte {content} is longer than its record")
        return Block(offset, size, rest[:letters].decode("utf-8", "replace"), uncompressed, crc)

    def _check_data(self, found: Contents, content: int) -> None:
        """Hold all before the end of the data against its checksum, where chunks have none."""
        stated = int.from_bytes(self._read(content, 4), "little")
        if not stated or all(self._checksum(block) for block in found.blocks):
            return
        crc, end = 0, content - RECORD.size
        for at in range(0, end, SEARCH_BYTES):
            crc = zlib.crc32(self._read(at, min(SEARCH_BYTES, end - at)), crc)
        if crc != stated:
            raise BagError("messages or other records are damaged: the checksum of all differs")

    def _find_channels(self) -> None:
        """Look into the blocks for channels the rest of the file does not list; count messages."""
        found = self.contents
        kept: list[Block] = []  # whole, and with a message, so that it has a time
        for block in found.blocks:
            try:
                counts, start_ns = self._declared_in(block)
            except BagError as error:
                if found.ending is None and not self._salvage:
                    raise
                found.lost.append(str(error))
                continue
            if counts:
                kept.append(replace(block, start_ns=start_ns))
            for channel_id, count in counts.items():
                found.counts[channel_id] = found.counts.get(channel_id, 0) + count
        found.blocks = kept
        if lost := found.counts.keys() - found.declared.channels.keys():
            if not self._salvage:
                raise BagError(f"messages on channel {min(lost)}, which nothing declares")
            found.lost += [f"{found.counts[c]} messages of unknown channel {c}" for c in lost]
        self._check_statistics()

    def _declared_in(self, block: Block) -> tuple[dict[int, int], int]:
        """Note the schemas and channels a block declares; each channel's messages, first time."""
        content = self.content(block)
        declared, walked = walk_chunk(content)
        for record in declared:
            self.contents.declared.add(record)
        where = f"the block at byte {block.offset}"
        starts = [
            int(messages_at(content, at, channel, where).log_ns.min())
            for channel, at in walked.items()
        ]
        return {channel: len(at) for channel, at in walked.items()}, min(starts, default=0)

    def _check_statistics(self) -> None:
        """Hold the finished file's own count of its messages against what is there."""
        if self._statistics is None:
            return
        found, total = self.contents, self._statistics.message_count
        stated = dict(self._statistics.channel_message_counts)
        there = sum(found.counts.values())
        if not stated and total not in (0, there):  # some writers state only how many there are
            what = f"it has {there} messages, its statistics say {total}"
            if not self._salvage:
                raise BagError(what)
            found.lost.append(what)
            return
        found.stated = stated if stated or not total else dict(found.counts)
        if found.ending is not None or self._salvage:
            return
        for channel, count in found.stated.items():
            there = found.counts.get(channel, 0)
            if there != count:
                raise BagError(
                    f"channel {channel} has {there} messages, the file's statistics say {count}"
                )

    def _parse(self, read: Callable[[Any], Record], content: int, length: int) -> Record:
        if length > MAX_RECORD_BYTES:
            raise BagError(f"a record of {length} bytes at byte {content}; refused")
        return parse(read, self._read(content, length))

    def _read(self, offset: int, size: int) -> bytes:
        """Bytes of the file; fewer at its end."""
        size = max(0, min(size, self._size - offset))
        if isinstance(self.path, RemotePath):
            return self.path.read_range(offset, offset + size)
        assert self._stream is not None
        return os.pread(self._stream.fileno(), size, offset)


def _add_loose(blocks: list[Block], at: int, end: int) -> None:
    """A message outside chunks: with those before it a block that reads like a chunk."""
    last = blocks[-1] if blocks else None
    if last is None or last.end != at or last.size > LOOSE_RUN_BYTES:
        blocks.append(Block(at, end - at, "", end - at))
        return
    size = end - last.offset
    blocks[-1] = replace(last, size=size, uncompressed_size=size)


def summarised(read: Read, size: int) -> Contents | None:
    """What the summary of a file of `size` bytes says; None if it does not list everything.

    Raises BagError if the summary is damaged.
    """
    if size < len(MAGIC) + _FOOTER:
        return None
    tail_bytes = TAIL_BYTES if size > WHOLE_BYTES else size
    tail = read(size - tail_bytes, tail_bytes)
    opcode, length = RECORD.unpack_from(tail, len(tail) - _FOOTER)
    if not tail.endswith(MAGIC) or opcode != Opcode.FOOTER or length != 20:
        return None
    footer = parse(Footer.read, tail[len(tail) - _FOOTER + RECORD.size : len(tail) - len(MAGIC)])
    start, end = footer.summary_start, size - _FOOTER
    if not start:
        return None
    if not len(MAGIC) <= start <= end or end - start > MAX_SUMMARY_BYTES:
        raise BagError("the footer's summary offset is damaged")
    summary = read(start, end - start)
    crc = zlib.crc32(summary + read(end, RECORD.size + 16))
    if footer.summary_crc not in (0, crc):
        raise BagError("the summary is damaged: its checksum differs")
    found = Contents()
    records: dict[int, list[Any]] = {opcode: [] for opcode in READS}
    for opcode, at, record_end in walk_records(summary):
        if opcode in READS:
            records[opcode].append(_declared(opcode, summary[at + RECORD.size : record_end]))
    for declared in (*records[Opcode.SCHEMA], *records[Opcode.CHANNEL]):
        found.declared.add(declared)
    metadata: list[MetadataIndex] = records[Opcode.METADATA_INDEX]
    found.attachments = [
        (attached.offset + RECORD.size, attached.length - RECORD.size)
        for attached in records[Opcode.ATTACHMENT_INDEX]
    ]
    blocks = [_listed(chunk, start) for chunk in records[Opcode.CHUNK_INDEX]]
    found.blocks = sorted((b for b in blocks if b.index), key=lambda block: block.offset)
    for block in found.blocks:
        for channel, (_, length) in (block.index or {}).items():
            count = (length - INDEX.size) // INDEX_ENTRY.itemsize
            found.counts[channel] = found.counts.get(channel, 0) + count
    statistics: Statistics | None = next(reversed(records[Opcode.STATISTICS]), None)
    if statistics is None or not _lists_everything(found, len(metadata), statistics):
        return None
    found.stated = dict(statistics.channel_message_counts)
    places = [(m.offset, m.length) for m in metadata] + found.attachments
    if any(not len(MAGIC) <= offset <= offset + length <= start for offset, length in places):
        raise BagError("the summary names metadata or attachments outside the file")
    found.metadata += [
        parse(Metadata.read, read(m.offset, m.length)[RECORD.size :]) for m in metadata
    ]
    return found


def _lists_everything(found: Contents, metadata: int, statistics: Statistics) -> bool:
    """Whether the summary's lists add up to what its statistics count."""
    if any(block.end > after.record for block, after in pairwise(found.blocks)):
        return False
    if not all(map(found.declared.knows, found.counts)):
        return False
    said = statistics.attachment_count, statistics.metadata_count
    if said != (len(found.attachments), metadata):
        return False
    return Counter(found.counts) == Counter(statistics.channel_message_counts)


def _declared(opcode: int, content: bytes) -> Any:
    """A record; robots of a fleet declare the same schemas and channels in every bag."""
    known = opcode in DECLARES and len(content) <= KNOWN_BYTES
    return (_known if known else parse)(READS[opcode], content)


_known = lru_cache(maxsize=256)(parse)


def _listed(chunk: ChunkIndex, limit: int) -> Block:
    """The chunk of an index; BagError unless it lies before `limit`, with its message indexes."""
    record, letters = chunk.chunk_start_offset, len(chunk.compression.encode())
    offset = record + CHUNK_FIXED + letters
    data_end = record + chunk.chunk_length
    end = data_end + chunk.message_index_length
    if record < len(MAGIC) or end > limit or offset + chunk.compressed_size != data_end:
        raise BagError(f"the summary's chunk at byte {record} does not lie in the file")
    if not chunk.compression and chunk.uncompressed_size != chunk.compressed_size:
        raise BagError(
            f"the chunk at byte {record} has {chunk.compressed_size} bytes without compression, "
            f"and says {chunk.uncompressed_size}"
        )
    places = sorted(chunk.message_index_offsets.items(), key=lambda entry: entry[1])
    edges = [at for _, at in places] + [end]
    if places and (edges[0] < data_end or edges[-2] > end):
        raise BagError(f"the message indexes of the chunk at byte {record} are not behind it")
    return Block(
        offset,
        chunk.compressed_size,
        chunk.compression,
        chunk.uncompressed_size,
        start_ns=chunk.message_start_time,
        end_ns=chunk.message_end_time,
        index={c: (at, after - at) for (c, at), after in zip(places, edges[1:], strict=True)},
    )
