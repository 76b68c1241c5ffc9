"""Write a bag: a rosbag2 folder with one MCAP file, from messages that are already serialised."""

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final

import yaml
from mcap.writer import CompressionType, Writer

from bags.recordings.message_types import are_same, definition, types_in_bag
from bags.recordings.storage import FORMATS, Channel
from nlsid_core._json import write_atomically
from nlsid_core.errors import BagError

PROFILE: Final = "ros2"
LIBRARY: Final = "nlsid"
CUSTOM_DATA: Final = "custom_data"  # the MCAP Metadata record with the bag's own key-value pairs
METADATA_VERSION: Final = 9  # the rosbag2 metadata of ROS 2 Jazzy
CHUNK_BYTES: Final = 2**20
SCHEMA_ENCODINGS: Final = {format: name for name, format in FORMATS.items()}


class BagWriter:
    """A bag being written: NAME/NAME.mcap (zstd chunks) and NAME/metadata.yaml.

    Normally everything is written to a temporary folder beside `path`, which gets its name when
    the bag is closed; leaving a `with` block by an exception removes it. With `in_place=True` the
    bag grows under its own name and whatever happens stays readable: a recorder that is killed
    loses only the messages after the last closed chunk (it has no metadata.yaml then). A killed
    process loses nothing of a closed chunk; a power cut may.

    `custom` is stored in the MCAP file and in metadata.yaml's `custom_data`. `max_chunk_age` in s
    of wall time closes a chunk at the first message after that age; where messages may pause, call
    `close_chunk` from a timer too.

    Raises BagError if `path` exists; OS errors pass through.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        custom: Mapping[str, str] | None = None,
        in_place: bool = False,
        max_chunk_age: float | None = None,
    ) -> None:
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._hashes: dict[str, str] = {}
        self._encodings: dict[str, str] = {}
        self._like: dict[str, Channel] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[str, int] = {}
        self._custom = dict(custom or {})
        self._first_ns: int | None = None
        self._last_ns = 0
        self._max_chunk_age = max_chunk_age
        self._chunk_opened: float | None = None
        if self.path.exists():
            raise BagError(f"{self.path} exists already; name another bag or move it away")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._in_place = in_place
        if in_place:
            self._folder = self.path
            self._folder.mkdir()
        else:
            self._folder = Path(
                tempfile.mkdtemp(dir=self.path.parent, prefix=f".{self.path.name}.")
            )
            self._folder.chmod(0o755)
        self._stream: BinaryIO = (self._folder / self._file_name).open("xb")
        fcntl.flock(self._stream, fcntl.LOCK_EX)  # whoever repairs bags leaves this one alone
        # Any: half of mcap's writer is not annotated
        self._mcap: Any = Writer(
            self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._mcap.start(profile=PROFILE, library=LIBRARY)
        if self._custom:
            self._mcap.add_metadata(CUSTOM_DATA, self._custom)
        self.close_chunk()

    def add_topic(self, topic: str, msgtype: str, *, like: Channel | None = None) -> None:
        """Announce a topic, so that the bag lists it even if no message comes.

        `like`: the channel of another bag that it is a copy of, with its own definition of its
        type; without one the type is a standard one. Raises BagError for a type that is not known
        and for a second type on one topic.
        """
        if topic in self._types:
            if self._types[topic] != msgtype:
                raise BagError(
                    f"{self.path}: {topic} holds '{self._types[topic]}', not '{msgtype}'; "
                    "a topic has one type"
                )
            if like is not None and self._like.setdefault(topic, like) is not like:
                self._refuse_another(self._like[topic], like)
            return
        if like is None:
            text, type_hash = definition(msgtype)
            schema, encoding = self._schema(msgtype, "ros2msg", text), "cdr"
            metadata = {"offered_qos_profiles": "[]", "topic_type_hash": type_hash}
        else:
            schema, encoding = self._schema_like(like), like.encoding
            metadata = dict(like.metadata)
            self._like[topic] = like
        self._channels[topic] = self._mcap.register_channel(topic, encoding, schema, metadata)
        self._types[topic] = msgtype
        self._hashes[topic] = metadata.get("topic_type_hash", "")
        self._encodings[topic] = encoding
        self.counts[topic] = 0

    def _refuse_another(self, first: Channel, second: Channel) -> None:
        """BagError if two channels copied to one topic were written with different definitions."""
        if first.encoding == second.encoding and (
            first.definition == second.definition
            or are_same(*(types_in_bag(c.msgtype, c.definition) for c in (first, second)))
        ):
            return
        raise BagError(
            f"{self.path}: {first.topic} comes with two definitions of '{first.msgtype}'; keep "
            "them in two bags"
        )

    def _schema_like(self, like: Channel) -> int:
        if not like.definition.data and like.encoding == "cdr":
            try:
                return self._schema(like.msgtype, "ros2msg", definition(like.msgtype)[0])
            except BagError:
                pass  # not a standard type either: copied as it came, without its definition
        encoding = SCHEMA_ENCODINGS.get(like.definition.format, "")
        return self._schema(like.msgtype, encoding, like.definition.data)

    def _schema(self, msgtype: str, encoding: str, text: str) -> int:
        key = (msgtype, text)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(msgtype, encoding, text.encode())
        return self._schemas[key]

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
        self._mcap.add_message(
            self._channels[topic],
            log_time_ns,
            data,
            publish_time_ns,
            sequence=self.counts[topic] if sequence is None else sequence,
        )
        self.counts[topic] += 1
        first = log_time_ns if self._first_ns is None else self._first_ns
        self._first_ns = min(first, log_time_ns)
        self._last_ns = max(self._last_ns, log_time_ns)
        if self._max_chunk_age is not None:
            now = time.monotonic()
            if self._chunk_opened is None:
                self._chunk_opened = now
            elif now - self._chunk_opened >= self._max_chunk_age:
                self.close_chunk()

    def annotate(self, custom: Mapping[str, str]) -> None:
        """Add to the bag's own key-value pairs."""
        self._custom.update(custom)
        self._mcap.add_metadata(CUSTOM_DATA, dict(custom))

    def close_chunk(self) -> None:
        """Hand everything written so far to the operating system as a complete chunk."""
        self._mcap.flush()
        self._chunk_opened = None

    def close(self) -> None:
        """Finish the file, write metadata.yaml, give the folder its name; once."""
        if self._stream.closed:
            return
        self._mcap.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        document = {"rosbag2_bagfile_information": self._information()}
        text = yaml.safe_dump(document, sort_keys=False, width=4096)  # a value stays on its line
        write_atomically(self._folder / "metadata.yaml", text.encode())
        if not self._in_place:
            if self.path.exists():  # rename would replace an empty folder
                self.discard()
                raise BagError(f"{self.path} appeared while the bag was written; not replaced")
            self._folder.rename(self.path)

    def discard(self) -> None:
        """Remove what was written."""
        self._stream.close()
        shutil.rmtree(self._folder)

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

    @property
    def _file_name(self) -> str:
        return f"{self.path.name}.mcap"

    def _information(self) -> dict[str, Any]:
        """metadata.yaml, version 9, as rosbag2 and rosbags read it."""
        start = {"nanoseconds_since_epoch": self._first_ns or 0}
        duration = {"nanoseconds": self._last_ns - (self._first_ns or 0)}
        count = sum(self.counts.values())
        return {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._file_name],
            "starting_time": start,
            "duration": duration,
            "message_count": count,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": msgtype,
                        "serialization_format": self._encodings[topic],
                        "offered_qos_profiles": [],
                        "type_description_hash": self._hashes[topic],
                    },
                    "message_count": self.counts[topic],
                }
                for topic, msgtype in self._types.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [
                {
                    "path": self._file_name,
                    "starting_time": dict(start),
                    "duration": dict(duration),
                    "message_count": count,
                }
            ],
            "custom_data": self._custom or None,
            "ros_distro": "jazzy",
        }
