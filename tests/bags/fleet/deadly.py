"""A task that ends its worker, in a module that a worker imports quickly."""

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Deadly:
    """It answers with the bag's name, except that it ends the process at some."""

    folder: Path
    always: str = ""
    once: str = ""
    asked: str = "deadly"

    def __call__(self, bag: Path, name: str) -> bytes:
        mark = self.folder / f"{name}.done"
        if name == self.always or (name == self.once and not mark.exists()):
            mark.write_text("")
            os._exit(1)
        return bag.name.encode()
