"""Read signals from a bag: numbers with the stamps of the messages they came in."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from bags.recordings.bag import Bag
from bags.recordings.remote import RemotePath
from bags.signals.columns import Columns, expand_path, read_columns
from bags.signals.expressions import Expression
from bags.signals.publishers import two_curves
from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent

HEADER_STAMP: Final = "header stamp"
LOG_TIME: Final = "log time"


class SamplesError(BagError):
    """A bag that was read, with a signal that cannot be used: NaN, or time that goes back."""


@dataclass(frozen=True, eq=False)
class Samples:
    """A signal as recorded; arrays are read-only.

    stamp_ns: (N,) ns since the epoch, not decreasing. values: (N,) finite, in `unit` ("": unknown).
    clock: where the stamps come from, HEADER_STAMP or LOG_TIME. counted: why the messages' counts
    are not of one publisher; empty if they can be.
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
    sort: bool = False,
    gaps_in: Sequence[str] = (),
    progress: Progress = silent,
) -> dict[str, Samples]:
    """Read the signals `paths` (see `bags.signals.signal`, `bags.signals.expressions`) of a bag.

    `[*]` gives one entry per element. Stamps are the header's, the log times for types without a
    header; a text with `|clock(...)` says itself which. Every path is checked against the types in
    the bag before a message is read.

    Args:
        bag: where it is, or one that is open.
        paths: the signals' texts.
        sort: put messages in the order of their stamps instead of refusing stamps that go back.
        gaps_in: those of `paths` whose messages without a finite number are left out, not refused.
        progress: told how far it is.

    Returns:
        Samples by the signals' texts.

    Raises:
        BagError: names the bag, if it is missing, unfinished or damaged; if a topic or field does
            not exist or is no number; if a topic has no messages.
        SamplesError: if a value is not finite or time goes back.
    """
    with _opened(bag) as source:
        wanted = expanded(source, paths)
        kinds = {e.path.topic: source.types_on(e.path.topic) for e in wanted.values()}
        with _naming(source):
            for expression in wanted.values():
                expression.unit(*kinds[expression.path.topic])
        columns = read_columns(
            source, {name: e.path for name, e in wanted.items()}, progress=progress
        )
        stamped: dict[tuple[str, str], _Stamped] = {}
        samples = {}
        for name, expression in wanted.items():
            topic = expression.path.topic
            key = topic, expression.clock
            if key not in stamped:
                stamped[key] = _stamped(source, columns[topic], expression.clock, sort=sort)
            gaps = name in gaps_in or expression.path.framed
            recorded = _recorded(source, name, stamped[key], gaps=gaps)
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
        for path in expand_path(bag, signal.path):
            single = replace(signal, path=path)
            found[str(single) if signal.path.every else text] = single
    return found


def bag_digest(bag: Path | str) -> str:
    """`sha256:<hex>` of the bag's data file (of its data files, joined in their order)."""
    return str(bag_origin(bag)["digest"])


def bag_origin(bag: Bag | Path | str) -> Json:
    """What a dataset's provenance says of a bag: digest, files with their sizes, custom data.

    The digest of a remote file is of what storage says of it and of its end (docs/decisions/0027):
    its content is not read for it.
    """
    with _opened(bag) as source:
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


def _opened(bag: Bag | Path | str) -> AbstractContextManager[Bag]:
    """The bag, opened and closed here unless it is open."""
    return nullcontext(bag) if isinstance(bag, Bag) else Bag(bag)


@contextmanager
def _naming(source: Bag) -> Iterator[None]:
    """Let errors name the bag."""
    try:
        yield
    except BagError as error:
        raise BagError(f"{source.path}: {error}") from error


def stamp_text(stamp_ns: int) -> str:
    """A stamp for people: seconds with all nine decimals."""
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(stamp_ns) // 10**9}.{abs(stamp_ns) % 10**9:09d} s"


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
    with _naming(source):
        values = expression.apply(
            recorded.values, recorded.stamp_ns, expression.recorded_unit(*kind)
        )
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


class _Stamped(NamedTuple):
    """One topic's columns by the stamps of a clock, which were checked."""

    columns: Columns
    stamp_ns: IntArray
    clock: str


def _stamped(source: Bag, columns: Columns, clock: str, *, sort: bool) -> _Stamped:
    """The columns by `header` or `log` stamps (empty: by those there are); BagError if wrong."""
    where, expected = f"{source.path}: {columns.topic}", source.count(columns.topic)
    if len(columns) != expected:
        raise BagError(
            f"{where} has {len(columns)} messages, the bag's index says {expected}; "
            "the bag is damaged"
        )
    if not expected:
        raise BagError(f"{where} has no messages; was its publisher running?")
    if clock == "header" and columns.stamp_ns is None:
        raise BagError(f"{where}: its messages have no header stamp; choose {LOG_TIME}")
    header = None if clock == "log" else columns.stamp_ns
    stamps, called = (columns.log_ns, LOG_TIME) if header is None else (header, HEADER_STAMP)
    if called == HEADER_STAMP and not stamps.any():
        raise SamplesError(f"{where}: every header stamp is 0; its publisher does not fill it in")
    falls = np.flatnonzero(np.diff(stamps) < 0)
    if sort:
        order = np.argsort(stamps, kind="stable") if len(falls) else slice(None)
        return _Stamped(columns.select(order), stamps[order], called)
    back = columns.back if called == LOG_TIME else ()
    back = back or [(int(i) + 1, int(stamps[i]), int(stamps[i + 1])) for i in falls]
    if back:
        at, before, after = back[0]
        raise SamplesError(
            f"{where}: time goes back by {(before - after) / 1e9:g} s at message {at}: "
            f"{called} {stamp_text(before)}, then {stamp_text(after)} "
            f"({len(back)} such {'place' if len(back) == 1 else 'places'})"
        )
    return _Stamped(columns, stamps, called)


def _recorded(source: Bag, name: str, topic: _Stamped, *, gaps: bool) -> Samples:
    """A signal's finite values; SamplesError for others, unless `gaps` leaves them out."""
    values, stamps = topic.columns.values[name], topic.stamp_ns
    finite = np.isfinite(values)
    if gaps and finite.any():
        return Samples(name, stamps[finite], values[finite], topic.clock)
    if len(bad := np.flatnonzero(~finite)):
        i = int(bad[0])
        raise SamplesError(
            f"{source.path}: {name} is {values[i]} in message {i} at "
            f"{stamp_text(int(stamps[i]))} ({len(bad)} of {len(values)} messages "
            "are not finite); record it again or cut the bag there"
        )
    return Samples(name, stamps, values, topic.clock)
