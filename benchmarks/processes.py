"""What the live benchmarks share: the nodes' processes, and the processor time of one."""

import os
from pathlib import Path

from nlsid_ros.processes import isolate, node, python

__all__ = ["cpu_seconds", "isolate", "node", "python"]


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
