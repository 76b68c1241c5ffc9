"""Which recordings of a folder can be identified from: those that are finished and have it all."""

from collections.abc import Collection, Sequence
from pathlib import Path

from bags.recordings.bag import Bag
from bags.recordings.folders import expand_bags
from bags.signals.recording import SNAPSHOT
from nlsid_core.errors import BagError


def finished_bags(
    paths: Sequence[Path], topics: Collection[str] = (), *, last: int = 0
) -> tuple[list[Path], dict[Path, str]]:
    """Finished recordings among bags and folders of bags, and the others with the reason.

    A recording that is not closed yet does not count, nor a snapshot (its messages are in a
    recording too), nor what has no message on one of `topics`. last: only the last so many of
    them, the newest last; 0: all, in the order given. Raises BagError if there are not so many.
    """
    found: list[tuple[int, Path]] = []
    left_out: dict[Path, str] = {}
    for path in expand_bags(paths):
        with Bag(path, unfinished=True) as bag:
            first = next(bag.messages(), None)
            silent = [topic for topic in topics if topic not in bag.topics or not bag.count(topic)]
            if bag.ending is not None:
                left_out[path] = "it is not closed: still being recorded, or broken off"
            elif SNAPSHOT in bag.custom:
                left_out[path] = "it is a snapshot, whose messages are in a recording too"
            elif first is None or silent:
                left_out[path] = f"it has nothing on {' and '.join(silent) or 'any topic'}"
            else:
                found.append((first.log_time_ns, path))
    if len(found) < max(last, 1):
        there = ", ".join(map(str, paths))
        why = "".join(f"; {path.name}: {reason}" for path, reason in left_out.items())
        raise BagError(
            f"{max(last, 1)} recordings are asked for, {len(found)} can be used in {there}{why}"
        )
    bags = sorted(found)[-last:] if last else found
    return [path for _, path in bags], left_out
