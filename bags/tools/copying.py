"""The one loop that copies messages from bags to new bags, as they are."""

import heapq
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from bags.recordings.bag import Bag
from bags.recordings.quality import Profile
from bags.recordings.storage import Channel, Raw
from bags.recordings.writer import BagWriter
from nlsid_core.progress import Progress, silent

REPORT_EVERY: Final = 1000  # messages between two reports of progress


@dataclass
class Copied:
    """How many messages were copied, what was left out or is not as it was stated, in words.

    sums: topic -> (messages, sum of their checksums, which does not depend on their order).
    parts: the new bags, where there are several.
    """

    messages: int = 0
    notes: list[str] = field(default_factory=list)
    sums: dict[str, tuple[int, int]] = field(default_factory=dict)
    parts: Sequence[Path] = ()


def copy_messages(
    bags: Sequence[Bag],
    writers: Sequence[BagWriter],
    choose: Callable[[int], BagWriter | None],
    *,
    topics: Sequence[str] | None = None,
    nearly: bool = False,
    progress: Progress = silent,
) -> Copied:
    """Copy the messages on `topics` (None: on all) of the bags, by log time.

    Each goes to the writer that `choose` names for its log time, with the definition that it was
    written with, its times and its sequence number. Every writer gets all topics, also those
    without messages, the attachments and the other records. nearly: see `Bag.raws`.
    """
    copied = Copied()
    channels = [_channels(bag, bags, topics) for bag in bags]
    for writer in writers:
        for bag in bags:
            for record in bag.kept_beside:
                writer.keep(record)
        _announce(writer, bags, channels)
    unreadable: dict[tuple[str, str], int] = {}
    total = sum(channel.count for known in channels for channel in known.values())
    streams = [_numbered(n, bag, topics, nearly=nearly) for n, bag in enumerate(bags)]
    for done, (raw, n) in enumerate(heapq.merge(*streams, key=lambda entry: entry[0].log_ns), 1):
        channel = channels[n][raw.key]
        target = choose(raw.log_ns)
        if raw.error:
            reason = channel.topic, raw.error
            unreadable[reason] = unreadable.get(reason, 0) + 1
        elif target is not None:
            target.copy(target.add_copy(channel, (n, bags[n].strand(channel))), raw)
            copied.messages += 1
            count, checksum = copied.sums.get(channel.topic, (0, 0))
            copied.sums[channel.topic] = count + 1, checksum + zlib.crc32(raw.data)
        if done % REPORT_EVERY == 0:
            progress("copying", done / max(total, 1))
    for writer in writers:
        for n, known in enumerate(channels):
            for channel in known.values():
                if channel.topic not in writer.counts:
                    writer.add_copy(channel, (n, bags[n].strand(channel)))
    for bag in bags:
        copied.notes += [*bag.lost, *bag.disagreements]
    for (topic, why), count in unreadable.items():
        copied.notes.append(f"{topic}: {count} messages are left out: {why}")
    return copied


def _numbered(
    n: int, bag: Bag, topics: Sequence[str] | None, *, nearly: bool
) -> Iterator[tuple[Raw, int]]:
    for raw in bag.raws(topics, nearly=nearly):
        yield raw, n


def _channels(bag: Bag, bags: Sequence[Bag], topics: Sequence[str] | None) -> dict[int, Channel]:
    """The bag's channels by key, with what the publishers of all bags offered."""
    found = {}
    for channel in bag.channels:
        if topics is None or channel.topic in topics:
            profiles: dict[Profile, None] = {}
            for other in bags:
                profiles |= dict.fromkeys(other.offered(channel.topic))
            found[channel.key] = replace(channel, offered=tuple(profiles))
    return found


def _announce(
    writer: BagWriter, bags: Sequence[Bag], channels: Sequence[dict[int, Channel]]
) -> None:
    """List the topics in their order; those with several definitions when a message needs one."""
    kinds: dict[str, set[object]] = {}
    for known in channels:
        for channel in known.values():
            kind = channel.msgtype, channel.encoding, channel.definition
            kinds.setdefault(channel.topic, set()).add(kind)
    for n, known in enumerate(channels):
        for channel in known.values():
            if len(kinds[channel.topic]) == 1:
                writer.add_copy(channel, (n, bags[n].strand(channel)))
