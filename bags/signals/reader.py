"""Read signals from a bag: numbers with the stamps of the messages they came in."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from rosbags.typesys.store import Typestore

from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.recordings.remote import RemotePath
from bags.signals.columns import Columns, expand_paths, read_columns
from bags.signals.expressions import Expression
from bags.signals.publishers import two_curves
from bags.signals.timing import without_duplicates
from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

HEADER_STAMP: Final = "header stamp"
LOG_TIME: Final = "log time"
PUBLISH_TIME: Final = "publish time"
CLOCKS: Final = (HEADER_STAMP, LOG_TIME, PUBLISH_TIME)


class SamplesError(BagError):
    """A bag that was read, with a signal that cannot be used: NaN, or time that goes back."""


@dataclass(frozen=True, eq=False)
class Samples:
    """A signal as recorded; arrays are read-only.

    stamp_ns: (N,) ns since the epoch, not decreasing. values: (N,) finite, in `unit` ("": unknown).
    clock: where the stamps come from, one of CLOCKS. counted: why the messages' counts are not of
    one publisher; empty if they can be.
    """

    path: str
    stamp_ns: IntArray
    values: FloatArray
    clock: str = HEADER_STAMP
    unit: str = ""
    counted: str = ""

    def __post_init__(self) -> None:
        self.stamp_ns.setflags(write=False)
        self.values.setflags(write=False)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def doubt(self, *, responds: bool) -> str:
        """Say why nobody knows whose signal this is: it has several publishers; else empty.

        responds: whether it is measured. A command may jump as it likes.
        """
        said = self.counted or (two_curves(self.stamp_ns, self.values) if responds else "")
        return f"{self.path}: {said}" if said else ""


def read_signals(
    bag: Bag | Path | str,
    paths: Sequence[str],
    *,
    clock: str | None = None,
    sort: bool = False,
    drop_duplicates: bool = False,
    unfinished: bool = False,
    gaps_in: Sequence[str] = (),
    definitions: Mapping[str, Definition] | None = None,
    progress: Progress = silent,
) -> dict[str, Samples]:
    """The signals `paths` (see `bags.signals.signal`, `bags.signals.expressions`) of a bag.

    bag: where it is; or one that is open, for which unfinished and definitions were said then.
    clock: which times are the stamps of the signals whose text has no `|clock(...)` (None: header
    stamps, log time for types without a header).
    sort: put messages in the order of their stamps instead of refusing stamps that go back.
    drop_duplicates: of messages with one stamp keep the first.
    unfinished: read what there is of a recording that was not closed.
    gaps_in: those of `paths` whose messages without a finite number are left out, not refused.
    definitions: of message types that the bag does not define.
    `[*]` gives one entry per element. Every path is checked against the types in the bag before a
    message is read. Raises BagError, naming the bag, if the bag is missing, unfinished or damaged;
    if a topic or field does not exist or is no number; if a topic has no messages; SamplesError if
    a value is not finite or time goes back.
    """
    if clock is not None and clock not in CLOCKS:
        raise BagError(f"no clock '{clock}'; there are: {', '.join(CLOCKS)}")
    named = {"header": HEADER_STAMP, "log": LOG_TIME, "": clock}
    with _opened(bag, unfinished, definitions) as source:
        wanted = expanded(source, paths)
        kinds = {e.path.topic: source.types_on(e.path.topic) for e in wanted.values()}
        for expression in wanted.values():
            _checked_unit(source, expression, *kinds[expression.path.topic])
        columns = read_columns(
            source, {name: e.path for name, e in wanted.items()}, progress=progress
        )
        topics: dict[tuple[str, str | None], _Topic] = {}
        samples = {}
        for name, expression in wanted.items():
            topic = expression.path.topic
            key = topic, named[expression.clock]
            if key not in topics:
                topics[key] = _Topic(source, columns[topic], key[1], sort=sort)
                topics[key].check_stamps(source.count(topic))
                if drop_duplicates:
                    topics[key].drop_duplicates()
            gaps = name in gaps_in or expression.path.framed
            recorded = topics[key].samples(name, gaps=gaps)
            recorded = replace(recorded, counted=columns[topic].doubt(name, responds=False))
            samples[name] = _applied(source, expression, recorded, kinds[topic], gaps=gaps)
    return samples


def expanded(bag: Bag, texts: Sequence[str]) -> dict[str, Expression]:
    """The signals by their texts, those with `[*]` replaced by one for each element.

    Raises BagError if a path does not fit the bag, or if there is no message to count in.
    """
    found: dict[str, Expression] = {}
    for text in texts:
        signal = Expression.parse(text)
        for path in expand_paths(bag, [signal.path]):
            found[str(signal.of(path)) if signal.path.every else text] = signal.of(path)
    return found


def bag_digest(bag: Path | str) -> str:
    """`sha256:<hex>` of the bag's data file (of its data files, joined in their order)."""
    digest: str = bag_origin(bag)["digest"]
    return digest


def bag_origin(bag: Bag | Path | str, *, unfinished: bool = False) -> Json:
    """What a dataset's provenance says of a bag: digest, files with their sizes, custom data.

    The digest of a remote file is of what storage says of it and of its end (docs/decisions/0027):
    its content is not read for it.
    """
    with _opened(bag, unfinished) as source:
        digest = hashlib.sha256()
        for file in source.files:
            if isinstance(file, RemotePath):
                digest.update(file.identity())
                continue
            with file.open("rb") as stream:
                while block := stream.read(2**20):
                    digest.update(block)
        return {
            "digest": f"sha256:{digest.hexdigest()}",
            "files": {file.name: file.stat().st_size for file in source.files},
            "custom": source.custom,
        }


def _opened(
    bag: Bag | Path | str,
    unfinished: bool,
    definitions: Mapping[str, Definition] | None = None,
) -> AbstractContextManager[Bag]:
    """The bag, opened and closed here unless it is open."""
    if isinstance(bag, Bag):
        return nullcontext(bag)
    return Bag(bag, unfinished=unfinished, definitions=definitions)


def stamp_text(stamp_ns: int) -> str:
    """A stamp for people: seconds with all nine decimals."""
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(stamp_ns) // 10**9}.{abs(stamp_ns) % 10**9:09d} s"


def _checked_unit(source: Bag, expression: Expression, msgtype: str, types: Typestore) -> str:
    try:
        return expression.unit(msgtype, types)
    except BagError as error:
        raise BagError(f"{source.path}: {error}") from error


def _applied(
    source: Bag,
    expression: Expression,
    recorded: Samples,
    kind: tuple[str, Typestore],
    *,
    gaps: bool,
) -> Samples:
    """The recorded numbers after the expression's operations, from the first that has a result."""
    unit = expression.unit(*kind)
    if not expression.numbers.operations:
        return replace(recorded, unit=unit)
    try:
        values = expression.apply(
            recorded.values, recorded.stamp_ns, expression.recorded_unit(*kind)
        )
    except BagError as error:
        raise BagError(f"{source.path}: {error}") from error
    finite = np.isfinite(values)
    kept = finite if gaps else np.arange(len(values)) >= int(np.argmax(finite))
    if not (finite[kept].all() and kept.any()):
        missing = int(np.flatnonzero(kept & ~finite)[0])
        raise SamplesError(
            f"{source.path}: {expression} has no value at message {missing}, "
            f"{stamp_text(int(recorded.stamp_ns[missing]))}: too few samples before it; take a "
            "longer window, or cut the bag at the gap"
        )
    return replace(recorded, stamp_ns=recorded.stamp_ns[kept], values=values[kept], unit=unit)


class _Topic:
    """One topic's columns, with the stamps of the chosen clock, checked."""

    def __init__(self, source: Bag, columns: Columns, clock: str | None, *, sort: bool) -> None:
        self._where = f"{source.path}: {columns.topic}"
        self._bag = source.path
        self._values = columns.values
        if clock is None:
            clock = LOG_TIME if columns.stamp_ns is None else HEADER_STAMP
        self._clock = clock
        if clock == HEADER_STAMP:
            if columns.stamp_ns is None:
                raise BagError(
                    f"{self._where}: its messages have no header stamp; choose {LOG_TIME}"
                )
            self._stamps = columns.stamp_ns
        else:
            self._stamps = columns.log_ns if clock == LOG_TIME else columns.publish_ns
        self._back = columns.back if clock == LOG_TIME and not sort else ()
        if sort and (np.diff(self._stamps) < 0).any():
            order = np.argsort(self._stamps, kind="stable")
            self._stamps = self._stamps[order]
            self._values = {name: values[order] for name, values in columns.values.items()}

    def check_stamps(self, expected: int) -> None:
        stamps = self._stamps
        if len(stamps) != expected:
            raise BagError(
                f"{self._where} has {len(stamps)} messages, the bag's index says {expected}; "
                "the bag is damaged"
            )
        if not len(stamps):
            raise BagError(f"{self._where} has no messages; was its publisher running?")
        if self._clock == HEADER_STAMP and not stamps.any():
            raise SamplesError(
                f"{self._where}: every header stamp is 0; its publisher does not fill it in"
            )
        back = self._back or [
            (int(i) + 1, int(stamps[i]), int(stamps[i + 1]))
            for i in np.flatnonzero(np.diff(stamps) < 0)
        ]
        if back:
            at, before, after = back[0]
            raise SamplesError(
                f"{self._where}: time goes back by {(before - after) / 1e9:g} s at message {at}: "
                f"{self._clock} {stamp_text(before)}, then {stamp_text(after)} "
                f"({len(back)} such {'place' if len(back) == 1 else 'places'})"
            )

    def drop_duplicates(self) -> None:
        kept = without_duplicates(self._stamps)
        if len(kept) < len(self._stamps):
            self._stamps = self._stamps[kept]
            self._values = {name: values[kept] for name, values in self._values.items()}

    def samples(self, name: str, *, gaps: bool) -> Samples:
        values = self._values[name]
        finite = np.isfinite(values)
        if gaps and finite.any():
            return Samples(name, self._stamps[finite], values[finite], self._clock)
        if len(bad := np.flatnonzero(~finite)):
            i = int(bad[0])
            raise SamplesError(
                f"{self._bag}: {name} is {values[i]} in message {i} at "
                f"{stamp_text(int(self._stamps[i]))} ({len(bad)} of {len(values)} messages "
                "are not finite); record it again or cut the bag there"
            )
        return Samples(name, self._stamps, values, self._clock)
