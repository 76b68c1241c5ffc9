"""What the live benchmarks share: a domain of their own, node processes, CPU time of a process."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PATIENCE = 20.0  # s for a node to end


def isolate() -> None:
    """Fast DDS, on this machine only, on a domain of this process."""
    os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))


@contextmanager
def python(module: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A module in a process of its own, interrupted at the end."""
    running = subprocess.Popen([sys.executable, "-m", module, *arguments])
    try:
        yield running
    finally:
        if running.poll() is None:
            running.send_signal(signal.SIGINT)
        try:
            running.wait(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()


def node(module: str, **parameters: object) -> list[str]:
    """Arguments for `python` that start a node quietly with parameters."""
    settings = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
    return [f"nlsid_ros.{module}", "--ros-args", "--log-level", "warn", *settings]


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
