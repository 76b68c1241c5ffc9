"""Finish what a killed recorder left: an .mcap file without its end, a folder without metadata."""

import fcntl
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from bags.recordings.writer import BagWriter
from nlsid_core.errors import BagError


def unfinished_bags(folder: Path) -> list[Path]:
    """Bag folders in `folder` that were not closed and that no recorder is writing now."""
    if not folder.is_dir():
        return []
    candidates = (path for path in sorted(folder.iterdir()) if path.is_dir())
    return [path for path in candidates if _is_unfinished(path)]


def repair(bag: Path) -> int:
    """Rewrite an unfinished bag with every message that can still be read; how many there are.

    The bag is replaced only once the new file is complete. Raises BagError if nothing can be read
    or the bag is being written.
    """
    file = bag / f"{bag.name}.mcap"
    if not _is_unfinished(bag):
        raise BagError(f"{bag} is not an unfinished bag of ours, or it is being written")
    scratch = Path(tempfile.mkdtemp(dir=bag.parent, prefix=f".{bag.name}.repair."))
    try:
        with BagWriter(scratch / bag.name) as repaired:
            for topic, msgtype, message in _readable(file):
                repaired.write(
                    topic,
                    msgtype,
                    message.data,
                    log_time_ns=message.log_time,
                    publish_time_ns=message.publish_time,
                )
        count = sum(repaired.counts.values())
        (scratch / bag.name / file.name).replace(file)
        (scratch / bag.name / "metadata.yaml").replace(bag / "metadata.yaml")
    finally:
        shutil.rmtree(scratch)
    return count


def _is_unfinished(bag: Path) -> bool:
    file = bag / f"{bag.name}.mcap"
    if (bag / "metadata.yaml").exists() or not file.is_file():
        return False
    with file.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:  # a recorder holds it
            return False
    return True


def _readable(file: Path) -> Iterator[tuple[str, str, Message]]:
    """(topic, type, message) up to where the file breaks off."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with file.open("rb") as stream:
        records = iter(StreamReader(stream).records)
        while True:
            try:
                record = next(records, None)
            except Exception:  # mcap raises nearly anything at the place where a file breaks off
                return
            if record is None:
                return
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                yield channel.topic, schemas[channel.schema_id].name, record
