"""Which bags a person means by a path: a bag, or a folder of bags."""

from collections.abc import Iterable
from pathlib import Path

from nlsid_core.errors import BagError

METADATA = "metadata.yaml"
DATA_FILES = (".mcap", ".db3")


def expand_bags(paths: Iterable[Path]) -> list[Path]:
    """Each path that is a bag itself, and the bags directly in each path that is not, by name.

    Raises BagError for a path that is not there or holds no bag.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise BagError(f"there is no bag {path}; name a rosbag2 folder or an .mcap file")
        if path.is_file() or _is_bag(path):
            found.append(path)
            continue
        inside = sorted(p for p in path.iterdir() if p.is_dir() and _is_bag(p))
        if not inside:
            raise BagError(f"{path} is not a bag and holds none (no {' or '.join(DATA_FILES)})")
        found += inside
    return list(dict.fromkeys(found))


def _is_bag(folder: Path) -> bool:
    return (folder / METADATA).is_file() or any(p.suffix in DATA_FILES for p in folder.iterdir())
