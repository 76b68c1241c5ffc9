"""An open bag: its topics, its metadata, and its messages in log order.

Bags are untrusted. Whatever the libraries below say about a damaged one leaves here as a BagError
that names the bag.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple

from mcap.reader import SeekingReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosbags.typesys.store import Typestore

from bags.message_types import types_in_bag
from bags.writer import CUSTOM_DATA
from nlsid_core.errors import BagError

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
DATA_FILES: Final = (".mcap", ".db3", ".zstd")  # .zstd: a file rosbag2 compressed whole


class Message(NamedTuple):
    """One recorded message, still serialised."""

    topic: str
    msgtype: str
    log_time_ns: int
    data: bytes


class Bag:
    """A bag open for reading: a rosbag2 folder or a single .mcap file. Use as a context manager.

    Raises BagError if there is no such bag, or if it is unfinished, damaged or not a bag.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.files = _data_files(self.path)
        for file in self.files:
            _check_ends(file)
        if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
            raise BagError(
                f"{self.path} has no metadata.yaml: the recording was not closed; "
                f"read {self.files[0].name} itself, or `ros2 bag reindex` the folder"
            )
        with reading(self.path):
            self._reader = Reader(self.path)
            self._reader.open()
        self._connections: dict[str, Connection] = {}
        self._types: dict[str, Typestore] = {}

    def __enter__(self) -> "Bag":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._reader.close()

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> message type, in the order of recording; several types are joined by ' and '."""
        types: dict[str, list[str]] = {}
        for connection in self._reader.connections:
            known = types.setdefault(connection.topic, [])
            if connection.msgtype not in known:
                known.append(connection.msgtype)
        return {topic: " and ".join(names) for topic, names in types.items()}

    @property
    def custom(self) -> dict[str, str]:
        """The bag's own metadata: `custom_data` of metadata.yaml or of the MCAP file."""
        if self.path.is_dir():
            storage: Any = self._reader.storage
            found = storage.metadata.custom or {}
        else:
            found = {}
            with reading(self.path), self.path.open("rb") as stream:
                for record in SeekingReader(stream).iter_metadata():
                    if record.name == CUSTOM_DATA:
                        found.update(record.metadata)
        if not isinstance(found, dict):
            raise BagError(f"{self.path}: custom_data in metadata.yaml is not a mapping")
        return {str(key): str(value) for key, value in found.items()}

    def types_on(self, topic: str) -> tuple[str, Typestore]:
        """The message type on `topic`, and the types it is made of.

        Raises BagError if the topic does not exist, holds several types or is not CDR.
        """
        found = [c for c in self._reader.connections if c.topic == topic]
        if not found:
            there = ", ".join(f"{name} ({kind})" for name, kind in self.topics.items())
            raise BagError(f"{self.path} has no topic {topic}; it has: {there or 'none'}")
        if len({c.msgtype for c in found}) > 1:
            raise BagError(
                f"{self.path}: {topic} holds messages of {self.topics[topic]}; "
                "a signal needs one type on its topic"
            )
        connection = found[0]
        extension = connection.ext
        if isinstance(extension, ConnectionExtRosbag2) and extension.serialization_format != "cdr":
            raise BagError(
                f"{self.path}: {topic} is serialised as '{extension.serialization_format}', "
                "only 'cdr' can be read"
            )
        with reading(self.path):
            return connection.msgtype, types_in_bag(connection.msgtype, connection.msgdef)

    def count(self, topic: str) -> int:
        """How many messages the bag's index lists on `topic`."""
        return sum(c.msgcount for c in self._reader.connections if c.topic == topic)

    def messages(self, topics: Sequence[str] | None = None) -> Iterator[Message]:
        """The messages on `topics` (None: on all) by log time; equal log times as recorded."""
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        with reading(self.path):
            for connection, log_time_ns, data in self._reader.messages(wanted):
                if log_time_ns >= 2**63:
                    raise BagError(f"a message on {connection.topic} has log time {log_time_ns} ns")
                yield Message(connection.topic, connection.msgtype, log_time_ns, bytes(data))


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what rosbags and mcap raise on damaged input into a BagError that names the bag.

    They raise nearly anything there (struct.error, KeyError, TypeError, decompression errors), so
    every Exception is caught, but only around calls into them.
    """
    try:
        yield
    except OSError:
        raise
    except BagError as error:
        raise BagError(f"{path}: {error}") from error
    except Exception as error:
        raise BagError(
            f"{path} is damaged or not a bag: {type(error).__name__}: {str(error)[:200]}"
        ) from error


def _data_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"there is no bag {path}; name a rosbag2 folder or an .mcap file")
    files = sorted(p for p in path.iterdir() if p.suffix in DATA_FILES and p.is_file())
    if not files:
        raise BagError(f"{path} is not a bag: it holds no {' or '.join(DATA_FILES)} file")
    return files


def _check_ends(file: Path) -> None:
    """BagError if an MCAP file does not begin and end as one."""
    if file.suffix in (".db3", ".zstd"):
        return
    with file.open("rb") as stream:
        start = stream.read(len(MCAP_MAGIC))
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MCAP_MAGIC)))
        end = stream.read()
    if start != MCAP_MAGIC:
        what = "is empty" if not size else f"starts with {start.hex(' ')}"
        raise BagError(f"{file} is not an MCAP file: it {what}")
    if end != MCAP_MAGIC or size < 2 * len(MCAP_MAGIC):
        raise BagError(
            f"{file} is truncated or unfinished: after {size} bytes it stops without the end of an "
            "MCAP file; copy it again, or recover its complete chunks (`mcap recover`)"
        )
