"""Which bags a person means by a path, and which files a bag is made of."""

import os
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from bags.recordings.quality import KEY, Profile, offered
from bags.recordings.remote import RemotePath, matching, place
from nlsid_core.errors import BagError

METADATA: Final = "metadata.yaml"
ROS1: Final = ".bag"
DATA_FILES: Final = (".mcap", ".db3", ROS1)
COMPRESSED: Final = ".zstd"  # a file rosbag2 compressed whole
NEWEST_VERSION: Final = 9  # of metadata.yaml; ROS 2 Jazzy's
MOST_LOOKED_AT: Final = 50  # folders, for bags that lie deeper than what was given
MAX_METADATA_BYTES: Final = 32 * 2**20  # 10 000 topics are 6 MB

# The C loader where PyYAML has it: ten thousand topics are seconds in Python.
_LOADER: Final[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class BagFiles:
    """What a bag is made of: its data files in order, and what its metadata.yaml says of it."""

    path: Path
    files: tuple[Path, ...]
    storage: str
    compressed: bool = False
    counts: dict[str, int] | None = None
    encodings: dict[str, str] = field(default_factory=dict)
    offered: dict[str, tuple[Profile, ...]] = field(default_factory=dict)
    custom: dict[str, str] = field(default_factory=dict)
    finished: bool = True


def expand_bags(paths: Iterable[Path]) -> list[Path]:
    """Each path that is a bag itself, and the bags directly in each path that is not, by name.

    A folder without metadata.yaml is a bag if its files are numbered as the parts of one.

    Raises BagError for a path that is not there or holds no bag.
    """
    found: list[Path] = []
    for path in (match for given in paths for match in _matches(place(given))):
        if not path.exists():
            raise BagError(f"there is no bag {path}; name a rosbag2 folder or an .mcap file")
        if path.is_file() or _is_bag(path):
            found.append(path)
            continue
        inside = sorted(
            p
            for p in path.iterdir()
            if (p.is_dir() and _is_bag(p)) or (p.is_file() and p.suffix in DATA_FILES)
        )
        if not inside:
            raise BagError(
                f"{path} is not a bag and holds none (no {' or '.join(DATA_FILES)}){_deeper(path)}"
            )
        found += inside
    return list(dict.fromkeys(found))


def _matches(path: Path) -> list[Path]:
    found = matching(path)
    if not found:
        raise BagError(f"nothing matches {path}; name a rosbag2 folder or an .mcap file")
    return found


def _deeper(folder: Path) -> str:
    """That folders in it hold bags, as one pattern for those that lie as deep as the first."""
    waiting = deque([(folder, "")])
    for _ in range(MOST_LOOKED_AT):
        if not waiting:
            break
        place_of, pattern = waiting.popleft()
        for path in sorted(place_of.iterdir()):
            if path.suffix in DATA_FILES:
                kind = f"{pattern}/*{path.suffix}"
            elif not path.is_dir():
                continue
            elif _is_bag(path):
                kind = f"{pattern}/*"
            else:
                waiting.append((path, f"{pattern}/*"))
                continue
            return f"; folders in it do: give the pattern '{folder}{kind}', in quotes"
    return ""


def trial_name(path: Path) -> str:
    """What a configuration calls a bag: its folder's name, or its file's without the ending."""
    return path.stem if path.is_file() else path.resolve().name


def bag_files(path: Path) -> BagFiles:
    """The files of one bag; a folder without metadata.yaml is a recording that was not closed.

    Raises BagError if there is no bag, or if its metadata are not metadata or name files that are
    not in its folder.
    """
    if path.is_file():
        return BagFiles(path, (path,), _storage([path]))
    if not path.is_dir():
        raise BagError(f"there is no bag {path}; name a rosbag2 folder or an .mcap file")
    there = sorted(p for p in path.iterdir() if p.suffix in (*DATA_FILES, COMPRESSED))
    there = [p for p in there if p.is_file()]
    if (path / METADATA).is_file():
        return _described(path, _metadata(path / METADATA))
    if not there:
        raise BagError(f"{path} is not a bag: it holds no {' or '.join(DATA_FILES)} file")
    return BagFiles(path, tuple(there), _storage(there), finished=False)


def _storage(files: list[Path]) -> str:
    suffixes = {file.suffix for file in files}
    if ".db3" in suffixes:
        return "sqlite3"
    return "ros1" if suffixes == {".bag"} else "mcap"


def _metadata(file: Path) -> dict[str, Any]:
    """`rosbag2_bagfile_information`; BagError if the file holds no such thing."""
    size = file.stat().st_size
    if size > MAX_METADATA_BYTES:
        raise _bad(file, f"it has {size} bytes, at most {MAX_METADATA_BYTES} are read")
    try:
        content = yaml.load(file.read_bytes(), Loader=_LOADER)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise _bad(file, f"it is not YAML: {str(error)[:200]}") from error
    found = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(found, dict):
        raise _bad(file, "it has no rosbag2_bagfile_information")
    return found


def _described(path: Path, metadata: dict[str, Any]) -> BagFiles:
    file = path / METADATA
    version = metadata.get("version")
    if not isinstance(version, int) or not 1 <= version <= NEWEST_VERSION:
        raise _bad(file, f"version {version!r}; 1 to {NEWEST_VERSION} are known")
    storage = metadata.get("storage_identifier")
    if storage not in ("mcap", "sqlite3"):
        raise _bad(file, f"storage_identifier {storage!r}; 'mcap' and 'sqlite3' are known")
    names = metadata.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise _bad(file, "relative_file_paths is not a list of names")
    counts: dict[str, int] = {}
    encodings: dict[str, str] = {}
    profiles: dict[str, tuple[Profile, ...]] = {}
    try:
        for entry in metadata["topics_with_message_count"] or ():
            topic = str(entry["topic_metadata"]["name"])
            counts[topic] = counts.get(topic, 0) + int(entry["message_count"])
            encodings[topic] = str(entry["topic_metadata"]["serialization_format"])
            found = offered(entry["topic_metadata"].get(KEY))
            profiles[topic] = (*profiles.get(topic, ()), *found)
    except (KeyError, TypeError, ValueError) as error:
        raise _bad(file, f"topics_with_message_count: {type(error).__name__} {error}") from error
    custom = metadata.get("custom_data") or {}
    if not isinstance(custom, dict):
        raise BagError(f"{path}: custom_data in {METADATA} is not a mapping")
    return BagFiles(
        path,
        tuple(_inside(path, name, version) for name in names),
        storage,
        compressed=bool(metadata.get("compression_format")),
        counts=counts,
        encodings=encodings,
        offered=profiles,
        custom={str(key): str(value) for key, value in custom.items()},
    )


def _inside(folder: Path, name: str, version: int) -> Path:
    """The data file `name`; BagError unless it is a file in `folder` itself."""
    file = folder / name
    if version < 4:  # these named the file from the folder above
        file = folder / Path(name).name
    if isinstance(folder, RemotePath):
        there, home = Path(os.path.normpath("/" / file)), Path(os.path.normpath("/" / folder))
    else:  # realpath bears loops of links
        there, home = Path(os.path.realpath(file)), folder.resolve()
    if not there.is_relative_to(home):
        raise _bad(folder / METADATA, f"it names {name}, which is outside the bag")
    if not file.is_file():
        raise _bad(folder / METADATA, f"it names {name}, which is not there")
    return file


def _bad(file: Path, what: str) -> BagError:
    return BagError(f"{file.parent} is damaged or not a bag: {file.name}: {what}")


def _is_bag(folder: Path) -> bool:
    if (folder / METADATA).is_file():
        return True
    stems = sorted(p.stem for p in folder.iterdir() if p.suffix in DATA_FILES)
    if len(stems) > 1 and any(p.suffix == ROS1 for p in folder.iterdir()):
        return False  # each is whole, also where one recording was split
    if len(stems) < 2:
        return bool(stems)
    numbered = [stem.rpartition("_") for stem in stems]
    one_name = len({name for name, _, _ in numbered}) == 1
    return one_name and {number for *_, number in numbered} == set(map(str, range(len(stems))))
