"""Make a whole bag of an unfinished or damaged one: a copy that says what was lost, or in place."""

import fcntl
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.folders import METADATA
from bags.recordings.message_types import decode
from bags.signals.timing import missing
from bags.tools.convert import convert
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent


@dataclass(frozen=True)
class Recovery:
    """What was recovered: messages per topic, verified by reading them back; what was lost.

    statements: what in the old bag says how many messages there should be, so that it was compared.
    """

    out: Path
    counts: dict[str, int]
    lost: tuple[str, ...]
    statements: tuple[str, ...] = ()

    @property
    def messages(self) -> int:
        """How many messages the new bag has."""
        return sum(self.counts.values())


def recover(path: Path | str, out: Path | str, *, progress: Progress = silent) -> Recovery:
    """Copy every message that can be read from the bag `path` to the new bag `out`, by log time.

    Every complete, undamaged chunk is copied, whatever indexes and summary say. The new bag is read
    back and compared. Raises BagError if nothing can be read or if `out` exists.
    """
    path, out = Path(path), Path(out)
    with Bag(path, salvage=True) as bag:
        copied = convert([bag], out, nearly=True, progress=progress)
        statements, topics = bag.statements, bag.topics
    found, lost = _read_back(out)
    if sum(found.values()) != copied.messages:
        raise BagError(f"{out} does not read back as it was written; is the disk damaged?")
    counts = {topic: found.get(topic, 0) for topic in topics}
    return Recovery(out, counts, (*copied.notes, *lost), statements)


def _read_back(out: Path) -> tuple[dict[str, int], list[str]]:
    """Messages on each topic of a new bag, and what it says of losses; BagError if damaged."""
    found: dict[str, int] = {}
    lost = []
    looked_into: set[int] = set()
    sequences: dict[tuple[str, int], list[IntArray]] = {}
    with Bag(out) as bag:
        for channel, batch in bag.batches():
            topic = channel.topic
            if channel.encoding == "cdr" and channel.key not in looked_into:
                looked_into.add(channel.key)
                if why := _unreadable(bag, topic, batch.data(0)):
                    lost.append(f"{topic}: its messages are kept, and cannot be read: {why}")
            found[topic] = found.get(topic, 0) + len(batch)
            sequences.setdefault((topic, bag.strands[channel.key]), []).append(batch.sequence)
    lost += [
        f"{topic}: {gaps} sequence numbers are missing: never recorded, or lost"
        for (topic, _), parts in sequences.items()
        if (gaps := missing(np.concatenate(parts)))
    ]
    return found, lost


def _unreadable(bag: Bag, topic: str, data: bytes) -> str:
    """Why a message is none of its type; empty if it is, or if its type is not known."""
    try:
        kind = bag.types_on(topic)
    except BagError:
        return ""
    try:
        decode(data, *kind)
    except BagError as error:
        return str(error)
    return ""


def unfinished_bags(folder: Path) -> list[Path]:
    """Find bags in `folder` that were not closed and that no recorder is writing now."""
    if not folder.is_dir():
        return []
    return [path for path in sorted(folder.iterdir()) if _is_unfinished(path)]


def repair(bag: Path) -> int:
    """Finish what a killed recorder left, with every message that can be read; how many there are.

    Its file is replaced once the new one is complete. Raises BagError if nothing can be read or
    the bag is being written.
    """
    if not _is_unfinished(bag):
        raise BagError(f"{bag} is not an unfinished bag of ours, or it is being written")
    with tempfile.TemporaryDirectory(dir=bag.parent, prefix=f".{bag.name}.repair.") as folder:
        whole = Path(folder) / bag.name
        with Bag(bag, salvage=True) as old:
            copied = convert([old], whole, nearly=True)
        for name in (f"{bag.name}.mcap", METADATA):  # without metadata.yaml it is still unfinished
            (whole / name).replace(bag / name)
    return copied.messages


def _is_unfinished(bag: Path) -> bool:
    file = bag / f"{bag.name}.mcap"
    if (bag / METADATA).exists() or not file.is_file():
        return False
    with file.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:  # a recorder holds it
            return False
    return True
