"""The bags of a fleet by name: where they lie below the folder, or the pattern, that was given."""

from collections.abc import Sequence
from pathlib import Path

from bags.recordings.folders import expand_bags
from bags.recordings.remote import place
from nlsid_core.errors import DataError

WILD = frozenset("*?[")


def named_bags(given: Sequence[Path], *, patience: float | None = None) -> dict[str, Path]:
    """The bags that paths, URLs and patterns mean, by name, in the order of their names.

    A name is what follows the given folder, or the folders of a pattern before its first `*`, less
    the file's ending: `robot_3/drive_01` of `s3://fleet/*/drive_*.mcap`. It stays when others come.
    patience: s, of each bag, that may be lost with requests that fail. Raises BagError if there is
    none, DataError if two have one name.
    """
    found: dict[str, Path] = {}
    for path in (place(path, patience=patience) for path in given):
        for bag in expand_bags([path]):
            name = "/".join(bag.parts[_base(path, bag) :]).removesuffix(".mcap")
            if found.setdefault(name, bag) != bag:
                raise DataError(
                    f"two bags are called '{name}': {found[name]} and {bag}; give the folder "
                    "above, or one pattern for both"
                )
    return dict(sorted(found.items()))


def robot_of(name: str) -> str:
    """Whose bag it is: the folders that it lies in; `-` if it lies in the one that was given."""
    return name.rpartition("/")[0] or "-"


def _base(given: Path, bag: Path) -> int:
    """How many parts of the bag's path are not in its name."""
    if given == bag:
        return len(bag.parts) - 1
    wild = (i for i, part in enumerate(given.parts) if WILD & set(part))
    return next(wild, len(given.parts))
