"""Which bags a person means by a path, and which files a bag is made of."""

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml

from bags.recordings.quality import KEY, LOADER, Profile, offered
from bags.recordings.remote import RemotePath, matching, place
from nlsid_core.errors import BagError

METADATA: Final = "metadata.yaml"
ROS1: Final = ".bag"
DATA_FILES: Final = (".mcap", ".db3", ROS1)
ACTIVE: Final = ".active"  # what ROS 1 calls a bag that is being recorded
JOURNAL: Final = "-wal"  # what SQLite has not moved into a file yet
COMPRESSED: Final = ".zstd"  # a file rosbag2 compressed whole
NEWEST_VERSION: Final = 9  # of metadata.yaml; ROS 2 Jazzy's
MOST_PARTS: Final = 10_000  # of one recording; a greater number is a date
MAX_METADATA_BYTES: Final = 32 * 2**20  # 10 000 topics are 6 MB


class DescribedTopic(NamedTuple):
    """What metadata.yaml says of a topic: messages, how they are serialised, what was offered."""

    messages: int
    encoding: str
    offered: tuple[Profile, ...]


@dataclass(frozen=True)
class BagFiles:
    """What a bag is made of: its data files in order, and what its metadata.yaml says of it.

    topics: None without metadata. total: messages in all. release: of ROS 2; empty if it is not
    named. notes: what in the metadata is not as it should be.
    """

    files: tuple[Path, ...]
    topics: dict[str, DescribedTopic] | None = None
    custom: dict[str, str] = field(default_factory=dict)
    total: int | None = None
    finished: bool = True
    release: str = ""
    notes: tuple[str, ...] = ()


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
            if (p.is_dir() and _is_bag(p)) or (p.is_file() and _is_data(p))
        )
        if not inside:
            raise BagError(
                f"{path} is a design's folder; a recording belongs here"
                if (path / "model.json").is_file()
                else f"{path} is not a bag and holds none (no {' or '.join(DATA_FILES)}); of "
                f"folders in folders give a pattern, '{path}/*/*', in quotes"
            )
        found += inside
    return list(dict.fromkeys(found))


def _matches(path: Path) -> list[Path]:
    found = matching(path)
    if not found:
        raise BagError(f"nothing matches {path}; name a rosbag2 folder or an .mcap file")
    return found


def trial_name(path: Path) -> str:
    """What a configuration calls a bag: its folder's name, or its file's without the ending."""
    return path.stem if path.is_file() else path.resolve().name


def bag_files(path: Path) -> BagFiles:
    """The files of one bag; a folder without metadata.yaml is a recording that was not closed.

    Raises BagError if there is no bag, or if its metadata are not metadata or name files that are
    not in its folder.
    """
    if path.is_file():
        return BagFiles((path,))
    if not path.is_dir():
        raise BagError(f"there is no bag {path}; name a rosbag2 folder or an .mcap file")
    if (path / METADATA).is_file():
        found = _described(path, _metadata(path / METADATA))
    elif there := data_files(path):
        found = BagFiles(there, finished=False, notes=_missing_parts(there))
    else:
        raise BagError(f"{path} is not a bag: it holds no {' or '.join(DATA_FILES)} file")
    return replace(found, notes=(*found.notes, *_left_beside(path, found.files)))


def _left_beside(folder: Path, files: Sequence[Path]) -> tuple[str, ...]:
    """Which newest messages SQLite kept of a file that is not read under that name."""
    read = {f"{file.name.removesuffix(COMPRESSED)}{JOURNAL}" for file in files}
    left = {there.name for there in folder.iterdir() if there.name.endswith(f".db3{JOURNAL}")}
    return tuple(
        f"{name} is not read: messages of {name.removesuffix(JOURNAL)}, which is not there"
        for name in sorted(left - read)
    )


def _missing_parts(files: Sequence[Path]) -> tuple[str, ...]:
    """Which parts are not there of a recording whose parts are numbered from 0."""
    numbered = [re.search(r"_(\d+)\.", file.name) for file in files]
    numbers = {int(match[1]) for match in numbered if match}
    if 0 not in numbers or max(numbers) > MOST_PARTS:
        return ()
    missing = set(range(max(numbers))) - numbers
    return tuple(f"part {number} of the recording is not there" for number in sorted(missing))


def data_files(folder: Path) -> tuple[Path, ...]:
    """The data files in a folder; part 2 before part 10.

    Of a file that lies there compressed and unpacked, as `ros2 bag play` leaves it, the unpacked.
    """
    there = [p for p in folder.iterdir() if _is_data(p) and p.is_file()]
    return tuple(sorted(without_twins(sorted(there)), key=_by_number))


def without_twins(files: Iterable[Path]) -> list[Path]:
    """Leave out a file where it lies there under another name, compressed or unpacked."""
    found: dict[str, Path] = {}
    for file in files:
        found.setdefault(file.name.removesuffix(COMPRESSED), file)
    return list(found.values())


def _data_name(path: Path) -> Path:
    """The name before it was compressed, or with which its recorder was killed."""
    return Path(path.name.removesuffix(COMPRESSED).removesuffix(ACTIVE))


def _is_data(path: Path) -> bool:
    return _data_name(path).suffix in DATA_FILES


def _by_number(path: Path) -> list[tuple[int, str]]:
    """The name, with its numbers as numbers."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _metadata(file: Path) -> dict[str, Any]:
    """`rosbag2_bagfile_information`; BagError if the file holds no such thing."""
    size = file.stat().st_size
    if size > MAX_METADATA_BYTES:
        raise _bad(file, f"it has {size} bytes, at most {MAX_METADATA_BYTES} are read")
    try:
        content = yaml.load(file.read_bytes(), Loader=LOADER)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise _bad(file, f"it is not YAML: {' '.join(str(error).split())[:200]}") from error
    found = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(found, dict):
        raise _bad(file, "it has no rosbag2_bagfile_information")
    return found


def _described(path: Path, metadata: dict[str, Any]) -> BagFiles:
    file = path / METADATA
    version = metadata.get("version")
    if not isinstance(version, int) or version < 1:
        raise _bad(file, f"version {version!r}; 1 to {NEWEST_VERSION} are known")
    notes = []
    if version > NEWEST_VERSION:
        notes.append(f"{METADATA} has version {version}; {NEWEST_VERSION} is the newest known")
    names = metadata.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise _bad(file, "relative_file_paths is not a list of names")
    files = [_inside(path, name) for name in names]
    if missing := [name for name, found in zip(names, files, strict=True) if found is None]:
        if len(missing) < len(names) or not data_files(path):
            raise _bad(file, f"it names {missing[0]}, which is not there")
        files = [*data_files(path)]
        there = ", ".join(found.name for found in files if found)
        notes.append(f"{METADATA} names {', '.join(missing)}, which is not there; read: {there}")
    topics: dict[str, DescribedTopic] = {}
    try:
        for entry in metadata["topics_with_message_count"] or ():
            topic = str(entry["topic_metadata"]["name"])
            before = topics.get(topic, DescribedTopic(0, "", ()))
            topics[topic] = DescribedTopic(
                before.messages + int(entry["message_count"]),
                str(entry["topic_metadata"].get("serialization_format", "cdr")),
                (*before.offered, *offered(entry["topic_metadata"].get(KEY))),
            )
    except (KeyError, TypeError, ValueError) as error:
        raise _bad(file, f"topics_with_message_count: {type(error).__name__} {error}") from error
    total = metadata.get("message_count")
    custom = metadata.get("custom_data") or {}
    if not isinstance(custom, dict):
        raise BagError(f"{path}: custom_data in {METADATA} is not a mapping")
    return BagFiles(
        tuple(found for found in files if found),
        topics=topics,
        custom={str(key): str(value) for key, value in custom.items()},
        total=total if isinstance(total, int) else None,
        release=str(metadata.get("ros_distro") or ""),
        notes=tuple(notes),
    )


def _inside(folder: Path, name: str) -> Path | None:
    """The data file `name`, None if there is none; BagError unless it is in `folder` itself.

    Until version 4 the names began at the folder above; a file that was compressed whole may have
    the name that it had before.
    """
    for there in (folder / name, folder / Path(name).name, folder / f"{name}{COMPRESSED}"):
        if isinstance(folder, RemotePath):
            end, home = Path(os.path.normpath("/" / there)), Path(os.path.normpath("/" / folder))
        else:  # realpath bears loops of links
            end, home = Path(os.path.realpath(there)), folder.resolve()
        if not end.is_relative_to(home):
            raise _bad(folder / METADATA, f"it names {name}, which is outside the bag")
        if there.is_file():
            return there
    return None


def _bad(file: Path, what: str) -> BagError:
    return BagError(f"{file.parent} is damaged or not a bag: {file.name}: {what}")


def _is_bag(folder: Path) -> bool:
    if (folder / METADATA).is_file():
        return True
    stems = sorted(_data_name(p).stem for p in folder.iterdir() if _is_data(p))
    if len(stems) > 1 and any(p.suffix == ROS1 for p in folder.iterdir()):
        return False  # each is whole, also where one recording was split
    if len(stems) < 2:
        return bool(stems)
    numbered = [stem.rpartition("_") for stem in stems]
    one_name = len({name for name, _, _ in numbered}) == 1
    return one_name and {number for *_, number in numbered} == set(map(str, range(len(stems))))
