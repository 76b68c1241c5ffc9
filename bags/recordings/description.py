"""metadata.yaml: what rosbag2 says of a bag beside its files."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import yaml

from bags.recordings.quality import KEY, Profile
from nlsid_core.files import write_atomically

TYPE_HASH: Final = "topic_type_hash"  # of a channel's metadata, as rosbag2 writes it
METADATA: Final = "metadata.yaml"
METADATA_VERSION: Final = 9  # the rosbag2 metadata of ROS 2 Jazzy


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
    file: str,
    topics: Iterable[Topic],
    counts: Mapping[str, int],
    custom: Mapping[str, str],
    span_ns: tuple[int, int],
) -> None:
    """Make the folder a finished bag of one file, as rosbag2 and rosbags read it.

    Of topics of one name the first is described. counts: messages by topic. span_ns: the first and
    the last log time, 0 without a message.
    """
    named: dict[str, Topic] = {}
    for topic in topics:
        named.setdefault(topic.name, topic)
    first_ns, last_ns = span_ns
    extent = {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": sum(counts.values()),
    }
    information = {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file],
        **extent,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": topic.msgtype,
                    "serialization_format": topic.encoding,
                    KEY: [profile.document() for profile in topic.offered],
                    "type_description_hash": topic.metadata.get(TYPE_HASH, ""),
                },
                "message_count": counts[name],
            }
            for name, topic in named.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file, **extent}],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }
    document = {"rosbag2_bagfile_information": information}
    text = yaml.safe_dump(document, sort_keys=False, width=4096)  # a value stays on its line
    write_atomically(folder / METADATA, text.encode())
