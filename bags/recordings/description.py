"""metadata.yaml: what rosbag2 says of a bag beside its files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from bags.recordings.quality import KEY, Profile
from nlsid_core.files import write_atomically

TYPE_HASH: Final = "topic_type_hash"  # of a channel's metadata, as rosbag2 writes it
METADATA: Final = "metadata.yaml"
METADATA_VERSION: Final = 9  # the rosbag2 metadata of ROS 2 Jazzy


@dataclass(frozen=True)
class FileDescription:
    """A file's name, its messages by topic, and their first and last log time in ns."""

    name: str
    counts: Mapping[str, int]
    first_ns: int | None
    last_ns: int


@dataclass(frozen=True)
class Topic:
    """How a topic's messages are written; schema: its encoding and data. offered: see `quality`."""

    name: str
    msgtype: str
    encoding: str
    schema: tuple[str, bytes]
    metadata: Mapping[str, str]
    offered: tuple[Profile, ...] = ()


def write_metadata(
    folder: Path,
    files: Sequence[FileDescription],
    topics: Iterable[Topic],
    custom: Mapping[str, str],
) -> None:
    """Make the folder a finished bag, as rosbag2 and rosbags read it.

    Of topics of one name the first is described.
    """
    named: dict[str, Topic] = {}
    for topic in topics:
        named.setdefault(topic.name, topic)
    starts = [file.first_ns for file in files if file.first_ns is not None]
    whole = FileDescription(
        "",
        {topic: sum(file.counts.get(topic, 0) for file in files) for topic in named},
        min(starts, default=None),
        max((file.last_ns for file in files), default=0),
    )
    information = {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name for file in files],
        **_extent(whole),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": topic.msgtype,
                    "serialization_format": topic.encoding,
                    KEY: [profile.document() for profile in topic.offered],
                    "type_description_hash": topic.metadata.get(TYPE_HASH, ""),
                },
                "message_count": whole.counts[name],
            }
            for name, topic in named.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file.name, **_extent(file)} for file in files],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }
    document = {"rosbag2_bagfile_information": information}
    text = yaml.safe_dump(document, sort_keys=False, width=4096)  # a value stays on its line
    write_atomically(folder / METADATA, text.encode())


def _extent(file: FileDescription) -> dict[str, Any]:
    first_ns = file.first_ns or 0
    last_ns = file.last_ns if file.first_ns is not None else 0
    return {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": sum(file.counts.values()),
    }
