"""Write a bag: a rosbag2 folder of one MCAP file, from messages that are already serialised."""

import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import MessageDefinitionFormat

from bags.recordings.definitions import Definition, standard_definition
from bags.recordings.description import TYPE_HASH, Topic, write_metadata
from bags.recordings.mcap_records import CUSTOM_DATA
from bags.recordings.output import Output, Reserve
from bags.recordings.quality import KEY, Profile, offered_text
from bags.recordings.storage import FORMATS, Channel, Raw
from nlsid_core.errors import BagError

MAX_COUNT: Final = 2**32  # an MCAP file counts the messages of a topic in 32 bits
RESERVE: Final = ".reserve"  # the file in a growing bag that keeps room for its end
SCHEMA_ENCODINGS: Final = {format: name for name, format in FORMATS.items()}
CHUNK_BYTES: Final = 2**20


def refuse_existing(path: Path) -> None:
    """Raise a BagError if something is at `path`."""
    if path.exists():
        raise BagError(f"{path} exists already; take another name or move it away")


def topic_like(channel: Channel) -> Topic:
    """A topic to which another bag's messages are copied as they are."""
    definition = channel.definition
    if definition.format != MessageDefinitionFormat.NONE:
        encoding = "ros1msg" if channel.encoding == "ros1" else SCHEMA_ENCODINGS[definition.format]
        schema = encoding, definition.data.encode()
    else:
        encoding, _, data = definition.data.partition("\n")
        schema = encoding, data.encode("latin-1")
    if schema == ("", b"") and channel.encoding == "cdr":
        with suppress(BagError):  # not a standard type either: copied without its definition
            schema = "ros2msg", standard_definition(channel.msgtype).text.encode()
    return Topic(
        channel.topic,
        channel.msgtype,
        channel.encoding,
        schema,
        channel.metadata,
        channel.offered,
    )


class BagWriter:
    """A bag being written: NAME/NAME.mcap in compressed chunks, and NAME/metadata.yaml.

    Normally everything is written to a temporary folder beside `path`, which gets its name when
    the bag is closed; leaving a `with` block by an exception removes it. With `in_place=True` the
    bag grows under its own name and whatever happens stays readable: a recorder that is killed
    loses only the messages after the last closed chunk (it has no metadata.yaml then), and one
    whose disk is full spends the room that was kept for the bag's end and says so in `full`. A
    killed process loses nothing of a closed chunk; a power cut may.

    `custom` is stored in the MCAP file and in metadata.yaml's `custom_data`. `close_chunk`, called
    from a timer, limits what a kill loses.

    Raises BagError if `path` exists; OS errors pass through.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        custom: Mapping[str, str] | None = None,
        in_place: bool = False,
        compression: str = "zstd",
    ) -> None:
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self._topics: list[Topic] = []
        self._channels: list[int] = []  # their numbers in the file
        self._numbers: dict[str, int] = {}  # topic -> its place in `_topics`, of those not copied
        self._copies: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, tuple[str, bytes]], int] = {}
        self._custom: dict[str, str] = {}
        self._span_ns: tuple[int, int] | None = None
        self._in_place = in_place
        if compression.upper() not in CompressionType.__members__:
            raise BagError(f"no compression '{compression}'; there are zstd, lz4 and none")
        refuse_existing(self.path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if in_place:
            self._folder = self.path
            self._folder.mkdir()
        else:
            self._folder = Path(
                tempfile.mkdtemp(dir=self.path.parent, prefix=f".{self.path.name}.")
            )
            self._folder.chmod(0o755)
        try:
            self._reserve = Reserve(self._folder / RESERVE) if in_place else None
            self._output = Output(self._folder / f"{self.path.name}.mcap", self._reserve)
        except BaseException:
            shutil.rmtree(self._folder)
            raise
        # Any: half of mcap's writer is not annotated
        self._mcap: Any = Writer(
            self._output,  # type: ignore[arg-type]  # all that it uses of a stream
            chunk_size=CHUNK_BYTES,
            compression=CompressionType[compression.upper()],
        )
        self._mcap.start(profile="ros2", library="nlsid")
        self.annotate(custom or {})
        self.close_chunk()

    @property
    def size(self) -> int:
        """Bytes written so far, but for the chunk at hand."""
        return self._output.size

    @property
    def full(self) -> str:
        """Why the bag should be closed now, if the disk is full; otherwise empty."""
        return "" if self._reserve is None else self._reserve.spent

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
        key = (topic.msgtype, topic.schema)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(topic.msgtype, *topic.schema)
        channel = self._mcap.register_channel(
            topic.name,
            topic.encoding,
            self._schemas[key],
            {**topic.metadata, KEY: offered_text(topic.offered)},
        )
        self._channels.append(channel)
        self._topics.append(topic)
        self.counts.setdefault(topic.name, 0)
        return len(self._topics) - 1

    def keep(self, record: Metadata | Attachment) -> None:
        """Copy what is no message of another bag."""
        if isinstance(record, Metadata):
            self._mcap.add_metadata(record.name, record.metadata)
        else:
            self._mcap.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

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
        channel = self._channels[number]
        self._mcap.add_message(channel, log_ns, data, publish_ns, sequence=sequence)
        self.counts[self._topics[number].name] += 1
        first_ns, last_ns = self._span_ns or (log_ns, log_ns)
        self._span_ns = min(first_ns, log_ns), max(last_ns, log_ns)

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add to the bag's own key-value pairs; the newest of those with one key counts."""
        self._custom.update(custom)
        if custom:
            self.keep(Metadata(CUSTOM_DATA, dict(custom)))

    def close_chunk(self) -> None:
        """Hand everything written so far to the operating system as a complete chunk."""
        self._mcap.flush()
        self._output.refuse_loss()

    def close(self) -> None:
        """Finish the file, write metadata.yaml, give the folder its name; once.

        Where that fails (a full disk without a reserve), a bag in place stays what a killed
        recorder leaves: unfinished, all its closed chunks readable.
        """
        if self._output.closed:
            return
        try:
            if self._reserve is not None:
                self._reserve.release()
            self._mcap.finish()
            self._output.sync()
            self._output.close()
            write_metadata(
                self._folder,
                f"{self.path.name}.mcap",
                self._topics,
                self.counts,
                self._custom,
                self._span_ns or (0, 0),
            )
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
        if kind is None or self._in_place:
            self.close()
        else:
            self.discard()
