"""Write a bag: a rosbag2 folder of one MCAP file, from messages that are already serialised.

In the file, schemas and channels stand before the chunk whose messages need them, so that a chunk
holds messages only and can be copied again. A chunk is written with its indexes at once, or not at
all.

Source: the MCAP specification, https://mcap.dev/spec.
"""

import fcntl
import os
import shutil
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import lz4.frame
import numpy as np
import yaml
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from bags.recordings.definitions import Definition, standard_definition
from bags.recordings.folders import METADATA, NEWEST_VERSION
from bags.recordings.mcap_file import Whole
from bags.recordings.mcap_records import (
    CUSTOM_DATA,
    INDEX,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_FIXED,
    RECORD,
)
from bags.recordings.quality import KEY, TYPE_HASH, Profile, offered_text
from bags.recordings.storage import Channel
from nlsid_core.errors import BagError
from nlsid_core.files import write_atomically

CHUNK_BYTES: Final = 2**20
PACKING: Final = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "none": bytes}
_HEAD: Final = struct.Struct("<BQHIQQ")  # of a message's record, as MESSAGE
_FOOTER: Final = struct.Struct("<BQQQ")  # what the summary's checksum has of the footer

MOST_CHANNELS: Final = 2**16
MAX_COUNT: Final = 2**32  # an MCAP file counts the messages of a topic in 32 bits


def refuse_existing(path: Path) -> None:
    """Raise a BagError if something is at `path`."""
    if path.exists():
        raise BagError(f"{path} exists already; take another name or move it away")


class Output:
    """A new file that other processes see locked while it is open. `size`: bytes written.

    A write that fails leaves nothing of itself behind.
    """

    def __init__(self, path: Path) -> None:
        self.size = 0
        self._path = path
        self._stream = path.open("xb", buffering=0)
        fcntl.flock(self._stream, fcntl.LOCK_EX)  # whoever repairs bags leaves this one alone

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._stream.closed

    def write(self, data: bytes) -> None:
        """Append `data`; OSError if there is no room."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._stream.write(rest) :]
        except OSError:
            self._stream.truncate(self.size)
            self._stream.seek(self.size)
            raise
        self.size += len(data)

    def refuse_loss(self) -> None:
        """OSError unless the file is still there under its name, with all that was written."""
        ours, there = os.fstat(self._stream.fileno()), self._path.stat()
        if not os.path.samestat(ours, there) or there.st_size != self.size:
            raise OSError(f"{self._path} was replaced or cut by another program")

    def sync(self) -> None:
        """Wait until the bytes are on the disk; OSError as `refuse_loss`."""
        self.refuse_loss()
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Close and unlock the file."""
        self._stream.close()


class BagWriter:
    """A bag being written: NAME/NAME.mcap in compressed chunks, and NAME/metadata.yaml.

    It grows under its own name, and whatever happens stays readable: a recorder that is killed, or
    whose disk is full, loses only the messages after the last closed chunk (it has no metadata.yaml
    then). A killed process loses nothing of a closed chunk; a power cut may. Leaving a `with` block
    by an exception removes the bag. `whole_bag` writes one that has its name only when it is whole.

    `custom` is stored in the MCAP file and in metadata.yaml's `custom_data`. `close_chunk`, called
    from a timer, limits what a kill loses. `mcap` takes what is copied as it is.

    Raises BagError if `path` exists; OS errors pass through.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        custom: Mapping[str, str] | None = None,
        compression: str = "zstd",
    ) -> None:
        self.path = Path(path)
        self._topics: dict[int, Channel] = {}  # by the numbers of their channels in the file
        self._numbers: dict[str, int] = {}  # topic -> its channel, of those not copied
        self._copies: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, tuple[str, bytes]], int] = {}
        self._custom: dict[str, str] = {}
        if compression not in PACKING:
            raise BagError(f"no compression '{compression}'; there are: {', '.join(PACKING)}")
        refuse_existing(self.path)
        self.path.mkdir(parents=True)
        try:
            self._output = Output(self.path / f"{self.path.name}.mcap")
            self.mcap = McapWriter(self._output, compression)
            self.annotate(custom or {})
        except BaseException:
            shutil.rmtree(self.path)
            raise

    @property
    def size(self) -> int:
        """Bytes written so far, but for the chunk at hand."""
        return self._output.size

    @property
    def counts(self) -> dict[str, int]:
        """Messages of each topic."""
        found: dict[str, int] = {}
        for number, channel in self._topics.items():
            found[channel.topic] = found.get(channel.topic, 0) + self.mcap.counts[number]
        return found

    def add_topic(
        self,
        topic: str,
        msgtype: str,
        *,
        definition: Definition | None = None,
        offered: tuple[Profile, ...] = (),
    ) -> None:
        """Announce a topic, so that the bag lists it even if no message comes.

        `definition`: what defines its type; without it the type is a standard one. `offered`: the
        quality of service of its publishers. Raises BagError for a type that is not known and for a
        second type on one topic.
        """
        if topic in self._numbers:
            known = self._topics[self._numbers[topic]].msgtype
            if known != msgtype:
                raise BagError(
                    f"{self.path}: {topic} holds '{known}', not '{msgtype}'; a topic has one type"
                )
            return
        defined = definition or standard_definition(msgtype)
        metadata = {TYPE_HASH: defined.type_hash}
        schema = ("ros2msg", defined.text.encode())
        channel = Channel(0, topic, msgtype, "cdr", schema, metadata=metadata, offered=offered)
        self._numbers[topic] = self._add(channel, len(self._topics) + 1)

    def add_copy(self, channel: Channel, strand: object, number: int) -> int:
        """Announce the topic of a channel of another bag; its number for `mcap.add`.

        What is copied from channels of one `strand`, topic and definition is one channel again.
        number: which it has there; it keeps it if no other has it here.
        """
        key = (strand, channel.topic, channel.msgtype, channel.encoding, channel.schema)
        if key not in self._copies:
            if channel.schema == ("", b"") and channel.encoding == "cdr":
                with suppress(BagError):  # no standard type either: copied without a definition
                    text = standard_definition(channel.msgtype).text
                    channel = replace(channel, schema=("ros2msg", text.encode()))
            self._copies[key] = self._add(channel, number)
        return self._copies[key]

    def _add(self, channel: Channel, wanted: int) -> int:
        key = (channel.msgtype, channel.schema)
        if key not in self._schemas:
            encoding, content = channel.schema
            self._schemas[key] = len(self._schemas) + 1
            self.mcap.declare(
                records.Schema(self._schemas[key], content, encoding, channel.msgtype)
            )
        notes = {**channel.metadata, KEY: offered_text(channel.offered)}
        numbers = chain([wanted], range(1, MOST_CHANNELS))
        number = next(n for n in numbers if n not in self._topics)
        self.mcap.declare(
            records.Channel(number, channel.topic, channel.encoding, notes, self._schemas[key])
        )
        self._topics[number] = channel
        return number

    def write(
        self,
        topic: str,
        msgtype: str,
        data: bytes,
        *,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int | None = None,
    ) -> None:
        """Append one serialised (CDR) message; times are ns since the epoch.

        sequence: the publisher's count (None: the place on the topic). Raises BagError as
        `add_topic`, and for a time that is negative or beyond 64 bits.
        """
        if not (0 <= log_time_ns < 2**63 and 0 <= publish_time_ns < 2**63):
            raise BagError(f"{self.path}: {topic}: times {log_time_ns}, {publish_time_ns} ns")
        self.add_topic(topic, msgtype)
        number = self._numbers[topic]
        count = self.mcap.counts[number] if sequence is None else sequence % MAX_COUNT
        self.mcap.add(number, log_time_ns, publish_time_ns, count, data)

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add to the bag's own key-value pairs; the newest of those with one key counts."""
        self._custom.update(custom)
        if custom:
            self.mcap.keep(records.Metadata(CUSTOM_DATA, dict(custom)))

    def close_chunk(self) -> None:
        """Hand everything written so far to the operating system as a complete chunk."""
        self.mcap.close_chunk()
        self._output.refuse_loss()

    def close(self) -> None:
        """Finish the file and write metadata.yaml; once.

        Where that fails (a full disk), the bag stays what a killed recorder leaves: unfinished, all
        its closed chunks readable.
        """
        if self._output.closed:
            return
        try:
            self.mcap.finish()
            self._output.sync()
            self._output.close()
            _write_metadata(
                self.path,
                f"{self.path.name}.mcap",
                self._topics.values(),
                self.counts,
                self._custom,
                self.mcap.span_ns,
            )
        except OSError:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Let go of the file as it is: what a killed recorder leaves."""
        self._output.close()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
            return
        self.abandon()
        shutil.rmtree(self.path)


@contextmanager
def whole_bag(path: Path | str, *, custom: Mapping[str, str] | None = None) -> Iterator[BagWriter]:
    """A bag that gets its name when it is whole; nothing is left of it after an error.

    Raises BagError if something is at `path`; OS errors pass through.
    """
    path = Path(path)
    refuse_existing(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        with BagWriter(Path(folder) / path.name, custom=custom) as writer:
            yield writer
        refuse_existing(path)  # rename would replace an empty folder
        writer.path.rename(path)


class McapWriter:
    """An MCAP file that grows in `output`; compression: one of PACKING. OS errors pass through.

    counts: messages of each channel.
    """

    def __init__(self, output: Output, compression: str) -> None:
        self.counts: dict[int, int] = {}
        self._output, self._compression = output, compression
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._declared = b""  # what the next chunk needs before it
        self._content = bytearray()
        self._entries: dict[int, list[tuple[int, int]]] = {}
        output.write(MAGIC + _record(records.Header("ros2", "nlsid")))

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first and the last log time in closed chunks; zeros without one."""
        first_ns = min((chunk.message_start_time for chunk in self._chunks), default=0)
        return first_ns, max((chunk.message_end_time for chunk in self._chunks), default=0)

    def declare(self, record: records.Schema | records.Channel) -> None:
        """Declare a schema, or a channel."""
        if isinstance(record, records.Schema):
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
        chunk = records.Chunk(
            compression="" if self._compression == "none" else self._compression,
            data=PACKING[self._compression](content),
            message_end_time=int(np.max(times)),
            message_start_time=int(np.min(times)),
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        self._put(chunk, entries)
        self._content, self._entries = bytearray(), {}  # where it cannot be written it is kept

    def copy_chunk(self, whole: Whole) -> None:
        """Append a whole chunk of another file, whose channels have the same numbers here."""
        self.close_chunk()
        entries = {}
        for channel, batch in whole.messages.items():
            at = batch.start - MESSAGE.itemsize
            entries[channel] = np.rec.fromarrays([batch.log_ns, at], INDEX_ENTRY)
            self.counts[channel] += len(batch)
        self._put(whole.chunk, entries)

    def _put(self, chunk: records.Chunk, entries: Mapping[int, Any]) -> None:
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
            records.ChunkIndex(
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

    def keep(self, record: records.Metadata | records.Attachment) -> None:
        """Append what is no message."""
        content, at = _record(record), self._output.size
        self._output.write(content)
        if isinstance(record, records.Metadata):
            self._metadata.append(records.MetadataIndex(at, len(content), record.name))
            return
        self._attachments.append(
            records.AttachmentIndex(
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
        self._output.write(self._declared + _record(records.DataEnd(0)))
        first_ns, last_ns = self.span_ns
        statistics = records.Statistics(
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
        listed = [*self._schemas, *self._channels, statistics]
        listed += [*self._chunks, *self._attachments, *self._metadata]
        start, summary = self._output.size, b"".join(map(_record, listed))
        crc = zlib.crc32(summary + _FOOTER.pack(Opcode.FOOTER, 20, start, 0))
        self._output.write(summary + _record(records.Footer(start, 0, crc)) + MAGIC)


def _record(record: records.McapRecord) -> bytes:
    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _write_metadata(
    folder: Path,
    file: str,
    topics: Iterable[Channel],
    counts: Mapping[str, int],
    custom: Mapping[str, str],
    span_ns: tuple[int, int],
) -> None:
    """Make the folder a finished bag of one file, as rosbag2 and rosbags read it.

    Of topics of one name the first is described. counts: messages by topic. span_ns: the first and
    the last log time, 0 without a message.
    """
    named: dict[str, Channel] = {}
    for topic in topics:
        named.setdefault(topic.topic, topic)
    first_ns, last_ns = span_ns
    extent = {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": sum(counts.values()),
    }
    information = {
        "version": NEWEST_VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file],
        **extent,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": topic.msgtype,
                    "serialization_format": topic.encoding,
                    KEY: [profile.document() for profile in topic.offered],
                    "type_description_hash": topic.metadata.get(TYPE_HASH, ""),
                },
                "message_count": counts[name],
            }
            for name, topic in named.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file, **extent}],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }
    document = {"rosbag2_bagfile_information": information}
    text = yaml.safe_dump(document, sort_keys=False, width=4096)  # a value stays on its line
    write_atomically(folder / METADATA, text.encode())
