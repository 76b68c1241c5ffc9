"""A process beside a node that ends the node if its executor stands still.

python watchdog.py PID NAME

No thread of the node could do this: rclpy holds Python's lock while it asks the middleware, and if
that waits for ever, no other thread of Python runs.

A node that works wakes ten times a second. It stands still if its first thread has been asleep
all the time without waking once. That is not so while it computes, reads or writes a disk, or is
stopped by a signal. On a machine that gives it no time it is not asleep either. Time in which a
thread waits to run, or in which the watchdog itself is given none, counts nothing.
"""

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

TICK = 0.1  # s between looks
PATIENCE = 2.0  # s
WANTS_TO_RUN = "RD"  # states of a thread that is ready to run, or waits for a disk
Threads = dict[str, tuple[str, int]]  # by number: state, and how often it went to sleep


def thread(folder: Path) -> tuple[str, int]:
    """Return a thread's state and how often it went to sleep or was put aside."""
    said = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    switches = said["voluntary_ctxt_switches"], said["nonvoluntary_ctxt_switches"]
    return said["State"].split()[0], sum(map(int, switches))


def threads(pid: int) -> Threads:
    """Return state and switches of each thread of a process; nothing if the process is gone."""
    found = {}
    for folder in Path(f"/proc/{pid}/task").glob("*"):
        with suppress(OSError, KeyError, ValueError):  # it ended meanwhile
            found[folder.name] = thread(folder)
    return found


def slept(pid: int, before: Threads, now: Threads) -> bool:
    """Return whether the first thread has been asleep since `before` without waking."""
    first = now.get(str(pid), ("", 0))
    return first[0] == "S" and before.get(str(pid)) == first


def is_starved(before: Threads, now: Threads) -> bool:
    """Return whether a thread has wanted to run since `before` and could not."""
    return any(
        state in WANTS_TO_RUN and before.get(tid) == (state, switches)
        for tid, (state, switches) in now.items()
    )


def watch(pid: int, name: str) -> None:
    """End the process `pid`, whose child this is, once it stands still; return when it is gone."""
    still, before = 0, threads(pid)
    while os.getppid() == pid:
        began = time.monotonic()
        time.sleep(TICK)
        in_time = time.monotonic() - began < 2.0 * TICK
        now = threads(pid)
        if not slept(pid, before, now):
            still = 0
        elif in_time and not is_starved(before, now):
            still += 1
        before = now
        if still * TICK >= PATIENCE:
            say(f"{name}: the executor has stood still for {PATIENCE:g} s: ended by its watchdog\n")
            os.kill(pid, signal.SIGABRT)
            return


def say(text: str) -> None:
    """Write to standard error, unless that is what everything waits for."""
    os.set_blocking(2, False)
    with suppress(OSError):
        os.write(2, text.encode())


if __name__ == "__main__":
    watch(int(sys.argv[1]), sys.argv[2])
