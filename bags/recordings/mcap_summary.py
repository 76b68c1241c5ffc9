"""What a finished MCAP file says of itself at its end: it is read first, so that nothing is walked.

The summary lists channels, counts and chunks, and where each chunk's message indexes are. It is
used if it lists everything; otherwise the file has to be walked.

Source: the MCAP specification, https://mcap.dev/spec.
"""

import zlib
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final

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
    CHUNK_FIXED,
    INDEX,
    INDEX_ENTRY,
    MAGIC,
    RECORD,
    Block,
    Contents,
    parse,
    walk_records,
)
from bags.recordings.remote import GAP_BYTES, TAIL_BYTES
from nlsid_core.errors import BagError

MAX_SUMMARY_BYTES: Final = 64 * 2**20  # of some 100 bytes a chunk
WHOLE_BYTES: Final = TAIL_BYTES + GAP_BYTES  # a file no longer than this is one request
KNOWN_BYTES: Final = 16 * 2**10  # of a declaration that is kept for other bags
_FOOTER: Final = RECORD.size + 20 + len(MAGIC)

READS: Final[dict[int, Callable[[Any], Any]]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
}
Read = Callable[[int, int], bytes]  # offset, bytes


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
    if footer.summary_crc:
        signed = summary + read(end, RECORD.size + 16)
        if zlib.crc32(signed) != footer.summary_crc:
            raise BagError("the summary is damaged: its checksum differs")
    found = Contents()
    records: dict[int, list[Any]] = {opcode: [] for opcode in READS}
    for opcode, at, record_end in walk_records(summary):
        if opcode in READS:
            content = summary[at + RECORD.size : record_end]
            records[opcode].append(_declared(opcode, content))
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
    for m in metadata:
        record = read(m.offset, m.length)
        found.metadata.append(parse(Metadata.read, record[RECORD.size :]))
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
    known = opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and len(content) <= KNOWN_BYTES
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
