"""Write an MCAP file: messages gathered in chunks, and whole chunks of another file.

Schemas and channels stand before the chunk whose messages need them, so that a chunk holds messages
only and can be copied again. A chunk is written with its indexes at once, or not at all.

Source: the MCAP specification, https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Mapping
from typing import Any, Final

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from bags.recordings.mcap_file import Whole
from bags.recordings.mcap_records import (
    INDEX,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_FIXED,
    RECORD,
)
from bags.recordings.output import Output

CHUNK_BYTES: Final = 2**20
PACKING: Final = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "none": bytes}
_HEAD: Final = struct.Struct("<BQHIQQ")  # of a message's record, as MESSAGE
_FOOTER: Final = struct.Struct("<BQQQ")  # what the summary's checksum has of the footer


class McapWriter:
    """An MCAP file that grows in `output`; compression: one of PACKING. OS errors pass through.

    counts: messages of each channel.
    """

    def __init__(self, output: Output, compression: str) -> None:
        self.counts: dict[int, int] = {}
        self._output, self._compression = output, compression
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._declared = b""  # what the next chunk needs before it
        self._content = bytearray()
        self._entries: dict[int, list[tuple[int, int]]] = {}
        output.write(MAGIC + _record(Header("ros2", "nlsid")))

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first and the last log time in closed chunks; zeros without one."""
        first_ns = min((chunk.message_start_time for chunk in self._chunks), default=0)
        return first_ns, max((chunk.message_end_time for chunk in self._chunks), default=0)

    def declare(self, record: Schema | Channel) -> None:
        """Declare a schema, or a channel."""
        if isinstance(record, Schema):
            self._schemas.append(record)
        else:
            self._channels.append(record)
            self.counts[record.id] = 0
        self._declared += _record(record)

    def add(self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        """Append a message to the chunk at hand."""
        size = MESSAGE_FIXED + len(data)
        head = _HEAD.pack(Opcode.MESSAGE, size, channel, sequence, log_ns, publish_ns)
        self._entries.setdefault(channel, []).append((log_ns, len(self._content)))
        self.counts[channel] += 1
        self._content += head
        self._content += data
        if len(self._content) > CHUNK_BYTES:
            self.close_chunk()

    def close_chunk(self) -> None:
        """Write the chunk at hand."""
        if not self._entries:
            return
        entries = {c: np.array(found, INDEX_ENTRY) for c, found in self._entries.items()}
        times = np.concatenate([found["log"] for found in entries.values()])
        content = bytes(self._content)
        chunk = Chunk(
            compression="" if self._compression == "none" else self._compression,
            data=PACKING[self._compression](content),
            message_end_time=int(np.max(times)),
            message_start_time=int(np.min(times)),
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        self._content, self._entries = bytearray(), {}
        self._put(chunk, entries)

    def copy_chunk(self, whole: Whole) -> None:
        """Append a whole chunk of another file, whose channels have the same numbers here."""
        self.close_chunk()
        entries = {}
        for channel, batch in whole.messages.items():
            at = batch.start - MESSAGE.itemsize
            entries[channel] = np.rec.fromarrays([batch.log_ns, at], INDEX_ENTRY)
            self.counts[channel] += len(batch)
        self._put(whole.chunk, entries)

    def _put(self, chunk: Chunk, entries: Mapping[int, Any]) -> None:
        content, indexes = _record(chunk), b""
        start = self._output.size + len(self._declared)
        places = {}
        for channel, found in entries.items():
            places[channel] = start + len(content) + len(indexes)
            length = INDEX.size - RECORD.size + found.nbytes
            indexes += INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, found.nbytes)
            indexes += found.tobytes()
        self._output.write(self._declared + content + indexes)
        self._declared = b""
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(content),
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(indexes),
                message_index_offsets=places,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def keep(self, record: Metadata | Attachment) -> None:
        """Append what is no message."""
        content, at = _record(record), self._output.size
        self._output.write(content)
        if isinstance(record, Metadata):
            self._metadata.append(MetadataIndex(at, len(content), record.name))
            return
        self._attachments.append(
            AttachmentIndex(
                offset=at,
                length=len(content),
                log_time=record.log_time,
                create_time=record.create_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            )
        )

    def finish(self) -> None:
        """Write the chunk at hand, the summary and the end of the file."""
        self.close_chunk()
        self._output.write(self._declared + _record(DataEnd(0)))
        first_ns, last_ns = self.span_ns
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={c: count for c, count in self.counts.items() if count},
            chunk_count=len(self._chunks),
            message_count=sum(self.counts.values()),
            message_end_time=last_ns,
            message_start_time=first_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        records = [*self._schemas, *self._channels, statistics]
        records += [*self._chunks, *self._attachments, *self._metadata]
        start, summary = self._output.size, b"".join(map(_record, records))
        crc = zlib.crc32(summary + _FOOTER.pack(Opcode.FOOTER, 20, start, 0))
        self._output.write(summary + _record(Footer(start, 0, crc)) + MAGIC)


def _record(record: McapRecord) -> bytes:
    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
