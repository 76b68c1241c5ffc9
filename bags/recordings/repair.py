"""Finish what a killed recorder left: an .mcap file without its end, a folder without metadata."""

import fcntl
import re
import shutil
import tempfile
from pathlib import Path

from mcap.reader import make_reader

from bags.recordings.description import (
    METADATA,
    FileDescription,
    Topic,
    write_metadata,
)
from bags.recordings.part import Part, topic_like
from bags.recordings.storage import Storage
from bags.recordings.writer import RESERVE
from nlsid_core.errors import BagError


def unfinished_bags(folder: Path) -> list[Path]:
    """Bag folders in `folder` that were not closed and that no recorder is writing now."""
    if not folder.is_dir():
        return []
    candidates = (path for path in sorted(folder.iterdir()) if path.is_dir())
    return [path for path in candidates if _is_unfinished(path)]


def repair(bag: Path) -> int:
    """Make an unfinished bag whole with every message that can still be read; how many there are.

    Files that were finished stay as they are; one that was not is replaced only once the new one is
    complete. Types are defined as the file defines them. Raises BagError if nothing can be read or
    the bag is being written.
    """
    if not _is_unfinished(bag):
        raise BagError(f"{bag} is not an unfinished bag of ours, or it is being written")
    files: list[FileDescription] = []
    topics: list[Topic] = []
    custom: dict[str, str] = {}
    scratch = Path(tempfile.mkdtemp(dir=bag.parent, prefix=f".{bag.name}.repair."))
    try:
        for file in _files(bag):
            storage = Storage([file], salvage=True)
            try:
                finished = _finished(file)
                files.append(finished or _rewritten(storage, scratch / file.name))
            finally:
                storage.close()
            custom |= storage.custom
            topics += map(topic_like, storage.channels)
            if finished is None:
                (scratch / file.name).replace(file)
        write_metadata(bag, files, topics, custom)
        (bag / RESERVE).unlink(missing_ok=True)
    finally:
        shutil.rmtree(scratch)
    return sum(sum(file.counts.values()) for file in files)


def _finished(file: Path) -> FileDescription | None:
    """What a file says of itself at its end, None if it has none."""
    with file.open("rb") as stream:
        try:
            summary = make_reader(stream).get_summary()
        except Exception:  # mcap raises nearly anything where a file breaks off
            return None
    if summary is None or summary.statistics is None:
        return None
    there = summary.statistics
    counts = {
        channel.topic: there.channel_message_counts.get(number, 0)
        for number, channel in summary.channels.items()
    }
    first_ns = there.message_start_time if there.message_count else None
    return FileDescription(file.name, counts, first_ns, there.message_end_time)


def _rewritten(storage: Storage, target: Path) -> FileDescription:
    """A finished copy of the messages that are there."""
    part = Part(target)
    part.annotate(storage.custom)
    for channel in storage.channels:
        part.add_topic(topic_like(channel))
    for raw in storage.messages(range(len(storage.channels)), nearly=True):
        part.write(raw.key, raw.data, raw.log_ns, raw.publish_ns, raw.sequence)
    part.finish()
    return part.description


def _is_unfinished(bag: Path) -> bool:
    files = _files(bag)
    if (bag / METADATA).exists() or not files:
        return False
    with files[-1].open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:  # a recorder holds it
            return False
    return True


def _files(bag: Path) -> list[Path]:
    """The files our recorder gave the bag, in their order."""
    ours = re.compile(re.escape(bag.name) + r"(?:_(\d+))?\.mcap")
    found = [(match, path) for path in bag.iterdir() if (match := ours.fullmatch(path.name))]
    return [path for match, path in sorted(found, key=lambda pair: int(pair[0][1] or 0))]
