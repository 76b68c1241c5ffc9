"""A .db3 file, rosbag2's SQLite storage, as blocks of messages.

It is opened by SQLite itself. Where a recorder was killed, the newest messages are in a -wal file
beside it, or half a transaction is in a -journal: then a copy of both is opened, because SQLite
merges them when it opens a file, and a bag is never changed by reading it.
"""

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from urllib.parse import quote

from mcap.records import Channel, Metadata, Schema

from bags.recordings.batch import BATCH_BYTES, Batch, joined
from bags.recordings.description import TYPE_HASH
from bags.recordings.mcap_records import ROSBAG2, Block, Contents
from bags.recordings.quality import KEY
from nlsid_core.errors import BagError

BESIDE: Final = ("-wal", "-journal")
COUNTED_TOGETHER: Final = 16  # messages: SQLite adds up what so many have
OLD_RELEASE: Final = "galactic"  # which, like those before it, names no release in its files


class SqliteFile:
    """A .db3 file open for reading. Close it.

    Raises BagError if it is damaged; with `salvage=True` what cannot be read is listed in
    `contents.lost`.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self.path = path
        self.contents = Contents()
        self._salvage = salvage
        self._folder: TemporaryDirectory[str] | None = None
        beside = [Path(f"{path}{end}") for end in BESIDE]
        beside = [file for file in beside if file.is_file() and file.stat().st_size]
        address = f"file:{quote(str(path.resolve()))}?immutable=1"
        if beside:
            self._folder = TemporaryDirectory()
            for file in (path, *beside):
                shutil.copy(file, self._folder.name)
            address = f"file:{quote(str(Path(self._folder.name) / path.name))}"
        self._base = sqlite3.connect(address, uri=True)
        try:
            self._look_into(beside)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file, and remove its copy."""
        self._base.close()
        if self._folder is not None:
            self._folder.cleanup()

    def block_batches(self, block: Block, channels: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """The messages of one block, one batch per channel that has any."""
        if not any(channel in (block.index or {}) for channel in channels):
            return
        rows: dict[int, list[tuple[int, bytes]]] = {}
        query = (
            "SELECT topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ? ORDER BY id"
        )
        try:
            for topic, log_ns, data in self._base.execute(query, (block.offset, block.end)):
                if not isinstance(data, bytes) or not 0 <= log_ns < 2**63:
                    raise BagError(f"a message on topic {topic} with log time {log_ns} ns")
                rows.setdefault(topic, []).append((log_ns, data))
        except (sqlite3.Error, BagError) as error:
            if not self._salvage:
                raise
            self.contents.lost.append(f"messages {block.offset} to {block.end - 1}: {error}")
        for topic in channels:
            if found := rows.get(topic):
                times, parts = zip(*found, strict=True)
                yield topic, joined(parts, times)

    def _look_into(self, beside: list[Path]) -> None:
        if beside and self._rows("PRAGMA wal_checkpoint")[0][1] == 0:
            names = " and ".join(file.name for file in beside)
            self.contents.lost.append(f"nothing in {names} belongs to this file")
        for table in ("topics", "messages"):
            if not self._columns(table):
                raise BagError(f"it has no table of {table}")
        release = OLD_RELEASE
        if "ros_distro" in self._columns("schema"):
            release = str(next(iter(self._rows("SELECT ros_distro FROM schema")), ("",))[0])
        self.contents.metadata.append(Metadata(ROSBAG2, {"ROS_DISTRO": release}))
        self._add_channels()
        try:
            self._add_blocks()
        except sqlite3.Error as error:
            if not self._salvage:
                raise
            self.contents.lost.append(str(error))

    def _add_channels(self) -> None:
        definitions: dict[str, tuple[str, str]] = {}
        if self._columns("message_definitions"):
            for name, encoding, text in self._rows(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions[str(name)] = str(encoding), str(text)
        columns = self._columns("topics")
        for row in self._rows("SELECT * FROM topics ORDER BY id"):
            topic = {column: str(value) for column, value in zip(columns, row, strict=True)}
            number, kind = int(topic["id"]), topic["type"]
            encoding, text = definitions.get(kind, ("", ""))
            self.contents.schemas[number] = Schema(number, text.encode(), encoding, kind)
            said = {
                KEY: topic.get("offered_qos_profiles", ""),
                TYPE_HASH: topic.get("type_description_hash", ""),
            }
            self.contents.channels[number] = Channel(
                number, topic["name"], topic["serialization_format"], said, number
            )

    def _add_blocks(self) -> None:
        """Runs of messages with about BATCH_BYTES, and how many each topic has in each."""
        query = (
            "SELECT min(id), max(id), topic_id, count(*), min(timestamp), sum(length(data)) "
            f"FROM messages GROUP BY id / {COUNTED_TOGETHER}, topic_id ORDER BY 1"
        )
        found, size = self.contents, BATCH_BYTES
        for first, last, topic, count, start_ns, length in self._base.execute(query):
            if topic not in found.channels:
                if not self._salvage:
                    raise BagError(f"messages on topic {topic}, which nothing declares")
                found.lost.append(f"{count} messages of unknown topic {topic}")
                continue
            if size >= BATCH_BYTES and not (found.blocks and first < found.blocks[-1].end):
                found.blocks.append(Block(first, 0, start_ns=start_ns, index={}))
                size = 0
            block = found.blocks[-1]
            index = {**(block.index or {})}
            index[topic] = 0, index.get(topic, (0, 0))[1] + count
            found.blocks[-1] = Block(
                block.offset,
                max(block.end, last + 1) - block.offset,
                start_ns=min(block.start_ns, start_ns),
                index=index,
            )
            found.counts[topic] = found.counts.get(topic, 0) + count
            size += length

    def _columns(self, table: str) -> list[str]:
        return [row[1] for row in self._rows(f"PRAGMA table_info({table})")]

    def _rows(self, query: str) -> list[Any]:
        return self._base.execute(query).fetchall()
