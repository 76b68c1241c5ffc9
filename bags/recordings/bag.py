"""An open bag: its topics, what it states, and its messages in log order or in batches.

Bags are untrusted. Whatever is wrong with one leaves here as a BagError that names the bag.
"""

from bisect import bisect_left
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from itertools import accumulate, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple

from mcap.records import Attachment, Metadata
from rosbags.typesys.store import Typestore

from bags.recordings.batch import Batch, LogOrder, joined
from bags.recordings.definitions import Definition
from bags.recordings.folders import METADATA, BagFiles, bag_files, data_files, without_twins
from bags.recordings.mcap_file import McapFile, Whole
from bags.recordings.mcap_records import CUSTOM_DATA, NEVER, ROSBAG2
from bags.recordings.message_types import are_same, ros2_definition, types_in_bag
from bags.recordings.names import did_you_mean, listed
from bags.recordings.quality import KEY, Profile, offered
from bags.recordings.remote import place
from bags.recordings.storage import (
    ALWAYS,
    KINDS,
    Channel,
    DataFile,
    Raw,
    Spans,
    Takes,
    Translate,
    defined,
    first_ns,
    in_cdr,
    open_file,
    packed,
    reading,
    type_name,
    unpacked,
)
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

RECOVER: Final = "`nlsid bag recover`"
UNCLOSED: Final = f"it has no {METADATA}: the recording was not closed"
MAX_OVERLAP_BYTES: Final = 256 * 2**20  # chunks that overlap in time are sorted in memory


class Message(NamedTuple):
    """One recorded message, still serialised."""

    topic: str
    msgtype: str
    log_time_ns: int
    data: bytes
    publish_time_ns: int = 0


class Bag:
    """A bag open for reading. Use as a context manager.

    A bag is a rosbag2 folder, one of its files, or a ROS 1 bag: MCAP, SQLite or ROS 1, split or
    not, compressed or not; of MCAP also one in object storage, by its URL
    (`bags.recordings.remote`).
    Raises BagError if there is no such bag, if it is damaged or not a bag, or if it is unfinished.
    With `unfinished=True` the last is no error: the messages there are can be read, and `ending`
    says why there may be more. With `salvage=True` damage is no error either: what cannot be read
    is listed in `lost`, and every data file in the folder is read, whatever its metadata say.
    definitions: of types that the bag itself does not define.
    channels: the recorded streams; a topic has one, or several in a split bag. strands: for each,
    which of its topic's channels in its file it is: those of one recording are counted on from file
    to file. numbers: those that they have in their files. custom: the bag's own metadata,
    `custom_data` of the MCAP files and, before it, metadata.yaml.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        unfinished: bool = False,
        salvage: bool = False,
        definitions: Mapping[str, Definition] | None = None,
    ) -> None:
        self.path = place(path)
        self._described, self._refused = _described(self.path, salvage=salvage)
        self.files: tuple[Path, ...] = self._described.files
        self.channels: list[Channel] = []
        self.strands: list[int] = []
        self.numbers: list[int] = []
        self.custom: dict[str, str] = {}
        self._records: list[Metadata] = []
        self._data: list[DataFile] = []
        self._keys: list[dict[int, int]] = []  # of each file: its channels' numbers -> keys
        self._translated: dict[int, Translate] = {}
        with ExitStack() as stack:
            for file in self.files:
                self._open(file, stack, salvage=salvage)
            self._data.sort(key=first_ns)
            for data in self._data:
                with reading(data.path):
                    self._add(data)
            self.custom |= self._described.custom
            self.channels = [
                defined(self._encoded(channel), definitions or {}, self.release)
                for channel in self.channels
            ]
            self.ending = self._why_unfinished()
            if self.ending is not None and not (unfinished or salvage):
                raise BagError(self._unfinished())
            self._stack = stack.pop_all()

    def _open(self, path: Path, stack: ExitStack, *, salvage: bool) -> None:
        try:
            with reading(path):
                file = open_file(path, stack, self._refused, salvage=salvage)
                file.path = path  # also of one that is unpacked elsewhere
                self._data.append(file)
        except BagError as error:
            if not salvage:
                raise
            self._refused.append(str(error))

    def _add(self, file: DataFile) -> None:
        found = file.contents
        for record in found.metadata:
            if record.name == CUSTOM_DATA:
                self.custom.update(record.metadata)
            elif record not in self._records:
                self._records.append(record)
        keys: dict[int, int] = {}
        strands: dict[str, int] = {}
        for number, recorded in found.declared.channels.items():
            schema = found.declared.schemas.get(recorded.schema_id)
            if schema is None and recorded.schema_id:
                raise BagError(f"channel {number} has schema {recorded.schema_id}, not declared")
            keys[number] = len(self.channels)
            strand = strands[recorded.topic] = strands.get(recorded.topic, -1) + 1
            self.strands.append(strand)
            self.numbers.append(number)
            channel, translate = in_cdr(
                Channel(
                    key=keys[number],
                    topic=recorded.topic,
                    msgtype=type_name(schema.name if schema else ""),
                    encoding=recorded.message_encoding,
                    schema=(schema.encoding, schema.data) if schema else ("", b""),
                    count=found.counts.get(number, 0),
                    metadata=recorded.metadata,
                    offered=offered(recorded.metadata.get(KEY, "")),
                )
            )
            self.channels.append(channel)
            if translate is not None:
                self._translated[channel.key] = translate
        self._keys.append(keys)

    def _encoded(self, channel: Channel) -> Channel:
        """The channel, with the encoding that the metadata state where its file says CDR."""
        described = (self._described.topics or {}).get(channel.topic)
        if described is None or channel.encoding != "cdr":
            return channel
        return replace(channel, encoding=described.encoding)

    def close(self) -> None:
        """Close the bag's files."""
        self._stack.close()

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @cached_property
    def topics(self) -> dict[str, str]:
        """Topic -> message type, in the order of recording; several types are joined by ' and '."""
        types: dict[str, list[str]] = {}
        for channel in self.channels:
            known = types.setdefault(channel.topic, [])
            if channel.msgtype not in known:
                known.append(channel.msgtype)
        return {topic: " and ".join(names) for topic, names in types.items()}

    @property
    def release(self) -> str:
        """The release of ROS 2 that recorded it, as it says; empty if it does not."""
        named = [r.metadata.get("ROS_DISTRO", "") for r in self._records if r.name == ROSBAG2]
        return next(filter(None, (self._described.release, *named)), "")

    @property
    def lost(self) -> tuple[str, ...]:
        """What cannot be read, as far as it was found by now, and why."""
        found = [*self._refused]
        for file in self._data:
            ending = filter(None, [file.contents.ending])
            found += [f"{file.path.name}: {what}" for what in (*file.contents.lost, *ending)]
        return tuple(found)

    @property
    def kept_beside(self) -> Iterator[Metadata | Attachment]:
        """The bag's records that are no messages, but for `custom`; attachments with their data."""
        yield from self._records
        for file in self._data:
            if isinstance(file, McapFile):
                yield from file.attachments()

    @property
    def kinds(self) -> dict[str, list[str]]:
        """What the files are, and how what is in them is compressed."""
        return {
            "storage": sorted({KINDS[type(file)] for file in self._data}),
            "compression": sorted(
                {block.compression for file in self._data for block in file.contents.blocks}
                - {"", "none"}
            ),
        }

    @property
    def start_ns(self) -> int:
        """The first log time in ns; 0 if there are no messages."""
        first = min(map(first_ns, self._data), default=NEVER)
        return 0 if first == NEVER else first

    @property
    def stated(self) -> dict[str, int] | None:
        """Topic -> messages, as the files' statistics and indexes say; None if one says nothing."""
        found: dict[str, int] = {}
        for file, keys in zip(self._data, self._keys, strict=True):
            if file.contents.stated is None:
                return None
            for number, count in file.contents.stated.items():
                if number in keys:
                    topic = self.channels[keys[number]].topic
                    found[topic] = found.get(topic, 0) + count
        return found

    @property
    def statements(self) -> tuple[str, ...]:
        """What in the bag says how many messages there should be."""
        said = {
            METADATA: self._described.topics is not None,
            "the files' statistics and indexes": self.stated is not None,
        }
        return tuple(name for name, there in said.items() if there)

    @property
    def disagreements(self) -> tuple[str, ...]:
        """Where what the bag states and what is there differ, in words."""
        found = [*self._described.notes]
        said = {METADATA: self._counts, "the file": self.stated}
        for name, counts in said.items():
            for topic in {**counts, **self.topics} if counts is not None else ():
                stated, there = (counts or {}).get(topic, 0), self._there(topic)
                if stated != there:
                    found.append(f"{topic}: {name} states {stated} messages, {there} are there")
                elif topic not in self.topics:
                    found.append(f"{topic}: {name} lists it, no file declares it")
        total, there = self._described.total, sum(channel.count for channel in self.channels)
        if total not in (None, there):
            found.append(f"{METADATA} states {total} messages in all, {there} are there")
        return tuple(dict.fromkeys(found))

    def types_on(self, topic: str) -> tuple[str, Typestore]:
        """The message type on `topic`, and the types it is made of.

        Raises BagError if the topic does not exist, holds several types or is not CDR.
        """
        found = [c for c in self.channels if c.topic == topic]
        found = [c for c in found if c.count] or found
        if not found:
            there = listed(f"{name} ({kind})" for name, kind in self.topics.items())
            near = did_you_mean(topic, self.topics)
            cut = "" if self.ending is None else f". It is truncated or unfinished: {self.ending}"
            raise BagError(f"{self.path} has no topic {topic}; it has: {there}{near}{cut}")
        if len({c.msgtype for c in found}) > 1:
            raise BagError(
                f"{self.path}: {topic} holds messages of {self.topics[topic]}; "
                "a signal needs one type on its topic"
            )
        try:
            for channel in found:
                if channel.encoding == "ros1":
                    ros2_definition(channel.msgtype, channel.definition)  # says what is wrong
                if channel.encoding != "cdr":
                    raise BagError(f"it is serialised as '{channel.encoding}', only 'cdr' is read")
            types = [types_in_bag(channel.msgtype, channel.definition) for channel in found]
        except BagError as error:
            raise BagError(f"{self.path}: {topic}: {error}") from error
        if not all(are_same(types[0], other) for other in types):
            raise BagError(f"{self.path}: {topic} has parts with different definitions of its type")
        return found[0].msgtype, types[0]

    def offered(self, topic: str) -> tuple[Profile, ...]:
        """What each publisher of `topic` offered; empty where the bag does not say.

        metadata.yaml goes before the files, as it does for rosbag2.
        """
        found = [p for c in self.channels if c.topic == topic for p in c.offered]
        described = (self._described.topics or {}).get(topic)
        return tuple(dict.fromkeys((described and described.offered) or found))

    def count(self, topic: str) -> int:
        """How many messages the bag says it has on `topic`."""
        if self._counts is not None and self.ending is None:
            return self._counts.get(topic, 0)
        return self._there(topic)

    @cached_property
    def _counts(self) -> dict[str, int] | None:
        """Messages of each topic as metadata.yaml states them."""
        if self._described.topics is None:
            return None
        return {topic: described.messages for topic, described in self._described.topics.items()}

    def _there(self, topic: str) -> int:
        return sum(channel.count for channel in self.channels if channel.topic == topic)

    def batches(
        self, topics: Sequence[str] | None = None, *, progress: Progress = silent
    ) -> Iterator[tuple[Channel, Batch]]:
        """The messages on `topics` (None: on all), many at once, in the order of the files.

        Memory: one batch. Raises BagError where the bag is damaged.
        """
        yield from (part[:2] for part in self.parts(topics, progress=progress))

    def parts(
        self, topics: Sequence[str] | None = None, *, progress: Progress = silent
    ) -> Iterator[tuple[Channel, Batch, int]]:
        """As `batches`, with the log time in ns that no message from here on goes below, as the
        chunks state it.
        """
        keys = self._keys_on(topics)
        total, done = max(sum(self.channels[key].count for key in keys), 1), 0
        blocks = [(n, block) for n, file in enumerate(self._data) for block in file.contents.blocks]
        starts = [block.start_ns for _, block in blocks]
        later = [*accumulate(reversed(starts), min, initial=NEVER)][::-1]
        for (n, block), earliest in zip(blocks, later, strict=False):
            file, wanted = self._data[n], self._wanted(n, keys)
            with reading(file.path):
                for number, batch in file.block_batches(block, wanted):
                    channel = self.channels[wanted[number]]
                    yield channel, self._plain(channel.key, batch), earliest
                    done += len(batch)
                    progress("reading", done / total)

    def log_times(self, topics: Sequence[str]) -> Iterator[tuple[str, IntArray]]:
        """(topic, log times in ns) part by part; of MCAP from its indexes, without a message."""
        keys = self._keys_on(topics)
        for n, file in enumerate(self._data):
            wanted = self._wanted(n, keys)
            with reading(file.path):
                if isinstance(file, McapFile):
                    times = file.log_times(wanted)
                else:
                    batches = (file.block_batches(block, wanted) for block in file.contents.blocks)
                    times = ((number, batch.log_ns) for found in batches for number, batch in found)
                yield from ((self.channels[wanted[c]].topic, log_ns) for c, log_ns in times)

    def log_order(self, topics: Sequence[str]) -> LogOrder:
        """Where the log times of `topics` go back inside a file."""
        order = LogOrder()
        for channel, batch in self.batches(topics):
            order.add(channel.key, batch.log_ns)
        return order

    def messages(
        self, topics: Sequence[str] | None = None, *, as_recorded: bool = False
    ) -> Iterator[Message]:
        """The messages on `topics` (None: on all) by log time; equal log times as recorded.

        as_recorded: in the order of the files instead.
        """
        for raw in self._recorded(topics) if as_recorded else self.raws(topics):
            assert isinstance(raw, Raw)  # no chunk is taken as a whole
            channel = self.channels[raw.key]
            if raw.error:
                raise BagError(f"{self.path}: {channel.topic}: {raw.error}")
            yield Message(channel.topic, channel.msgtype, raw.log_ns, raw.data, raw.publish_ns)

    def raws(
        self,
        topics: Sequence[str] | None = None,
        *,
        nearly: bool = False,
        spans: Spans = ALWAYS,
        takes: Takes | None = None,
    ) -> Iterator[Raw | Whole]:
        """As `messages`, with all that is recorded of them, and those that cannot be unpacked.

        spans: only what was logged in one of them; no chunk outside is read. takes: which chunks
        come as they are, when their first message is due, if all of them is wanted.
        Raises BagError if so many chunks overlap in time that sorting needs MAX_OVERLAP_BYTES; with
        `nearly` they are sorted as far as that goes.
        """
        keys = self._keys_on(topics)
        order = sorted(
            (block.start_ns, n, i)
            for n, file in enumerate(self._data)
            for i, block in enumerate(file.contents.blocks)
            if any(block.start_ns < end and start <= block.end_ns for start, end in spans)
        )
        waiting: list[Raw] = []
        for (_, n, i), (later_ns, *_) in pairwise([*order, (NEVER,)]):
            whole = self._whole(n, i, keys, spans, takes) if takes else None
            if whole is not None:
                yield whole
            else:
                waiting += self._raws(n, i, keys)
                waiting.sort()
            ready = bisect_left(waiting, later_ns, key=attrgetter("log_ns"))
            if sum(len(raw.data) for raw in waiting[ready:]) > MAX_OVERLAP_BYTES:
                if not nearly:
                    raise BagError(
                        f"{self._data[n].path}: chunks of more than {MAX_OVERLAP_BYTES} bytes "
                        "overlap in time; sort the file first (`mcap sort`)"
                    )
                ready = len(waiting)
            for raw in waiting[:ready]:
                if any(start <= raw.log_ns < end for start, end in spans):
                    yield raw
            waiting = waiting[ready:]

    def _recorded(self, topics: Sequence[str] | None) -> Iterator[Raw]:
        """The messages in the order of the files."""
        keys = self._keys_on(topics)
        for n, file in enumerate(self._data):
            for i in range(len(file.contents.blocks)):
                yield from sorted(self._raws(n, i, keys), key=attrgetter("place"))

    def _whole(
        self, n: int, i: int, keys: Collection[int], spans: Spans, takes: Takes
    ) -> Whole | None:
        """The block, if all of it is wanted and taken, and nothing in it has to be translated."""
        file, known = self._data[n], self._keys[n]
        block = file.contents.blocks[i]
        inside = any(start <= block.start_ns and block.end_ns < end for start, end in spans)
        numbers = {number: known[number] for number in block.index or ()}
        wanted = inside and set(numbers.values()) <= set(keys) - self._translated.keys()
        if not isinstance(file, McapFile) or not wanted or not takes(block, numbers):
            return None
        with reading(file.path):
            found = file.whole(block)
        if found is None or any(packed(batch).any() for batch in found.messages.values()):
            return None
        return found

    def _raws(self, n: int, i: int, keys: Collection[int]) -> Iterator[Raw]:
        file = self._data[n]
        wanted = self._wanted(n, keys)
        with reading(file.path):
            for number, batch in file.block_batches(file.contents.blocks[i], wanted):
                plain = self._plain(wanted[number], batch)
                columns = (batch.log_ns, batch.start, batch.publish_ns, batch.sequence)
                rows = zip(*(column.tolist() for column in columns), strict=True)
                for k, (log_ns, at, publish_ns, sequence) in enumerate(rows):
                    error = plain.unreadable.get(k, "")
                    data = b"" if error else plain.data(k)
                    place = n, i, at
                    yield Raw(log_ns, place, wanted[number], publish_ns, sequence, data, error)

    def _plain(self, key: int, batch: Batch) -> Batch:
        """The messages in CDR."""
        translate = self._translated.get(key)
        if translate is None:
            if self.channels[key].encoding != "cdr" or not packed(batch).any():
                return batch
            translate = unpacked
        parts: list[bytes] = []
        unreadable: dict[int, str] = {}
        for i in range(len(batch)):
            data = batch.data(i)
            try:
                parts.append(translate(data))
            except BagError as error:
                parts.append(data)
                unreadable[i] = str(error)
        found = joined(parts, batch.log_ns)
        return replace(
            found,
            publish_ns=batch.publish_ns,
            sequence=batch.sequence,
            unreadable=unreadable,
        )

    def _keys_on(self, topics: Sequence[str] | None) -> list[int]:
        wanted = None if topics is None else set(topics)
        return [c.key for c in self.channels if wanted is None or c.topic in wanted]

    def _wanted(self, n: int, keys: Collection[int]) -> dict[int, int]:
        """The key of each channel that is wanted of a file, by its number there."""
        return {number: key for number, key in self._keys[n].items() if key in keys}

    def _why_unfinished(self) -> str | None:
        """Why the recording stops early; None if all of it is finished."""
        ends = [f"{f.path}: {f.contents.ending}" for f in self._data if f.contents.ending]
        if ends:  # of a bag that is one file that is said already
            return ends[-1].removeprefix(f"{self.path}: ")
        return None if self._described.finished else UNCLOSED

    def _unfinished(self) -> str:
        if self.ending == UNCLOSED:
            return (
                f"{self.path} has no metadata.yaml: the recording was not closed; "
                f"read {self.files[0].name} itself, or make a whole bag of it with {RECOVER}"
            )
        bytes_there = sum(file.stat().st_size for file in self.files)
        return (
            f"{self.path} is truncated or unfinished, without the summary that ends a bag: of "
            f"{bytes_there} bytes, {self.ending}; copy it again, or recover its complete chunks "
            f"with {RECOVER}"
        )


def _described(path: Path, *, salvage: bool) -> tuple[BagFiles, list[str]]:
    """What the bag is made of; with `salvage` also if its metadata are damaged, which is said."""
    try:
        found = bag_files(path)
    except BagError as error:
        files = data_files(path) if path.is_dir() else ()
        if not files:
            raise
        if not salvage:
            raise BagError(f"{error}; {RECOVER} reads the files without it") from error
        return BagFiles(files), [str(error)]
    if not salvage or not path.is_dir():
        return found, []
    return replace(found, files=tuple(without_twins((*found.files, *data_files(path))))), []
