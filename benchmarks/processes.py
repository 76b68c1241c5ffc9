"""What the live benchmarks share: the nodes' processes, and the processor time of one."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

from nlsid_ros import processes
from nlsid_ros.processes import isolate

__all__ = ["busy", "cpu_seconds", "isolate", "node", "python", "resident_mb"]


def python(module: str, *arguments: str) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """A module in a process of its own, interrupted at the end."""
    return processes.python(module, arguments)


def node(module: str, **parameters: object) -> list[str]:
    """Arguments for `python` that start a node quietly with parameters."""
    return [f"nlsid_ros.{module}", *processes.settings(parameters)]


@contextmanager
def busy(count: int, cores: set[int]) -> Iterator[None]:
    """So many processes that only compute, on these cores."""
    with ExitStack() as stack:
        for _ in range(count):
            burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(burner.wait)
            stack.callback(burner.kill)
            os.sched_setaffinity(burner.pid, cores)
        yield


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Memory of a process that is in use now, in MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
