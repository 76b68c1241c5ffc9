"""How far work has come, told to whoever waits for it: `progress(what, fraction)`."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, float], None]


def silent(_what: str, _fraction: float) -> None:
    """Progress that nobody looks at."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Progress of a part of the work that begins at the fraction `start` and ends at `end`."""
    return lambda what, fraction: progress(what, start + (end - start) * fraction)
