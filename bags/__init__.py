"""Bags (MCAP) to and from data; the command line `nlsid`.

Importing it loads nothing: `read` brings its module along when it is first used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bags.signals.grid import read_dataset as read

__all__ = ["read"]


def __getattr__(name: str) -> object:
    if name != "read":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from bags.signals.grid import read_dataset

    return read_dataset
