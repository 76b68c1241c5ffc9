"""New bags from old ones: a stretch of time, some topics, other names and times, several as one.

One stream: messages by log time, of the chunks that are needed; what is chosen of them; the new
bag, or its parts one behind the other.
"""

import heapq
import math
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from io import StringIO
from itertools import combinations, repeat
from pathlib import Path
from typing import Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.mcap_file import Whole
from bags.recordings.mcap_records import NEVER, Block
from bags.recordings.message_types import (
    are_same,
    header_stamp_ns,
    is_stamped,
    standard_types,
)
from bags.recordings.storage import Channel, Raw, Spans
from bags.recordings.writer import BagWriter, refuse_existing
from bags.tools.copies import Into, What
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

REPORT_EVERY: Final = 1000  # messages between two reports of progress
SINCE_1970: Final = 1e8  # s, three years: a larger number is no time since the first message
LATEST: Final = 2**31 * 10**9  # ns: from here on a stamp's seconds have no room in a message
STORAGES: Final = {"mcap": ".mcap", "sqlite3": ".db3", "ros1": ".bag"}  # how their files end


@dataclass
class Copied:
    """How many messages were copied, what was left out or is not as it was stated, in words.

    parts: the new bags.
    """

    messages: int = 0
    notes: list[str] = field(default_factory=list)
    parts: Sequence[Path] = ()


def convert(
    bags: Sequence[Bag],
    out: Path,
    what: What | None = None,
    into: Into | None = None,
    *,
    nearly: bool = False,
    progress: Progress = silent,
) -> Copied:
    """Copy the messages of open bags to a new bag, by log time.

    Each keeps the definition that it was written with, its times and its sequence number. A new bag
    has all chosen topics, also those without messages, the attachments and the other records.
    Of one bag, a chunk whose messages are all wanted as they are is checked and copied as it is.

    Args:
        bags: of several, messages are merged; definitions that were given to a bag are written.
        out: the new bag, or with parts how their names begin.
        what: of the messages (None: all).
        into: how they are written (None: one MCAP bag).
        nearly: message by message, see `Bag.raws`.
        progress: told how far it is.

    Returns:
        What was copied and what was not.

    Raises:
        BagError: if a topic is not there, if two bags have one topic with different types, if
            nothing is chosen, and if a new bag exists.
    """
    what, into = what or What(), _as_named(out, into or Into())
    copied = Copied()
    channels = _channels(bags, what, into.storage, copied.notes)
    chosen = zip(bags, channels, strict=True)
    topics = {bag.channels[key].topic for bag, known in chosen for key in known}
    for first, second in combinations(bags, 2):
        for topic in topics & first.topics.keys() & second.topics.keys():
            _refuse_another_type(topic, first, second)
    spans = _spans(bags, what)
    restamped = _restamping(bags, channels, what.restamp, copied.notes)
    unreadable: Counter[tuple[str, str]] = Counter()
    total = sum(channel.count for known in channels for channel in known.values())
    whole = len(bags) == 1 and not nearly and not what.restamp
    with _written(out, into, bags, channels) as parts:
        takes = parts.takes if whole else None
        streams = [
            zip(bag.raws(list(topics), nearly=nearly, spans=spans, takes=takes), repeat(n))
            for n, bag in enumerate(bags)
        ]
        by_time = heapq.merge(*streams, key=lambda entry: entry[0].log_ns)
        for done, (raw, n) in enumerate(streams[0] if len(streams) == 1 else by_time):
            if done % REPORT_EVERY == 0 or isinstance(raw, Whole):
                progress("copying", copied.messages / max(total, 1))
            if isinstance(raw, Whole):
                parts.at(raw.log_ns).mcap.copy_chunk(raw)
                copied.messages += sum(map(len, raw.messages.values()))
                continue
            channel = channels[n][raw.key]
            if raw.error:
                unreadable[channel.topic, raw.error] += 1
                continue
            writer = parts.at(raw.log_ns)
            number = writer.add_copy(*parts.sources[n, raw.key])
            made = restamped(n, raw)
            writer.mcap.add(number, made.log_ns, made.publish_ns, made.sequence, made.data)
            copied.messages += 1
        copied.notes += [note for bag in bags for note in (*bag.lost, *bag.disagreements)]
        copied.notes += [
            f"{topic}: {count} messages are left out: {why}"
            for (topic, why), count in unreadable.items()
        ]
        if not copied.messages and (copied.notes or what != What()):
            said = "".join(f"; {note}" for note in copied.notes[:5])
            raise BagError(f"{bags[0].path}: no message can be read there{said}")
    if into.storage != "mcap":
        copied.notes.append(
            f"{into.storage} keeps no sequence numbers, times of publishing, attachments and "
            "metadata records"
        )
    copied.parts = parts.paths
    return copied


def _channels(
    bags: Sequence[Bag], what: What, storage: str, notes: list[str]
) -> list[dict[int, Channel]]:
    """The chosen channels of each bag by key, under their new names, with what the publishers of
    all bags offered; notes: get what the storage has no room for.
    """
    there = {topic for bag in bags for topic in bag.topics}
    for pattern in what.topics or ():
        if not any(fnmatchcase(topic, pattern) for topic in there):
            raise BagError(
                f"{bags[0].path} has no topic {pattern}; it has: {', '.join(sorted(there))}"
            )
    names: dict[str, str] = {}
    for text in what.rename or ():
        old, equals, new = text.replace(":=", "=", 1).partition("=")  # as ROS writes it, too
        if not equals or not new or old not in there or new in {*there, *names.values()}:
            raise BagError(
                f"--rename {text}: expected /old=/new, the name of a topic and one that none has"
            )
        names[old] = new
    found = []
    for bag in bags:
        known = {}
        for channel in bag.channels:
            topic = channel.topic
            if what.topics and not any(fnmatchcase(topic, pattern) for pattern in what.topics):
                continue
            if storage != "mcap" and channel.encoding != "cdr":
                notes.append(f"{topic} is left out: {storage} keeps no {channel.encoding}")
                continue
            profiles = dict.fromkeys(profile for other in bags for profile in other.offered(topic))
            known[channel.key] = replace(
                channel, topic=names.get(topic, topic), offered=tuple(profiles)
            )
        found.append(known)
    return found


def _as_named(out: Path, into: Into) -> Into:
    """In the storage that the new file's ending says, if none is named."""
    ending = next((name for name, end in STORAGES.items() if end == out.suffix), "mcap")
    into = replace(into, storage=into.storage or ending)
    if into.storage not in STORAGES:
        raise BagError(f"no storage '{into.storage}'; there are: {', '.join(STORAGES)}")
    if into.compression and into.storage != "mcap":
        raise BagError(f"--compression {into.compression} is of mcap, not of {into.storage}")
    return into


def _refuse_another_type(topic: str, first: Bag, second: Bag) -> None:
    """BagError if two bags have a topic with two types, or with two definitions of its type."""
    try:
        (one, defined), (other, redefined) = (bag.types_on(topic) for bag in (first, second))
    except BagError:  # nothing is known of what is copied as it is
        return
    if one != other:
        raise BagError(
            f"{topic} holds '{one}' in {first.path} and '{other}' in {second.path}; a topic has "
            "one type: keep them in two bags"
        )
    if not are_same(defined, redefined):
        raise BagError(
            f"{second.path}: {topic} comes with two definitions of '{one}'; keep them in two bags"
        )


def _spans(bags: Sequence[Bag], what: What) -> Spans:
    """When messages are copied."""
    starts = [bag.start_ns for bag in bags if any(channel.count for channel in bag.channels)]
    origin_ns = min(starts, default=0)
    start_ns = _moment(what.start, origin_ns) if what.start else 0
    end_ns = _moment(what.end, origin_ns) if what.end else NEVER
    if not what.around:
        return [(start_ns, end_ns)]
    if any(what.around in bag.topics for bag in bags):
        times = [log_ns for bag in bags for _, log_ns in bag.log_times([what.around])]
        events = np.sort(np.concatenate([np.empty(0, np.int64), *times])).tolist()
    else:
        events = [_moment(what.around, origin_ns)]
    before_ns, after_ns = round(what.before * 1e9), round(what.after * 1e9)
    spans: list[tuple[int, int]] = []
    for event in events:
        first, last = max(event - before_ns, start_ns), min(event + after_ns + 1, end_ns)
        if spans and first <= spans[-1][1]:
            first = spans.pop()[0]
        spans.append((first, last))
    return spans


def _moment(text: str, origin_ns: int) -> int:
    """A log time in ns: s after `origin_ns`, s since 1970, or a date; BagError if it is none."""
    if math.isfinite(seconds := _seconds(text)):
        return round(seconds * 1e9) + (0 if seconds >= SINCE_1970 else origin_ns)
    try:
        date = datetime.fromisoformat(text)
    except ValueError as error:
        raise BagError(
            f"'{text}' is no moment: give s after the first message, s since 1970, or a date "
            "as 2024-05-01T12:00:00; for --around also a topic of the bag"
        ) from error
    whole = date if date.tzinfo else date.replace(tzinfo=UTC)
    return int(whole.replace(microsecond=0).timestamp()) * 10**9 + whole.microsecond * 1000


def _seconds(text: str) -> float:
    """The s that a text is, NaN if it is none before 2038."""
    try:
        seconds = float(text)
    except ValueError:
        return math.nan
    return seconds if abs(seconds) < 2**31 else math.nan


def _restamping(
    bags: Sequence[Bag], channels: Sequence[Mapping[int, Channel]], rule: str, notes: list[str]
) -> Callable[[int, Raw], Raw]:
    """What makes a message of bag n the one that is written; notes: get what it does not move."""
    if not rule:
        return lambda _, raw: raw
    shift = 0.0 if rule in ("header", "log") else _seconds(rule)
    if not math.isfinite(shift):
        raise BagError(f"--restamp {rule}: header, log, or s as +3600")
    shift_ns = round(shift * 1e9)
    stamped = [
        {
            key: channel.encoding == "cdr" and is_stamped(*bag.types_on(bag.channels[key].topic))
            for key, channel in known.items()
        }
        for bag, known in zip(bags, channels, strict=True)
    ]
    chosen = zip(channels, stamped, strict=True)
    if without := {known[key].topic for known, has in chosen for key in has if not has[key]}:
        notes.append(
            f"without a header of their own, the stamps in their messages stay as they are: "
            f"{', '.join(sorted(without))}"
        )

    def restamped(n: int, raw: Raw) -> Raw:
        data, at = raw.data, raw.log_ns
        if stamped[n][raw.key] and rule != "log":
            at = header_stamp_ns(data) + shift_ns
        log_ns, publish_ns = raw.log_ns + shift_ns, raw.publish_ns + shift_ns
        if rule == "header":
            log_ns = publish_ns = at
        if not all(0 <= time_ns < LATEST for time_ns in (at, log_ns, publish_ns)):
            raise BagError(f"--restamp {rule} moves messages to before 1970 or after 2038")
        if stamped[n][raw.key] and rule != "header":
            layout = "<iI" if data[1] else ">iI"
            data = data[:4] + struct.pack(layout, *divmod(at, 10**9)) + data[12:]
        return raw._replace(log_ns=log_ns, publish_ns=publish_ns, data=data)

    return restamped


class _Parts:
    """The new bags, begun one behind the other."""

    def __init__(
        self, out: Path, into: Into, bags: Sequence[Bag], channels: Sequence[Mapping[int, Channel]]
    ) -> None:
        self.paths: list[Path] = []
        self._out, self._into, self._bags = out, into, bags
        self.sources = {
            (n, key): (channel, (n, bag.strands[key]), bag.numbers[key])
            for n, (bag, known) in enumerate(zip(bags, channels, strict=True))
            for key, channel in known.items()
        }
        self._writer: BagWriter | None = None
        self._first_ns, self._until_ns = 0, NEVER
        self._packed = into.compression or "zstd"
        self._most = NEVER if into.max_size is None else into.max_size * 1e6

    @property
    def name(self) -> str:
        """What the next is called."""
        several = self._into.every is not None or self._into.max_size is not None
        return f"{self._out.name}_{len(self.paths) + 1:02d}" if several else self._out.name

    def at(self, log_ns: int) -> BagWriter:
        """The one that has what was logged then."""
        if self._writer is None or log_ns >= self._until_ns or self._writer.size >= self._most:
            return self._begin(log_ns)
        return self._writer

    def takes(self, block: Block, numbers: Mapping[int, int]) -> bool:
        """Whether a chunk of the only bag fits as it is; numbers: of its channels -> keys."""
        if self._into.storage != "mcap" or (block.compression or "none") != self._packed:
            return False
        writer = self.at(block.start_ns)
        copied = (writer.add_copy(*self.sources[0, key]) == n for n, key in numbers.items())
        return block.end_ns < self._until_ns and all(copied)

    def _begin(self, log_ns: int) -> BagWriter:
        """Begin the next, with all that is no message."""
        self._close()
        if not self.paths:
            self._first_ns = log_ns
        if self._into.every is not None:
            step_ns = round(self._into.every * 1e9)
            self._until_ns = log_ns + step_ns - (log_ns - self._first_ns) % step_ns
        custom: dict[str, str] = {}
        for bag in self._bags:
            for key, value in bag.custom.items():
                if custom.setdefault(key, value) != value:
                    custom[key] = f"{custom[key]}; {value}"
        writer = BagWriter(self._out.with_name(self.name), custom=custom, compression=self._packed)
        for bag in self._bags:
            for record in bag.kept_beside:
                writer.mcap.keep(record)
        for source in self.sources.values():
            writer.add_copy(*source)
        self._writer = writer
        return writer

    def _close(self) -> None:
        """Finish the bag at hand."""
        if self._writer is not None:
            self._writer.close()
            self.paths.append(self._writer.path)

    def end(self) -> list[Path]:
        """Finish the last bag, or make one without a message; the new bags."""
        self.at(self._first_ns if self._writer is None else 0)
        self._close()
        return self.paths

    def abandon(self) -> None:
        """Let go of the bag at hand."""
        if self._writer is not None:
            self._writer.abandon()


@contextmanager
def _written(
    out: Path, into: Into, bags: Sequence[Bag], channels: Sequence[Mapping[int, Channel]]
) -> Iterator[_Parts]:
    """New bags, which get their names in the end; nothing is left after an error."""
    for size, unit in ((into.every, "s"), (into.max_size, "MB")):
        if size is not None and not size > 0:
            raise BagError(f"a part of {size:g} {unit}")
    out.parent.mkdir(parents=True, exist_ok=True)
    ending = STORAGES[into.storage]
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        parts = _Parts(Path(folder) / out.name.removesuffix(ending), into, bags, channels)
        as_file = ending if ending in (out.suffix, ".bag") else ""
        refuse_existing(out.with_name(parts.name + as_file))
        try:
            yield parts
            made = [_stored(path, into.storage, as_file) for path in parts.end()]
        finally:
            parts.abandon()
        parts.paths = [out.with_name(path.name) for path in made]
        for path in parts.paths:
            refuse_existing(path)
        for path, final in zip(made, parts.paths, strict=True):
            path.rename(final)


def _stored(bag: Path, storage: str, ending: str) -> Path:
    """The bag in its storage, with an ending as a file; BagError if it cannot be put there."""
    made = bag
    if storage != "mcap":
        made = bag.with_name("made") / f"{bag.name}{ending if storage == 'ros1' else ''}"
        _by_rosbags(bag, made, storage)
    return made / f"{bag.name}{ending}" if ending and made.is_dir() else made


def _by_rosbags(bag: Path, made: Path, storage: str) -> None:
    from rosbags.convert.converter import ConverterError
    from rosbags.convert.converter import convert as convert_bag

    made.parent.mkdir(exist_ok=True)
    try:
        with redirect_stdout(StringIO()):
            convert_bag(
                [bag], made, storage, 9, None, "none", standard_types(), None, (), (), (), ()
            )
    except ConverterError as error:
        raise BagError(f"it cannot be written as {storage}: {error}") from error
