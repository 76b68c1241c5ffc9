"""New bags from old ones: a stretch of time, some topics, several as one, or in parts."""

from bisect import bisect_right
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.message_types import are_same
from bags.recordings.storage import NEVER
from bags.recordings.writer import BagWriter
from bags.tools.copying import Copied, copy_messages
from nlsid_core.errors import BagError
from nlsid_core.progress import Progress, silent


@dataclass(frozen=True)
class Part:
    """A new bag: of messages logged from `start_ns` to before `end_ns`."""

    out: Path
    start_ns: int = 0
    end_ns: int = NEVER


def convert(
    bags: Sequence[Bag],
    parts: Sequence[Part],
    *,
    topics: Sequence[str] = (),
    progress: Progress = silent,
) -> Copied:
    """Copy the messages of open bags to new bags, by log time.

    Args:
        bags: of several, messages are merged; definitions that were given to a bag are written.
        parts: in the order of time, none overlapping another.
        topics: only these (none: all).
        progress: told how far it is.

    Returns:
        What was copied and what was not.

    Raises:
        BagError: if a topic is not there, if two bags have one topic with different types, if there
            is no message in any part, and if a part's bag exists.
    """
    for topic in topics:
        if not any(topic in bag.topics for bag in bags):
            there = ", ".join(name for bag in bags for name in bag.topics)
            raise BagError(f"{bags[0].path} has no topic {topic}; it has: {there}")
    first: dict[str, Bag] = {}
    custom: dict[str, str] = {}
    for bag in bags:
        for topic in bag.topics:
            _refuse_another_type(topic, first.setdefault(topic, bag), bag)
        for key, value in bag.custom.items():
            if custom.setdefault(key, value) != value:
                custom[key] = f"{custom[key]}; {value}"
    for part in parts:
        if part.out.exists():
            raise BagError(f"{part.out} exists already; name another bag or move it away")
    starts = [part.start_ns for part in parts]
    with ExitStack() as stack:
        writers = [stack.enter_context(BagWriter(part.out, custom=custom)) for part in parts]

        def choose(log_ns: int) -> BagWriter | None:
            k = bisect_right(starts, log_ns) - 1
            return writers[k] if k >= 0 and log_ns < parts[k].end_ns else None

        copied = copy_messages(bags, writers, choose, topics=topics or None, progress=progress)
        if not copied.messages:
            raise BagError(f"{bags[0].path} has no message there")
    return replace(copied, parts=[part.out for part in parts])


def stretch(bags: Sequence[Bag], out: Path, start: float, end: float | None) -> Part:
    """The part from `start` to before `end` s after the first message (None: to the last)."""
    origin = _start_ns(bags)
    end_ns = NEVER if end is None else origin + round(end * 1e9)
    return Part(out, origin + round(start * 1e9), end_ns)


def parts_every(bags: Sequence[Bag], out: Path, every: float) -> list[Part]:
    """Parts of `every` s, OUT_01 and so on; a rest of less than half of that goes with the last."""
    if not every > 0:
        raise BagError(f"a part of {every:g} s")
    first_ns = last_ns = _start_ns(bags)
    for bag in bags:
        for _, batch in bag.batches():
            last_ns = max(last_ns, int(np.max(batch.log_ns)))
    step_ns = round(every * 1e9)
    begins = [*range(first_ns, last_ns + 1, step_ns)]
    if len(begins) > 1 and 2 * (last_ns - begins[-1]) < step_ns:
        begins.pop()
    ends = [*begins[1:], last_ns + 1]
    return [
        Part(out.with_name(f"{out.name}_{k:02d}"), start_ns, end_ns)
        for k, (start_ns, end_ns) in enumerate(zip(begins, ends, strict=True), start=1)
    ]


def _start_ns(bags: Sequence[Bag]) -> int:
    filled = [bag.start_ns for bag in bags if any(channel.count for channel in bag.channels)]
    if not filled:
        raise BagError(f"{bags[0].path} has no messages")
    return min(filled)


def _refuse_another_type(topic: str, first: Bag, second: Bag) -> None:
    """BagError if two bags have a topic with two types, or with two definitions of its type."""
    if first is second:
        return
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
