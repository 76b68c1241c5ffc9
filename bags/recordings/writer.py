"""Write a bag: a rosbag2 folder of MCAP files, from messages that are already serialised."""

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Final

from mcap.records import Attachment, Metadata

from bags.recordings.definitions import Definition, standard_definition
from bags.recordings.description import TYPE_HASH, Topic, write_metadata
from bags.recordings.output import Reserve
from bags.recordings.part import Part, topic_like
from bags.recordings.quality import Profile
from bags.recordings.storage import Channel, Raw
from nlsid_core.errors import BagError

MAX_COUNT: Final = 2**32  # an MCAP file counts the messages of a topic in 32 bits
RESERVE: Final = ".reserve"  # the file in a growing bag that keeps room for its end


class BagWriter:
    """A bag being written: NAME/NAME.mcap and NAME/metadata.yaml.

    Normally everything is written to a temporary folder beside `path`, which gets its name when
    the bag is closed; leaving a `with` block by an exception removes it. With `in_place=True` the
    bag grows under its own name and whatever happens stays readable: a recorder that is killed
    loses only the messages after the last closed chunk (it has no metadata.yaml then), and one
    whose disk is full spends the room that was kept for the bag's end and says so in `full`. A
    killed process loses nothing of a closed chunk; a power cut may.

    `custom` is stored in the MCAP file and in metadata.yaml's `custom_data`. `close_chunk`, called
    from a timer, limits what a kill loses. `compression` of the chunks: zstd, lz4 or none.
    `split_bytes` and `split_seconds` (of log time) begin another file, NAME_0.mcap, NAME_1.mcap
    and so on, at the first message beyond them.

    Raises BagError if `path` exists or a setting makes no sense; OS errors pass through.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        custom: Mapping[str, str] | None = None,
        in_place: bool = False,
        compression: str = "zstd",
        split_bytes: int | None = None,
        split_seconds: float | None = None,
    ) -> None:
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self._topics: list[Topic] = []
        self._numbers: dict[str, int] = {}  # topic -> its place in `_topics`, of those not copied
        self._copies: dict[tuple[object, ...], int] = {}
        self._custom = dict(custom or {})
        self._compression = compression
        self._split_bytes = split_bytes
        self._split_ns = None if split_seconds is None else round(split_seconds * 1e9)
        self._in_place = in_place
        if self.path.exists():
            raise BagError(f"{self.path} exists already; name another bag or move it away")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if in_place:
            self._folder = self.path
            self._folder.mkdir()
        else:
            self._folder = Path(
                tempfile.mkdtemp(dir=self.path.parent, prefix=f".{self.path.name}.")
            )
            self._folder.chmod(0o755)
        self._reserve: Reserve | None = None
        self._parts: list[Part] = []
        try:
            self._reserve = Reserve(self._folder / RESERVE) if in_place else None
            self._open_part()
        except BaseException:
            shutil.rmtree(self._folder)
            raise

    @property
    def full(self) -> str:
        """Why the bag should be closed now, if the disk is full; otherwise empty."""
        return "" if self._reserve is None else self._reserve.spent

    def _open_part(self) -> None:
        split = self._split_bytes is not None or self._split_ns is not None
        number = f"_{len(self._parts)}" if split else ""
        part = Part(
            self._folder / f"{self.path.name}{number}.mcap",
            compression=self._compression,
            reserve=self._reserve,
        )
        self._parts.append(part)
        part.annotate(self._custom)
        for topic in self._topics:
            part.add_topic(topic)
        part.close_chunk()

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
        self._numbers[topic] = self._add(Topic(topic, msgtype, "cdr", schema, metadata, offered))

    def add_copy(self, channel: Channel, strand: object = 0) -> int:
        """Announce the topic of a channel of another bag; its number for `copy`.

        What is copied from channels of one `strand`, topic and definition is one channel again.
        """
        key = (strand, channel.topic, channel.msgtype, channel.encoding, channel.definition)
        if key not in self._copies:
            self._copies[key] = self._add(topic_like(channel))
        return self._copies[key]

    def _add(self, topic: Topic) -> int:
        self._parts[-1].add_topic(topic)
        self._topics.append(topic)
        self.counts.setdefault(topic.name, 0)
        return len(self._topics) - 1

    def keep(self, record: Metadata | Attachment) -> None:
        """Copy what is no message of another bag."""
        self._parts[-1].keep(record)

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
        count = self.counts[topic] if sequence is None else sequence % MAX_COUNT
        self._write(number, data, log_time_ns, publish_time_ns, count)

    def copy(self, number: int, raw: Raw) -> None:
        """Append a message of another bag, as it is, to what `add_copy` announced."""
        self._write(number, raw.data, raw.log_ns, raw.publish_ns, raw.sequence)

    def _write(self, number: int, data: bytes, log_ns: int, publish_ns: int, sequence: int) -> None:
        part = self._parts[-1]
        if self._is_full(part, log_ns):
            self._open_part()
            part.finish()
            part = self._parts[-1]
        part.write(number, data, log_ns, publish_ns, sequence)
        self.counts[self._topics[number].name] += 1

    def _is_full(self, part: Part, log_time_ns: int) -> bool:
        if part.first_ns is None:
            return False
        if self._split_bytes is not None and part.size >= self._split_bytes:
            return True
        return self._split_ns is not None and log_time_ns - part.first_ns >= self._split_ns

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add to the bag's own key-value pairs; the newest of those with one key counts."""
        self._custom.update(custom)
        self._parts[-1].annotate(custom)

    def close_chunk(self) -> None:
        """Hand everything written so far to the operating system as a complete chunk."""
        self._parts[-1].close_chunk()

    def close(self) -> None:
        """Finish the file, write metadata.yaml, give the folder its name; once.

        Where that fails (a full disk without a reserve), a bag in place stays what a killed
        recorder leaves: unfinished, all its closed chunks readable.
        """
        if self._parts[-1].closed:
            return
        try:
            if self._reserve is not None:
                self._reserve.release()
            for part in self._parts:
                if not part.closed:
                    part.finish()
            files = [part.description for part in self._parts]
            write_metadata(self._folder, files, self._topics, self._custom)
        except OSError:
            self.abandon()
            raise
        if not self._in_place:
            if self.path.exists():  # rename would replace an empty folder
                self.discard()
                raise BagError(f"{self.path} appeared while the bag was written; not replaced")
            self._folder.rename(self.path)

    def discard(self) -> None:
        """Remove what was written."""
        self.abandon()
        shutil.rmtree(self._folder)

    def abandon(self) -> None:
        """Let go of the files as they are: what a killed recorder leaves."""
        for part in self._parts:
            part.abandon()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None or self._in_place:
            self.close()
        else:
            self.discard()
