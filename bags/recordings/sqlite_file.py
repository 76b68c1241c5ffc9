"""A .db3 file, rosbag2's SQLite storage, as blocks of messages.

It is opened by SQLite itself. Where a recorder was killed, the newest messages are in a -wal file
beside it, or half a transaction is in a -journal: then a copy of both is opened, because SQLite
merges them when it opens a file, and a bag is never changed by reading it.
"""

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from urllib.parse import quote

from mcap.records import Channel, Metadata, Schema

from bags.recordings.batch import BATCH_BYTES, Batch, joined
from bags.recordings.mcap_records import ROSBAG2, Block, Contents
from bags.recordings.quality import KEY, TYPE_HASH
from nlsid_core.errors import BagError

BESIDE: Final = ("-wal", "-journal")
SALVAGED_BYTES: Final = 2**13  # of messages that are lost together where a page is damaged
WAL_HEADER, WAL_PAGE_HEADER = 32, 24  # bytes, by the format of SQLite's files
IS_MESSAGE: Final = "(typeof(timestamp) = 'integer' AND timestamp >= 0 AND typeof(data) = 'blob')"
ROWS: Final = (
    "SELECT topic_id, timestamp, data FROM messages "
    f"WHERE id BETWEEN ? AND ? AND {IS_MESSAGE} ORDER BY id"
)
COUNTS: Final = (
    f"SELECT topic_id, sum({IS_MESSAGE}), min(CASE WHEN {IS_MESSAGE} THEN timestamp END), "
    f"sum(NOT {IS_MESSAGE}) FROM messages WHERE id BETWEEN ? AND ? GROUP BY topic_id"
)
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
        missing = _stated_bytes(path) - path.stat().st_size if salvage else 0
        if beside or missing > 0:
            self._folder = TemporaryDirectory()
            for file in (path, *beside):
                shutil.copy(file, self._folder.name)
            copy = Path(self._folder.name) / path.name
            address = f"file:{quote(str(copy))}"
            if missing > 0:  # SQLite refuses a file that is shorter than it says
                self.contents.lost.append(f"its last {missing} bytes are not there")
                os.truncate(copy, path.stat().st_size + missing)
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
        if not block.has(channels):
            return
        rows: dict[int, list[tuple[int, bytes]]] = {}
        try:
            for topic, log_ns, data in self._base.execute(ROWS, (block.offset, block.end - 1)):
                rows.setdefault(topic, []).append((log_ns, data))
        except sqlite3.Error as error:
            if not self._salvage:
                raise
            self.contents.lost.append(f"messages {block.offset} to {block.end - 1}: {error}")
        for topic in channels:
            if found := rows.get(topic):
                times, parts = zip(*found, strict=True)
                yield topic, joined(parts, times)

    def _look_into(self, beside: list[Path]) -> None:
        if beside:
            pages = self._rows("PRAGMA wal_checkpoint")[0][1]
            names = " and ".join(file.name for file in beside)
            if pages == 0:
                self.contents.lost.append(f"nothing in {names} belongs to this file")
            elif lost := sum(map(_pages_in_wal, beside)) - pages:
                self.contents.lost.append(
                    f"the last {lost} pages in {names} are damaged or were not written to their end"
                )
        tables = self._rows("SELECT name FROM sqlite_master WHERE type = 'table'")
        if not {("topics",), ("messages",)} <= set(tables):
            raise BagError("it has no tables of topics and messages")
        release = OLD_RELEASE
        if "ros_distro" in self._columns("schema"):
            release = str(next(iter(self._rows("SELECT ros_distro FROM schema")), ("",))[0])
        self.contents.metadata.append(Metadata(ROSBAG2, {"ROS_DISTRO": release}))
        self._add_channels()
        self._add_blocks()

    def _add_channels(self) -> None:
        definitions: dict[str, tuple[str, str]] = {}
        if self._columns("message_definitions"):
            rows = (
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            definitions = {
                str(name): (str(form), str(text)) for name, form, text in self._rows(rows)
            }
        columns = self._columns("topics")
        for row in self._rows("SELECT * FROM topics ORDER BY id"):
            topic = {column: str(value) for column, value in zip(columns, row, strict=True)}
            number, kind = int(topic["id"]), topic["type"]
            encoding, text = definitions.get(kind, ("", ""))
            self.contents.declared.schemas[number] = Schema(number, text.encode(), encoding, kind)
            said = {
                KEY: topic.get("offered_qos_profiles", ""),
                TYPE_HASH: topic.get("type_description_hash", ""),
            }
            self.contents.declared.channels[number] = Channel(
                number, topic["name"], topic["serialization_format"], said, number
            )

    def _add_blocks(self) -> None:
        """Runs of messages by their ids, each of about BATCH_BYTES if they are of one size."""
        first, last = self._ids()
        most = SALVAGED_BYTES if self._salvage else BATCH_BYTES
        count = max(1, (last - first) * most // max(self.path.stat().st_size, 1))
        left_out = 0
        for begin in range(first, last + 1, count):
            try:
                found = self._base.execute(COUNTS, (begin, begin + count - 1)).fetchall()
            except sqlite3.Error as error:
                if not self._salvage:
                    raise
                self.contents.lost.append(f"messages {begin} to {begin + count - 1}: {error}")
                continue
            left_out += sum(bad for *_, bad in found)
            counts = Counter({topic: good for topic, good, _, _ in found if good})
            for topic in counts.keys() - self.contents.declared.channels.keys():
                self._lose(f"{counts.pop(topic)} messages of topic {topic}, which nothing declares")
            if counts:
                index = {topic: (0, good) for topic, good in counts.items()}
                start_ns = min(log_ns for _, good, log_ns, _ in found if good)
                self.contents.blocks.append(Block(begin, count, start_ns=start_ns, index=index))
                self.contents.counts = dict(Counter(self.contents.counts) + counts)
        if left_out:
            self._lose(f"{left_out} messages have no time or no data")

    def _ids(self) -> tuple[int, int]:
        """The first and the last id, as far as they can be read."""
        ends = []
        for order in ("ASC", "DESC"):
            try:
                for (end,) in self._base.execute(f"SELECT id FROM messages ORDER BY id {order}"):
                    ends.append(end)  # of a damaged file the last ones before the damage count
                    if not self._salvage:
                        break
            except sqlite3.Error:
                if not self._salvage:
                    raise
        return min(ends, default=0), max(ends, default=-1)

    def _lose(self, what: str) -> None:
        """Note a part that cannot be read; BagError unless the rest is to be salvaged."""
        if not self._salvage:
            raise BagError(what)
        self.contents.lost.append(what)

    def _columns(self, table: str) -> list[str]:
        return [row[1] for row in self._rows(f"PRAGMA table_info({table})")]

    def _rows(self, query: str) -> list[Any]:
        return self._base.execute(query).fetchall()


def _pages_in_wal(file: Path) -> int:
    """Pages that a -wal file holds of its newest round, as its header and theirs say."""
    content = file.read_bytes()
    if not file.name.endswith("-wal") or len(content) < WAL_HEADER:
        return 0
    size, salt = int.from_bytes(content[8:12], "big"), content[16:24]
    starts = range(WAL_HEADER, len(content), WAL_PAGE_HEADER + size)
    return sum(content[at + 8 : at + 16] == salt for at in starts)


def _stated_bytes(path: Path) -> int:
    """How long the file says it is, as SQLite's format puts it into its first bytes."""
    with path.open("rb") as stream:
        head = stream.read(32)
    page = int.from_bytes(head[16:18], "big")
    return (2**16 if page == 1 else page) * int.from_bytes(head[28:32], "big")
