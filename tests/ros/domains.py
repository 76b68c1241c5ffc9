"""A ROS domain for every test, that nobody else on this machine has at the same time."""

import itertools
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

DOMAINS = 101  # those that are safe to use on every platform
_tried = itertools.count(os.getpid())


@contextmanager
def own_domain() -> Iterator[None]:
    """Let nodes here and in processes started here see only each other, on this machine.

    Tests also run in two processes at once. A domain is taken by the TCP port that has the number
    of its first UDP port: the system gives it to one process, and takes it back from a dead one.
    The next test takes another: nodes that were killed are still announced for a while.
    """
    with socket.socket() as taken, pytest.MonkeyPatch.context() as patch:
        patch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_DOMAIN_ID", str(_take(taken)))
        yield


def _take(taken: socket.socket) -> int:
    for _ in range(DOMAINS):
        domain = 1 + next(_tried) % DOMAINS
        try:
            taken.bind(("127.0.0.1", 7400 + 250 * domain))
        except OSError:
            continue
        return domain
    raise RuntimeError(f"all {DOMAINS} ROS domains of this machine are in use")
