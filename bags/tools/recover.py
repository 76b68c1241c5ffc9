"""Make a whole bag of what can be read of an unfinished or damaged one, and say what was lost."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch
from bags.recordings.folders import BagFiles, bag_files
from bags.recordings.part import CUSTOM_DATA
from bags.recordings.storage import Channel, McapStorage, reading
from bags.recordings.writer import BagWriter
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent


@dataclass(frozen=True)
class Recovery:
    """What was recovered: messages per topic, verified by reading them back; what was lost."""

    out: Path
    counts: dict[str, int]
    lost: tuple[str, ...]

    @property
    def messages(self) -> int:
        """How many messages the new bag has."""
        return sum(self.counts.values())


def recover(path: Path | str, out: Path | str, *, progress: Progress = silent) -> Recovery:
    """Copy every message that can be read from the bag `path` to the new bag `out`.

    Of an MCAP file every complete, undamaged chunk is copied, whatever its indexes and summary
    say. The new bag is read back and compared. Raises BagError if nothing can be read or if `out`
    exists.
    """
    path, out = Path(path), Path(out)
    files = _files(path)
    lost: list[str] = []
    sums: dict[str, tuple[int, int]] = {}
    sizes = [file.stat().st_size for file in files]
    described = _described(path)
    with BagWriter(out, custom=described.custom) as writer:
        for k, file in enumerate(files):
            for channel, batch in _messages(file, lost, described):
                try:
                    writer.add_topic(channel.topic, channel.msgtype, like=channel)
                    if batch is not None:
                        _copy(writer, channel, batch, sums)
                except BagError as error:
                    count = 0 if batch is None else len(batch)
                    lost.append(f"{file.name}: {count} messages: {error}")
            progress("recovering", sum(sizes[: k + 1]) / max(sum(sizes), 1))
        if not sums and lost:
            raise BagError(f"{path}: no message can be read: {'; '.join(lost[:5])}")
        counts = dict(writer.counts)
    _verify(out, sums)
    return Recovery(out, counts, tuple(lost))


def _files(path: Path) -> list[Path]:
    """The MCAP files that are there, also if the metadata are damaged; else the bag as it is."""
    found = [path]
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix == ".mcap" and p.is_file()) or found
    elif not path.is_file():
        raise BagError(f"there is no bag {path}; name a rosbag2 folder or an .mcap file")
    return found


def _described(path: Path) -> BagFiles:
    try:
        return bag_files(path)
    except BagError:  # damaged metadata; an MCAP file carries its own
        return BagFiles(path, (), "mcap")


def _messages(
    file: Path, lost: list[str], described: BagFiles
) -> Iterator[tuple[Channel, Batch | None]]:
    """Every channel once without a batch, then the batches."""
    if file.is_dir() or file.suffix in (".db3", ".bag"):
        with Bag(file, unfinished=True) as bag:
            channels = [_with_offered(channel, described) for channel in bag.channels]
            yield from ((channel, None) for channel in channels)
            for channel, batch in bag.batches():
                yield channels[channel.key], batch
        return
    try:
        with reading(file):
            storage = McapStorage([file], CUSTOM_DATA, salvage=True)
    except BagError as error:
        lost.append(str(error))
        return
    contents = storage.files[0].contents
    lost += [f"{file.name}: {what}" for what in contents.lost]
    if contents.ending is not None:
        rest = file.stat().st_size - contents.good_bytes
        lost.append(f"{file.name}: {contents.ending}; the last {rest} bytes hold no whole chunk")
    channels = [_with_offered(channel, described) for channel in storage.channels]
    try:
        yield from ((channel, None) for channel in channels)
        for key, batch in storage.batches(range(len(channels))):
            yield channels[key], batch
    finally:
        storage.close()


def _with_offered(channel: Channel, described: BagFiles) -> Channel:
    return replace(channel, offered=described.offered.get(channel.topic) or channel.offered)


def _copy(
    writer: BagWriter, channel: Channel, batch: Batch, sums: dict[str, tuple[int, int]]
) -> None:
    for k in range(len(batch)):
        data = batch.data(k)
        writer.write(
            channel.topic,
            channel.msgtype,
            data,
            log_time_ns=int(batch.log_ns[k]),
            publish_time_ns=int(batch.publish_ns[k]),
            sequence=int(batch.sequence[k]),
        )
        count, total = sums.get(channel.topic, (0, 0))
        sums[channel.topic] = (count + 1, total + zlib.crc32(data))


def _verify(out: Path, written: dict[str, tuple[int, int]]) -> None:
    """BagError unless the bag reads back as it was written (the sum is free of order)."""
    found: dict[str, tuple[int, int]] = {}
    with Bag(out) as bag:
        for channel, batch in bag.batches():
            count, total = found.get(channel.topic, (0, 0))
            total += sum(zlib.crc32(batch.data(k)) for k in range(len(batch)))
            found[channel.topic] = (count + len(batch), total)
    if found != written:
        raise BagError(f"{out} does not read back as it was written; is the disk damaged?")
