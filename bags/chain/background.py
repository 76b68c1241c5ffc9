"""Identification in a process of its own: watched, cancelled, and never in anyone's way."""

import multiprocessing
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

from bags.chain.config import load_config
from bags.chain.steps import identify_bags
from bags.recordings.bag import Bag
from bags.recordings.folders import expand_bags
from bags.signals.recording import SNAPSHOT
from nlsid_core.errors import BagError, NlsidError


@dataclass(frozen=True)
class Progress:
    """What it is doing and how far it is (0 to 1).

    error: why it failed, empty if it did not. left_out: recordings that are not used, and why.
    """

    what: str
    fraction: float
    done: bool = False
    error: str = ""
    left_out: tuple[str, ...] = ()


class BackgroundIdentification:
    """`identify_bags` in a fresh process, which inherits nothing but its arguments.

    Of the bags those are used that `finished_bags` finds and that have the configured topics.
    last: only the last so many of them; 0: all.
    """

    def __init__(self, bags: Sequence[Path], config: Path, out: Path, *, last: int = 0) -> None:
        context = multiprocessing.get_context("spawn")
        self._progress = Progress("starting", 0.0)
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_identify, args=(list(bags), config, out, last, sender), daemon=True
        )
        self._process.start()
        sender.close()

    def poll(self) -> Progress:
        """How far it is now."""
        try:
            while not self._progress.done and self._receiver.poll():
                self._progress = self._receiver.recv()
        except EOFError:
            self._process.join()
            why = f"the process ended with status {self._process.exitcode}"
            self._progress = replace(self._progress, what="failed", done=True, error=why)
        return self._progress

    def cancel(self) -> None:
        """End it; nothing is left half-written, as every file appears whole or not at all."""
        self._process.kill()
        self._process.join()
        if not self._progress.done:
            self._progress = replace(self._progress, what="cancelled", done=True)


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


def _identify(bags: list[Path], config: Path, out: Path, last: int, sender: Connection) -> None:
    left_out: tuple[str, ...] = ()

    def say(what: str, fraction: float, *, done: bool = False, error: str = "") -> None:
        sender.send(Progress(what, fraction, done, error, left_out))

    try:
        settings = load_config(config)
        used, others = finished_bags(bags, settings.signals.topics, last=last)
        left_out = tuple(f"{path.name}: {reason}" for path, reason in others.items())
        identify_bags(used, settings, out, progress=say)
    except (NlsidError, OSError) as error:
        say("failed", 1.0, done=True, error=str(error))
    else:
        say("done", 1.0, done=True)
