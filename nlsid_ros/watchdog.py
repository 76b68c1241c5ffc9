"""A process beside a node that ends the node if its executor stands still.

python watchdog.py PID NAME

No thread of the node could do this: rclpy holds Python's lock while it asks the middleware, and if
that waits for ever, no other thread of Python runs.

A node that works wakes ten times a second. It stands still if its first thread has been asleep
all the time without waking once. That is not so while it computes, reads or writes a disk, or is
stopped by a signal. On a machine that gives it no time it is not asleep either; and what waits for
another thread, or a watchdog that is itself not given any time, counts nothing.
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


def thread(folder: Path) -> tuple[str, int]:
    """Return a thread's state and how often it went to sleep or was put aside."""
    said = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    switches = said["voluntary_ctxt_switches"], said["nonvoluntary_ctxt_switches"]
    return said["State"].split()[0], sum(map(int, switches))


def threads(pid: int) -> dict[str, tuple[str, int]]:
    """Return state and switches of each thread of a process; none of one that is gone."""
    found = {}
    for folder in Path(f"/proc/{pid}/task").glob("*"):
        with suppress(OSError, KeyError, ValueError):  # it ended meanwhile
            found[folder.name] = thread(folder)
    return found


def stands_still(
    pid: int, before: dict[str, tuple[str, int]], now: dict[str, tuple[str, int]]
) -> bool:
    """Return whether the first thread slept since `before`, and no thread was kept from running."""
    first = now.get(str(pid), ("", 0))
    if first[0] != "S" or before.get(str(pid)) != first:
        return False
    return not any(
        state in WANTS_TO_RUN and before.get(tid) == (state, switches)
        for tid, (state, switches) in now.items()
    )


def watch(pid: int, name: str) -> None:
    """End the process `pid`, whose child this is, once it stands still; return when it is gone."""
    still, has_woken, before = 0, False, threads(pid)
    while os.getppid() == pid:
        began = time.monotonic()
        time.sleep(TICK)
        in_time = time.monotonic() - began < 2.0 * TICK
        now = threads(pid)
        has_woken |= before.get(str(pid), ("", 0))[1] != now.get(str(pid), ("", 0))[1]
        still = still + 1 if has_woken and in_time and stands_still(pid, before, now) else 0
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
