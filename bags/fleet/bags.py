"""The bags of a fleet: their names, and which of them are one recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bags.recordings.folders import expand_bags
from bags.recordings.remote import place
from nlsid_core.errors import DataError

WILD: Final = frozenset("*?[")
UNREAD: Final = "not read"  # nothing of the bag can be used: damaged, cut off, other topics, gone
COPY: Final = "copy"  # of a recording that another bag has: it counts there


def named_bags(given: Sequence[Path], *, patience: float | None = None) -> dict[str, Path]:
    """The bags that paths, URLs and patterns mean, by name, in the order of their names.

    A name is what follows the given folder, or the folders of a pattern before its first `*`, less
    the file's ending: `robot_3/drive_01` of `s3://fleet/*/drive_*.mcap`. It stays when others come.
    patience: s for which a failing request is repeated. Raises BagError if there is none, DataError
    if two have one name.
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


class Recordings:
    """Which bag had a recording first. It is known by any of its marks, as its digest."""

    def __init__(self) -> None:
        self._first: dict[object, str] = {}

    def first(self, name: str, marks: Sequence[object]) -> str:
        """The bag that had it: `name` itself if none of these marks was there before."""
        first = next((self._first[mark] for mark in marks if mark in self._first), name)
        for mark in marks:
            self._first.setdefault(mark, first)
        return first


def same_as(first: str) -> str:
    """What is said of a copy."""
    return f"the same recording as {first}"


def _base(given: Path, bag: Path) -> int:
    """How many parts of the bag's path are not in its name."""
    if given == bag:
        return len(bag.parts) - 1
    return next((i for i, part in enumerate(given.parts) if WILD & set(part)), len(given.parts))
