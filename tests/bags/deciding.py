"""What a receiver of a bundle is told."""

import time

from bags.designs.bundle import Check
from nlsid_core.arrays import Json


def decide(text: str) -> Json:
    """What a receiver is told."""
    check = Check(text)
    while (answer := check.poll()) is None:
        time.sleep(0.01)
    check.close()
    return answer
