"""New bags from old ones: a part of one, several as one, one in parts."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.recordings.message_types import are_same
from bags.recordings.writer import BagWriter
from bags.signals.reader import read_signals, stamp_text
from bags.signals.repeats import find_period
from bags.tools.copying import Copied, copy_messages
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent


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
) -> Copied:
    """Copy the messages logged from `start` to before `end` s after the first (None: to the last).

    Only those on `topics` (None: on all). definitions: of types that the bag does not define; the
    copy does. Raises BagError for a bag that cannot be read, for a topic that is not there, if
    nothing is left, and if `out` exists.
    """
    with Bag(path, unfinished=unfinished, definitions=definitions) as bag:
        for topic in topics or ():
            if topic not in bag.topics:
                raise BagError(f"{path} has no topic {topic}; it has: {', '.join(bag.topics)}")
        origin = _first_ns(bag)
        low = origin + round(start * 1e9)
        high = None if end is None else origin + round(end * 1e9)
        with BagWriter(out, custom=bag.custom) as writer:

            def choose(log_ns: int) -> BagWriter | None:
                return writer if low <= log_ns and (high is None or log_ns < high) else None

            copied = copy_messages([bag], [writer], choose, topics=topics, progress=progress)
            if not copied.messages:
                raise BagError(f"{path} has no message from {start:g} s to {end or np.inf:g} s")
    return copied


def merge(paths: Sequence[Path | str], out: Path | str, *, progress: Progress = silent) -> Copied:
    """Copy several bags into one, by log time.

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
        first: dict[str, Bag] = {}
        for bag in bags:
            for topic in bag.topics:
                _refuse_another_type(topic, first.setdefault(topic, bag), bag)
        writer = stack.enter_context(BagWriter(out, custom=custom))
        return copy_messages(bags, [writer], lambda _: writer, progress=progress)


def _refuse_another_type(topic: str, first: Bag, second: Bag) -> None:
    """BagError if two bags have a topic with two types, or with two definitions of its type."""
    types = []
    for bag in (first, second):
        try:
            types.append(bag.types_on(topic))
        except BagError:  # nothing is known of what is copied as it is
            return
    (one, defined), (other, redefined) = types
    if one != other:
        raise BagError(
            f"{topic} holds '{one}' in {first.path} and '{other}' in {second.path}; a topic has "
            "one type: keep them in two bags"
        )
    if not are_same(defined, redefined):
        raise BagError(
            f"{second.path}: {topic} comes with two definitions of '{one}'; keep them in two bags"
        )


def split(
    path: Path | str,
    out: Path | str,
    *,
    repeats: str | None = None,
    every: float | None = None,
    progress: Progress = silent,
) -> Copied:
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

        def choose(log_ns: int) -> BagWriter | None:
            k = int(np.searchsorted(edges_ns, log_ns, side="right")) - 1
            return writers[k] if 0 <= k < len(writers) else None

        copied = copy_messages([bag], writers, choose, progress=progress)
        return replace(copied, parts=parts)


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
        raise BagError(f"{path}: {repeats} does not repeat itself; split it by time, with --every")
    count = len(samples) // found
    edges = [int(samples.stamp_ns[k * found]) for k in range(count)]
    last = count * found
    edges.append(int(samples.stamp_ns[last - 1]) + step_ns)
    group = f"{repeats}, {count} times from {stamp_text(edges[0])}"
    return edges, {"repeat_group": group}


def _first_ns(bag: Bag) -> int:
    first = next(bag.raws(), None)
    if first is None:
        raise BagError(f"{bag.path} has no messages")
    return first.log_ns
