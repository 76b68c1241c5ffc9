"""One MCAP file of a bag that is being written."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mcap.writer import CompressionType, Writer

from bags.recordings.definitions import standard_definition
from bags.recordings.description import FileDescription
from bags.recordings.output import Output, Reserve
from bags.recordings.quality import KEY, Profile, offered_text
from bags.recordings.storage import FORMATS, Channel
from nlsid_core.errors import BagError

PROFILE: Final = "ros2"
LIBRARY: Final = "nlsid"
CUSTOM_DATA: Final = "custom_data"  # the MCAP Metadata record with the bag's own key-value pairs
TYPE_HASH: Final = "topic_type_hash"  # of a channel's metadata, as rosbag2 writes it
SCHEMA_ENCODINGS: Final = {format: name for name, format in FORMATS.items()}
CHUNK_BYTES: Final = 2**20
COMPRESSIONS: Final = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


@dataclass(frozen=True)
class Topic:
    """How a topic's messages are written; schema: its encoding and text. offered: see `quality`."""

    name: str
    msgtype: str
    encoding: str
    schema: tuple[str, str]
    metadata: Mapping[str, str]
    offered: tuple[Profile, ...] = ()


def topic_like(channel: Channel) -> Topic:
    """A topic to which another bag's messages are copied as they are."""
    schema = SCHEMA_ENCODINGS.get(channel.definition.format, ""), channel.definition.data
    if not channel.definition.data and channel.encoding == "cdr":
        with suppress(BagError):  # not a standard type either: copied without its definition
            schema = "ros2msg", standard_definition(channel.msgtype).text
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
        self._schemas: dict[tuple[str, tuple[str, str]], int] = {}
        self._channels: dict[str, int] = {}
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
        """Announce a topic."""
        key = (topic.msgtype, topic.schema)
        if key not in self._schemas:
            encoding, text = topic.schema
            self._schemas[key] = self._mcap.register_schema(topic.msgtype, encoding, text.encode())
        self._channels[topic.name] = self._mcap.register_channel(
            topic.name,
            topic.encoding,
            self._schemas[key],
            {**topic.metadata, KEY: offered_text(topic.offered)},
        )
        self.counts[topic.name] = 0

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add key-value pairs of the bag's own."""
        if custom:
            self._mcap.add_metadata(CUSTOM_DATA, dict(custom))

    def write(
        self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int
    ) -> None:
        """Append a message of a topic that was announced."""
        self._mcap.add_message(
            self._channels[topic], log_time_ns, data, publish_time_ns, sequence=sequence
        )
        self.counts[topic] += 1
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
