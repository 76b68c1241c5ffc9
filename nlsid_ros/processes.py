"""Nodes as processes of their own: where they may talk, how they start, how they end."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

PATIENCE = 30.0  # s for a process to end when asked to, on a loaded machine


def isolate() -> None:
    """Fast DDS, on this machine only, on a domain of this process, unless the environment says."""
    os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))


@contextmanager
def python(module: str, arguments: Sequence[str] = ()) -> Iterator[subprocess.Popen[bytes]]:
    """A module in a process of its own, interrupted at the end and waited for."""
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


def settings(parameters: Mapping[str, object], level: str = "warn") -> list[str]:
    """Arguments that start a node with parameters; a string is taken as it is.

    level: of what it logs, the least.
    """
    written = {
        name: value if isinstance(value, str) else json.dumps(value, default=str)
        for name, value in parameters.items()
    }
    given = [part for name, text in written.items() for part in ("-p", f"{name}:={text}")]
    return ["--ros-args", "--log-level", level, *given]
