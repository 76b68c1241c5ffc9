"""Identification in a process of its own: watched, cancelled, and never in anyone's way."""

import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from bags.chain.config import load_config
from bags.chain.steps import identify_bags
from bags.recordings.bag import Bag
from bags.recordings.folders import expand_bags
from bags.signals.arrivals import SNAPSHOT
from nlsid_core.errors import BagError, NlsidError


@dataclass(frozen=True)
class Progress:
    """What it is doing and how far it is (0 to 1). error: why it failed, empty if it did not."""

    what: str
    fraction: float
    done: bool = False
    error: str = ""


class BackgroundIdentification:
    """`identify_bags` in a fresh process, which inherits nothing but its arguments.

    last: only the last so many of the bags, see `last_bags`; 0: all.
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
            self._progress = Progress("failed", self._progress.fraction, done=True, error=why)
        return self._progress

    def cancel(self) -> None:
        """End it; nothing is left half-written, as every file appears whole or not at all."""
        self._process.kill()
        self._process.join()
        if not self._progress.done:
            self._progress = Progress("cancelled", self._progress.fraction, done=True)


def last_bags(paths: Sequence[Path], count: int) -> list[Path]:
    """The last `count` finished recordings among bags and folders of bags, the newest last.

    A recording that is not closed yet and a snapshot (its messages are in a recording too) do not
    count. Raises BagError if there are not so many.
    """
    started: list[tuple[int, Path]] = []
    for path in expand_bags(paths):
        with Bag(path, unfinished=True) as bag:
            first = next(bag.messages(), None)
            if bag.ending is None and SNAPSHOT not in bag.custom and first is not None:
                started.append((first.log_time_ns, path))
    if len(started) < count:
        there = ", ".join(map(str, paths))
        raise BagError(f"{count} recordings are asked for, {len(started)} are finished in {there}")
    return [path for _, path in sorted(started)[-count:]]


def _identify(bags: list[Path], config: Path, out: Path, last: int, sender: Connection) -> None:
    try:
        identify_bags(
            last_bags(bags, last) if last else expand_bags(bags),
            load_config(config),
            out,
            progress=lambda what, fraction: sender.send(Progress(what, fraction)),
        )
    except (NlsidError, OSError) as error:
        sender.send(Progress("failed", 1.0, done=True, error=str(error)))
    else:
        sender.send(Progress("done", 1.0, done=True))
