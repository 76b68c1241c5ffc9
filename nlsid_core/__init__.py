"""From recorded data to provably stable models, proved funnels and live monitors.

Importing it loads nothing: a name of `__all__` brings its module along when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nlsid_core.documents import load
    from nlsid_core.dynamics import Nominal, VectorField

__all__ = ["Nominal", "VectorField", "load"]

HOMES = {
    "Nominal": "nlsid_core.dynamics",
    "VectorField": "nlsid_core.dynamics",
    "load": "nlsid_core.documents",
}


def __getattr__(name: str) -> object:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(HOMES[name]), name)
