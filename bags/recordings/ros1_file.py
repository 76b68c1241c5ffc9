"""A ROS 1 bag as blocks of messages, also one that was not closed.

The file is walked record by record from its start. Its index is not needed: chunks say how many
messages of each connection they have, and the last chunk of a killed recorder is looked into.

Source: the ROS bag format, version 2.0, http://wiki.ros.org/Bags/Format/2.0.
"""

import bz2
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

import lz4.frame
import numpy as np
from mcap.records import Channel, Schema
from rosbags.rosbag1.reader import Header, ReaderError, read_uint32

from bags.recordings.batch import Batch, batch_of
from bags.recordings.mcap_records import MAX_CHUNK_BYTES, Block, Contents, rest_said
from bags.recordings.quality import KEY, LATCHED, offered_text
from nlsid_core.errors import BagError

ROS1_MAGIC: Final = b"#ROSBAG V2.0\n"
MESSAGE, HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
LOOSE: Final = ""  # the compression of messages outside chunks
_INDEX_ENTRY: Final = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("offset", "<u4")])


class Ros1File:
    """A ROS 1 bag open for reading. Close it.

    Raises BagError if a record is damaged; one that was not closed opens, and says so in
    `contents.ending`. With `salvage=True` damaged chunks are left out and listed in
    `contents.lost`.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self.path = path
        self.contents = Contents()
        self._salvage = salvage
        self._size = path.stat().st_size
        self._stream = path.open("rb")
        try:
            self._walk()
            self._look_into_chunks()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def block_batches(self, block: Block, channels: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """The messages of one block, one batch per channel that has any."""
        if not block.has(channels):
            return
        content = self._unpacked(block)
        found = self._messages(content)
        counts = {number: len(places) for number, places in found.items()}
        if counts != {number: count for number, (_, count) in (block.index or {}).items() if count}:
            raise BagError(f"the chunk at byte {block.offset} does not hold what its index says")
        for channel in channels:
            if channel in found:
                start, size, log_ns = np.array(found[channel], np.int64).T
                yield channel, batch_of(content, start, size, log_ns)

    def _read(self, start: int, end: int) -> bytes:
        self._stream.seek(start)
        return self._stream.read(end - start)

    def _walk(self) -> None:
        found = self.contents
        header = Header()
        good_bytes = len(ROS1_MAGIC)
        try:
            self._stream.seek(good_bytes)
            for fields, start, end in _records(self._stream, self._size):
                kind = fields.get_uint8("op")
                if kind == HEADER:
                    header = fields
                elif kind == CONNECTION:
                    self._add_connection(fields, self._read(start, end))
                elif kind == CHUNK:
                    compression = fields.get("compression", b"").decode("utf-8", "replace")
                    size = fields.get_uint32("size")
                    found.blocks.append(Block(start, end - start, compression, size))
                elif kind == INDEX:
                    self._add_index(fields, start, end)
                elif kind == MESSAGE:
                    self._add_loose(good_bytes, end)
                good_bytes = end
        except (BagError, ReaderError) as error:
            found.ending = str(error)
        if header.get("encryptor"):
            raise BagError("it is encrypted")
        if found.ending is None and not header.get("index_pos", b"").strip(b"\0"):
            found.ending = "it was not closed: it has no index"
        chunks = sum(block.compression != LOOSE for block in found.blocks)
        if found.ending is None and chunks != header.get_uint32("chunk_count"):
            found.ending = f"it has {chunks} chunks, and says another number at its start"
        if found.ending is not None:
            found.ending += rest_said(self._size - good_bytes)

    def _add_loose(self, start: int, end: int) -> None:
        """A message outside chunks: of the chunk in which a recorder was killed."""
        last = self.contents.blocks[-1] if self.contents.blocks else None
        if last is not None and last.compression == LOOSE and last.end == start:
            self.contents.blocks[-1] = replace(last, size=end - last.offset)
        else:
            self.contents.blocks.append(Block(start, end - start, LOOSE, end - start))

    def _add_connection(self, fields: Header, data: bytes) -> None:
        number = fields.get_uint32("conn")
        said = Header.read(BytesIO(struct.pack("<I", len(data)) + data))
        topic = fields.get("topic", b"").decode("utf-8", "replace")
        kind = said.get("type", b"").decode("utf-8", "replace")
        profiles = {KEY: offered_text([LATCHED])} if said.get("latching") == b"1" else {}
        schema = Schema(number, said.get("message_definition", b""), "ros1msg", kind)
        declared = self.contents.declared
        declared.schemas.setdefault(number, schema)
        declared.channels.setdefault(number, Channel(number, topic, "ros1", profiles, number))

    def _add_index(self, fields: Header, start: int, end: int) -> None:
        count = fields.get_uint32("count")
        if not self.contents.blocks or count * _INDEX_ENTRY.itemsize != end - start:
            raise BagError(f"the index at byte {start} is damaged")
        entries = np.frombuffer(self._read(start, end), _INDEX_ENTRY)
        block = self.contents.blocks[-1]
        times = entries["seconds"].astype(np.int64) * 10**9 + entries["nanoseconds"]
        first_ns = int(times.min()) if count else block.start_ns
        self.contents.blocks[-1] = replace(
            block,
            start_ns=min(block.start_ns, first_ns) if block.index else first_ns,
            index={**(block.index or {}), fields.get_uint32("conn"): (start, count)},
        )

    def _look_into_chunks(self) -> None:
        """Find what chunks without an index, or of connections not told yet, declare and hold."""
        found, kept = self.contents, []
        found.stated = None if found.ending else _counts(found.blocks)
        for block in found.blocks:
            told = block.index is not None and block.index.keys() <= found.declared.channels.keys()
            try:
                kept.append(block if told and not self._salvage else self._indexed(block))
            except (BagError, ReaderError) as error:
                if not self._salvage and found.ending is None:
                    raise
                found.lost.append(str(error))
        found.blocks = kept
        found.counts = _counts(kept)
        for number in found.counts.keys() - found.declared.channels.keys():
            if not self._salvage:
                raise BagError(f"messages of connection {number}, which nothing declares")
            found.lost.append(f"{found.counts.pop(number)} messages of unknown connection {number}")

    def _indexed(self, block: Block) -> Block:
        found = self._messages(self._unpacked(block))
        times = [log_ns for places in found.values() for *_, log_ns in places]
        index = {number: (0, len(places)) for number, places in found.items()}
        return replace(block, start_ns=min(times, default=0), index=index)

    def _messages(self, content: bytes) -> dict[int, list[tuple[int, int, int]]]:
        """(start, bytes, log time in ns) of each connection's messages; notes who is declared."""
        found: dict[int, list[tuple[int, int, int]]] = {}
        for fields, start, end in _records(BytesIO(content), len(content)):
            if fields.get_uint8("op") == CONNECTION:
                self._add_connection(fields, content[start:end])
            elif fields.get_uint8("op") == MESSAGE:
                place = start, end - start, fields.get_time("time")
                found.setdefault(fields.get_uint32("conn"), []).append(place)
        return found

    def _unpacked(self, block: Block) -> bytes:
        where, size = f"the chunk at byte {block.offset}", block.uncompressed_size
        if size > MAX_CHUNK_BYTES:
            raise BagError(f"{where} unpacks to {size} bytes; at most {MAX_CHUNK_BYTES} are read")
        raw = self._read(block.offset, block.end)
        if block.compression in (LOOSE, "none"):
            return raw
        decompressors = {"bz2": bz2.BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor}
        if block.compression not in decompressors:
            raise BagError(f"{where} is compressed by '{block.compression}'; known are bz2 and lz4")
        try:
            content: bytes = decompressors[block.compression]().decompress(raw, max_length=size + 1)
        except (OSError, EOFError, RuntimeError) as error:
            raise BagError(f"{where} cannot be decompressed: {error}") from error
        if len(content) != size:
            raise BagError(f"{where} holds {len(content)} bytes, its header says {size}")
        return content


def _counts(blocks: Sequence[Block]) -> dict[int, int]:
    """Messages of each connection, as the blocks' indexes say."""
    found: Counter[int] = Counter()
    for block in blocks:
        found.update({number: count for number, (_, count) in (block.index or {}).items()})
    return dict(found)


def _records(stream: BinaryIO, end: int) -> Iterator[tuple[Header, int, int]]:
    """(header, first byte of the data, their end) of each record; BagError if one is cut."""
    while (at := stream.tell()) < end:
        try:
            header = Header.read(stream)
            start = stream.tell() + 4
            last = start + read_uint32(stream)
        except ReaderError as error:
            raise BagError(f"what starts at byte {at} runs past the end") from error
        if last > end:
            raise BagError(f"what starts at byte {at} runs past the end")
        yield header, start, last
        stream.seek(last)
