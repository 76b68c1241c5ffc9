"""A ROS domain for every test, so that none hears what another left behind."""

import itertools
import os

DOMAINS = 101  # those that are safe to use on every platform
_domains = itertools.count()


def fresh_domain() -> str:
    """A domain per test: the nodes that a test before killed are still announced for a while."""
    return str(1 + (os.getpid() + next(_domains)) % DOMAINS)
