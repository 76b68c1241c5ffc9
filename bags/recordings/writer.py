"""Write a bag: a rosbag2 folder of one MCAP file, from messages that are already serialised."""

import shutil
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Final

import yaml
from mcap.records import Channel as McapChannel
from mcap.records import Metadata, Schema

from bags.recordings.definitions import Definition, standard_definition
from bags.recordings.folders import METADATA, NEWEST_VERSION
from bags.recordings.mcap_records import CUSTOM_DATA
from bags.recordings.mcap_writer import PACKING, McapWriter
from bags.recordings.output import Output, Reserve
from bags.recordings.quality import KEY, TYPE_HASH, Profile, offered_text
from bags.recordings.storage import Channel
from nlsid_core.errors import BagError
from nlsid_core.files import write_atomically

MOST_CHANNELS: Final = 2**16
MAX_COUNT: Final = 2**32  # an MCAP file counts the messages of a topic in 32 bits
RESERVE: Final = ".reserve"  # the file in a growing bag that keeps room for its end


def refuse_existing(path: Path) -> None:
    """Raise a BagError if something is at `path`."""
    if path.exists():
        raise BagError(f"{path} exists already; take another name or move it away")


class BagWriter:
    """A bag being written: NAME/NAME.mcap in compressed chunks, and NAME/metadata.yaml.

    Normally everything is written to a temporary folder beside `path`, which gets its name when
    the bag is closed; leaving a `with` block by an exception removes it. With `in_place=True` the
    bag grows under its own name and whatever happens stays readable: a recorder that is killed
    loses only the messages after the last closed chunk (it has no metadata.yaml then), and one
    whose disk is full spends the room that was kept for the bag's end and says so in `full`. A
    killed process loses nothing of a closed chunk; a power cut may.

    `custom` is stored in the MCAP file and in metadata.yaml's `custom_data`. `close_chunk`, called
    from a timer, limits what a kill loses. `mcap` takes what is copied as it is.

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
        self._topics: dict[int, Channel] = {}  # by the numbers of their channels in the file
        self._numbers: dict[str, int] = {}  # topic -> its channel, of those not copied
        self._copies: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, tuple[str, bytes]], int] = {}
        self._custom: dict[str, str] = {}
        self._in_place = in_place
        if compression not in PACKING:
            raise BagError(f"no compression '{compression}'; there are: {', '.join(PACKING)}")
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
            self.mcap = McapWriter(self._output, compression)
            self.annotate(custom or {})
        except BaseException:
            shutil.rmtree(self._folder)
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
            self.mcap.declare(Schema(self._schemas[key], content, encoding, channel.msgtype))
        notes = {**channel.metadata, KEY: offered_text(channel.offered)}
        numbers = chain([wanted], range(1, MOST_CHANNELS))
        number = next(n for n in numbers if n not in self._topics)
        self.mcap.declare(
            McapChannel(number, channel.topic, channel.encoding, notes, self._schemas[key])
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
            self.mcap.keep(Metadata(CUSTOM_DATA, dict(custom)))

    def close_chunk(self) -> None:
        """Hand everything written so far to the operating system as a complete chunk."""
        self.mcap.close_chunk()
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
            self.mcap.finish()
            self._output.sync()
            self._output.close()
            _write_metadata(
                self._folder,
                f"{self.path.name}.mcap",
                self._topics.values(),
                self.counts,
                self._custom,
                self.mcap.span_ns,
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
