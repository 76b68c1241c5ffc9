"""New bags from old ones: a part of one, several as one, one in parts."""

import heapq
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from bags.recordings.bag import Bag, Message
from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile
from bags.recordings.storage import Channel
from bags.recordings.writer import BagWriter
from bags.signals.reader import read_signals, stamp_text
from bags.signals.repeats import find_period
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

REPORT_EVERY: Final = 1000  # messages between two reports of progress


def cut(
    path: Path | str,
    out: Path | str,
    *,
    start: float = 0.0,
    end: float | None = None,
    topics: Sequence[str] | None = None,
    unfinished: bool = False,
    definitions: Mapping[str, Definition] | None = None,
    progress: Progress = silent,
) -> int:
    """Copy the messages logged from `start` to before `end` s after the first (None: to the last).

    Only those on `topics` (None: on all). definitions: of types that the bag does not define; the
    copy does. Returns how many there were; raises BagError for a bag
    that cannot be read, for a topic that is not there, if nothing is left, and if `out` exists.
    """
    with Bag(path, unfinished=unfinished, definitions=definitions) as bag:
        for topic in topics or ():
            if topic not in bag.topics:
                raise BagError(f"{path} has no topic {topic}; it has: {', '.join(bag.topics)}")
        origin = _first_ns(bag)
        low = origin + round(start * 1e9)
        high = None if end is None else origin + round(end * 1e9)
        with BagWriter(out, custom=bag.custom) as writer:
            copied = _copy(
                (
                    (message, channel)
                    for message, channel in _with_channels(bag, topics)
                    if message.log_time_ns >= low and (high is None or message.log_time_ns < high)
                ),
                writer,
                progress,
                sum(c.count for c in bag.channels if topics is None or c.topic in topics),
            )
            if not copied:
                raise BagError(f"{path} has no message from {start:g} s to {end or np.inf:g} s")
    return copied


def merge(paths: Sequence[Path | str], out: Path | str, *, progress: Progress = silent) -> int:
    """Copy several bags into one, by log time; returns how many messages there were.

    Raises BagError if a bag cannot be read, if two have one topic with different types, and if
    `out` exists.
    """
    with ExitStack() as stack:
        bags = [stack.enter_context(Bag(path)) for path in paths]
        custom: dict[str, str] = {}
        for bag in bags:
            for key, value in bag.custom.items():
                if custom.setdefault(key, value) != value:
                    custom[key] = f"{custom[key]}; {value}"
        writer = stack.enter_context(BagWriter(out, custom=custom))
        profiles = _offered(bags)
        streams = [_with_channels(bag, None, profiles) for bag in bags]
        merged = heapq.merge(*streams, key=lambda entry: entry[0].log_time_ns)
        total = sum(channel.count for bag in bags for channel in bag.channels)
        return _copy(merged, writer, progress, total)


def split(
    path: Path | str,
    out: Path | str,
    *,
    repeats: str | None = None,
    every: float | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Copy a bag in parts to the new bags `out`_01, `out`_02, ...

    repeats: a signal whose repetitions are the parts; each is marked as a repeat of one excitation.
    every: s a part; a rest of less than half of that goes with the part before it.
    Raises BagError if neither or both are given, if the signal does not repeat, and as `cut`.
    """
    if (repeats is None) == (every is None):
        raise BagError("split a bag either at the repeats of a signal or every so many seconds")
    edges_ns, custom = _edges(Path(path), repeats, every)
    parts = [Path(f"{out}_{k:02d}") for k in range(1, len(edges_ns))]
    for part in parts:
        if part.exists():
            raise BagError(f"{part} exists already; name another bag or move it away")
    with Bag(path) as bag, ExitStack() as stack:
        writers = [
            stack.enter_context(BagWriter(part, custom=bag.custom | custom)) for part in parts
        ]
        total = sum(channel.count for channel in bag.channels)
        for done, (message, channel) in enumerate(_with_channels(bag, None), start=1):
            k = int(np.searchsorted(edges_ns, message.log_time_ns, side="right")) - 1
            if 0 <= k < len(writers):
                _write(writers[k], message, channel)
            if done % REPORT_EVERY == 0:
                progress("copying", done / max(total, 1))
    return parts


def _edges(
    path: Path, repeats: str | None, every: float | None
) -> tuple[list[int], dict[str, str]]:
    """Log times at which the parts begin and the last one ends; custom data of the parts."""
    if repeats is None:
        assert every is not None
        if not every > 0:
            raise BagError(f"a part of {every:g} s")
        with Bag(path) as bag:
            first_ns = last_ns = _first_ns(bag)
            for _, batch in bag.batches():
                last_ns = max(last_ns, int(np.max(batch.log_ns)))
        step_ns = round(every * 1e9)
        begins = [*range(first_ns, last_ns + 1, step_ns)]
        if len(begins) > 1 and 2 * (last_ns - begins[-1]) < step_ns:
            begins.pop()
        return [*begins, last_ns + 1], {}
    samples = read_signals(path, [repeats], clock="log time")[repeats]
    step_ns = int(np.median(np.diff(samples.stamp_ns)))
    found = find_period(samples.values)
    if found is None:
        raise BagError(f"{path}: {repeats} does not repeat itself; split it every so many seconds")
    count = len(samples) // found
    edges = [int(samples.stamp_ns[k * found]) for k in range(count)]
    last = count * found
    edges.append(int(samples.stamp_ns[last - 1]) + step_ns)
    group = f"{repeats}, {count} times from {stamp_text(edges[0])}"
    return edges, {"repeat_group": group}


def _first_ns(bag: Bag) -> int:
    first = next(bag.messages(), None)
    if first is None:
        raise BagError(f"{bag.path} has no messages")
    return first.log_time_ns


def _offered(bags: Sequence[Bag]) -> dict[str, tuple[Profile, ...]]:
    """What the publishers of each topic offered, those of all bags together."""
    found: dict[str, tuple[Profile, ...]] = {}
    for bag in bags:
        for topic in bag.topics:
            found[topic] = tuple(dict.fromkeys((*found.get(topic, ()), *bag.offered(topic))))
    return found


def _with_channels(
    bag: Bag,
    topics: Sequence[str] | None,
    profiles: Mapping[str, tuple[Profile, ...]] | None = None,
) -> Iterator[tuple[Message, Channel]]:
    profiles = _offered([bag]) if profiles is None else profiles
    channels = {c.topic: replace(c, offered=profiles[c.topic]) for c in bag.channels}
    for message in bag.messages(topics):
        yield message, channels[message.topic]


def _copy(
    messages: Iterator[tuple[Message, Channel]],
    writer: BagWriter,
    progress: Progress,
    total: int,
) -> int:
    done = 0
    for message, channel in messages:
        _write(writer, message, channel)
        done += 1
        if done % REPORT_EVERY == 0:
            progress("copying", done / max(total, 1))
    return done


def _write(writer: BagWriter, message: Message, channel: Channel) -> None:
    writer.add_topic(message.topic, message.msgtype, like=channel)
    writer.write(
        message.topic,
        message.msgtype,
        message.data,
        log_time_ns=message.log_time_ns,
        publish_time_ns=message.publish_time_ns,
    )
