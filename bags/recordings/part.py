"""One MCAP file of a bag that is being written."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import MessageDefinitionFormat

from bags.recordings.definitions import standard_definition
from bags.recordings.description import FileDescription, Topic
from bags.recordings.mcap_records import CUSTOM_DATA
from bags.recordings.output import Output, Reserve
from bags.recordings.quality import KEY, offered_text
from bags.recordings.storage import FORMATS, Channel
from nlsid_core.errors import BagError

PROFILE: Final = "ros2"
LIBRARY: Final = "nlsid"
SCHEMA_ENCODINGS: Final = {format: name for name, format in FORMATS.items()}
CHUNK_BYTES: Final = 2**20
COMPRESSIONS: Final = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


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


class Part:
    """A file in chunks, each whole on the disk once it is closed.

    counts: messages by topic. first_ns, last_ns: log times, None and 0 before the first message.
    """

    def __init__(
        self, path: Path, *, compression: str = "zstd", reserve: Reserve | None = None
    ) -> None:
        if compression not in COMPRESSIONS:
            raise BagError(f"compression '{compression}'; it is one of {', '.join(COMPRESSIONS)}")
        self.path = path
        self.counts: dict[str, int] = {}
        self.first_ns: int | None = None
        self.last_ns = 0
        self._schemas: dict[tuple[str, tuple[str, bytes]], int] = {}
        self._channels: list[tuple[str, int]] = []  # topic, number in the file
        self._output = Output(path, reserve)
        # Any: half of mcap's writer is not annotated
        self._mcap: Any = Writer(
            self._output,  # type: ignore[arg-type]  # all that it uses of a stream
            chunk_size=CHUNK_BYTES,
            compression=COMPRESSIONS[compression],
        )
        self._mcap.start(profile=PROFILE, library=LIBRARY)

    @property
    def size(self) -> int:
        """Bytes in the file; those of the open chunk come when it is closed."""
        return self._output.size

    @property
    def description(self) -> FileDescription:
        """What metadata.yaml says of it."""
        return FileDescription(self.path.name, self.counts, self.first_ns, self.last_ns)

    @property
    def closed(self) -> bool:
        """Whether it was finished or abandoned."""
        return self._output.closed

    def add_topic(self, topic: Topic) -> None:
        """Announce a topic; the first one is number 0 for `write`."""
        key = (topic.msgtype, topic.schema)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(topic.msgtype, *topic.schema)
        channel = self._mcap.register_channel(
            topic.name,
            topic.encoding,
            self._schemas[key],
            {**topic.metadata, KEY: offered_text(topic.offered)},
        )
        self._channels.append((topic.name, channel))
        self.counts.setdefault(topic.name, 0)

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add key-value pairs of the bag's own."""
        if custom:
            self.keep(Metadata(CUSTOM_DATA, dict(custom)))

    def keep(self, record: Metadata | Attachment) -> None:
        """Add what is no message."""
        if isinstance(record, Metadata):
            self._mcap.add_metadata(record.name, record.metadata)
        else:
            self._mcap.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def write(
        self, topic: int, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int
    ) -> None:
        """Append a message of a topic, by its number."""
        name, channel = self._channels[topic]
        self._mcap.add_message(channel, log_time_ns, data, publish_time_ns, sequence=sequence)
        self.counts[name] += 1
        if self.first_ns is None or log_time_ns < self.first_ns:
            self.first_ns = log_time_ns
        if log_time_ns > self.last_ns:
            self.last_ns = log_time_ns

    def close_chunk(self) -> None:
        """Hand everything written so far to the operating system as a complete chunk."""
        self._mcap.flush()
        self._output.refuse_loss()

    def finish(self) -> None:
        """Write the summary and close the file."""
        self._mcap.finish()
        self._output.sync()
        self._output.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._output.close()
