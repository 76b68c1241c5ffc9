"""Quality of service in copies of bags: kept, and such that every reader finds every message."""

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from rosbags.typesys import Stores, get_typestore

from bags.recordings.bag import Bag
from bags.recordings.quality import LATCHED, Profile, offered, offered_text, profile_of
from bags.recordings.writer import BagWriter
from bags.signals.recording import Arrival, Recent
from bags.tools.copies import Into
from bags.tools.recover import recover, repair
from nlsid_core.errors import BagError
from tests.bag_messages import START_NS, converted, speed_bag
from tests.conftest import SHARED

RESOURCES = SHARED / "rosbag2_resources"
STRING = "std_msgs/msg/String"
MAP, CHATTER = "/map", "/chatter"
OLD = (
    "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 0\n"
    "    nsec: 0\n  lifespan:\n    sec: 0\n    nsec: 0\n  liveliness: 1\n"
    "  liveliness_lease_duration:\n    sec: 0\n    nsec: 0\n"
    "  avoid_ros_namespace_conventions: false"
)


def ros2_bag(
    path: Path, *, storage: StoragePlugin = StoragePlugin.MCAP, version: Literal[8, 9] = 9
) -> Path:
    """A bag as rosbags writes it: a latched map and a chatter of two publishers."""
    types = get_typestore(Stores.ROS2_JAZZY)
    latched = _rosbags(LATCHED)
    chatter = [_rosbags(Profile()), _rosbags(Profile(reliability="best_effort"))]
    with Ros2Writer(path, version=version, storage_plugin=storage) as writer:
        connections = [
            writer.add_connection(topic, STRING, typestore=types, offered_qos_profiles=profiles)
            for topic, profiles in ((MAP, [latched]), (CHATTER, chatter))
        ]
        for k in range(20):
            message = types.types[STRING](f"{k}")
            data = types.serialize_cdr(message, STRING)
            writer.write(connections[0 if k == 0 else 1], START_NS + k * 10**9, data)
    return path


def _rosbags(profile: Profile) -> Qos:
    return parse_qos([profile.document()])[0]  # type: ignore[list-item]


def counts_by_rosbags(bag: Path) -> dict[str, int]:
    """What rosbags reads of a folder, which it opens by its metadata.yaml."""
    found: dict[str, int] = {}
    with Reader(bag) as reader:
        for connection, _, _ in reader.messages(reader.connections):
            found[connection.topic] = found.get(connection.topic, 0) + 1
    return found


def counts_by_mcap(bag: Path) -> dict[str, int]:
    found: dict[str, int] = {}
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            for _, channel, _ in make_reader(stream).iter_messages():
                found[channel.topic] = found.get(channel.topic, 0) + 1
    return found


def profiles_in(bag: Path) -> dict[str, list[dict[str, object]]]:
    content = yaml.safe_load((bag / "metadata.yaml").read_text(encoding="utf-8"))
    topics = content["rosbag2_bagfile_information"]["topics_with_message_count"]
    return {
        entry["topic_metadata"]["name"]: entry["topic_metadata"]["offered_qos_profiles"]
        for entry in topics
    }


def assert_kept(bag: Path, count: int) -> None:
    found = counts_by_rosbags(bag)
    assert found == counts_by_mcap(bag)
    with AnyReader([bag]) as reader:
        assert len(list(reader.messages())) == count
    assert sum(found.values()) == count
    profiles = profiles_in(bag)
    if MAP in found:
        assert profiles[MAP] == [LATCHED.document()]
    assert [entry["reliability"] for entry in profiles[CHATTER]] == ["reliable", "best_effort"]


COPIES: dict[str, Callable[[Path, Path], object]] = {
    "convert": lambda bag, out: converted(out, bag),
    "recover": lambda bag, out: recover(bag, out),
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_copies_keep_what_was_offered_and_every_reader_finds_every_message(
    tmp_path: Path, how: str, version: Literal[8, 9], storage: StoragePlugin
) -> None:
    bag = ros2_bag(tmp_path / "bag", storage=storage, version=version)
    COPIES[how](bag, tmp_path / "copy")
    assert_kept(tmp_path / "copy", 20)
    with Bag(tmp_path / "copy") as copy:
        assert copy.offered(MAP) == (LATCHED,)


def test_parts_of_a_split_keep_what_was_offered(tmp_path: Path) -> None:
    bag = ros2_bag(tmp_path / "bag")
    first, second = converted(tmp_path / "part", bag, into=Into(every=10.0)).parts
    assert_kept(first, 10)
    assert_kept(second, 10)  # without a message of the latched topic


def test_a_merged_topic_has_the_offers_of_all_bags(tmp_path: Path) -> None:
    bag = ros2_bag(tmp_path / "bag")
    plain = speed_bag(tmp_path / "plain", [0.0, 1.0], [0.0, 1.0])
    other = tmp_path / "other"
    with BagWriter(other) as writer:
        writer.add_topic(CHATTER, STRING, offered=(Profile(), Profile(depth=3)))
        writer.add_topic(MAP, STRING)
    assert profiles_in(plain) == {"/cmd_vel": [], "/odom": []}
    converted(tmp_path / "all", other, plain, bag)
    assert sum(counts_by_rosbags(tmp_path / "all").values()) == 24
    profiles = profiles_in(tmp_path / "all")
    assert [(entry["depth"], entry["reliability"]) for entry in profiles[CHATTER]] == [
        (10, "reliable"),
        (3, "reliable"),
        (10, "best_effort"),
    ]
    assert profiles[MAP] == [LATCHED.document()]
    assert profiles["/odom"] == []


def test_a_folder_says_what_its_file_does_not(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "plain", [0.0, 1.0], [0.0, 1.0])
    file = bag / "metadata.yaml"
    text = file.read_text(encoding="utf-8")
    for told, known in ((f"{OLD!r}", True), ("nonsense", False), ("{a: 1}", False), ("7", False)):
        value = yaml.safe_dump(OLD) if known else told
        file.write_text(text.replace("offered_qos_profiles: []", f"offered_qos_profiles: {value}"))
        with Bag(bag) as found:
            durabilities = [profile.durability for profile in found.offered("/odom")]
        assert durabilities == (["transient_local"] if known else [])
        converted(tmp_path / "part", bag)
        assert counts_by_rosbags(tmp_path / "part") == {"/cmd_vel": 2, "/odom": 2}
        shutil.rmtree(tmp_path / "part")


def test_a_latched_topic_of_ros_1_is_latched_in_ros_2(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(tmp_path / "old.bag") as writer:
        for topic, latching in ((MAP, 1), (CHATTER, 0)):
            connection = writer.add_connection(topic, STRING, typestore=types, latching=latching)
            data = types.serialize_ros1(types.types[STRING]("a"), STRING)
            writer.write(connection, START_NS, data)
    recover(tmp_path / "old.bag", tmp_path / "new")
    assert profiles_in(tmp_path / "new") == {MAP: [LATCHED.document()], CHATTER: []}
    assert counts_by_rosbags(tmp_path / "new") == {MAP: 1, CHATTER: 1}


def test_a_repaired_recording_keeps_what_its_recorder_knew(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "run", in_place=True)
    bag.add_topic(MAP, STRING, offered=(LATCHED,))
    types = get_typestore(Stores.ROS2_JAZZY)
    data = bytes(types.serialize_cdr(types.types[STRING]("a"), STRING))
    bag.write(MAP, STRING, data, log_time_ns=5, publish_time_ns=5)
    bag.close_chunk()
    bag.abandon()
    assert repair(tmp_path / "run") == 1
    assert profiles_in(tmp_path / "run") == {MAP: [LATCHED.document()]}
    assert counts_by_rosbags(tmp_path / "run") == {MAP: 1}


def test_a_snapshot_keeps_what_was_offered(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    data = bytes(types.serialize_cdr(types.types[STRING]("a"), STRING))
    recent = Recent(10.0)
    recent.add(Arrival(MAP, STRING, data, 5, 5))
    recent.save(tmp_path / "snapshot", offered={MAP: (LATCHED,)})
    assert profiles_in(tmp_path / "snapshot") == {MAP: [LATCHED.document()]}


def test_profiles_are_read_as_rosbags_reads_them_and_written_as_it_does() -> None:
    [old] = offered(OLD)
    assert (old.history, old.durability, old.depth) == ("unknown", "transient_local", 0)
    assert dump_qos_v9(parse_qos(OLD)) == [old.document()]
    assert parse_qos(offered_text([old, LATCHED])) == [*parse_qos(OLD), _rosbags(LATCHED)]
    assert _rosbags(LATCHED).durability is QosDurability.TRANSIENT_LOCAL
    live = SimpleNamespace(**_rosbags(LATCHED)._asdict())
    live.deadline = live.lifespan = SimpleNamespace(nanoseconds=9223372036854775807)
    live.liveliness_lease_duration = live.deadline
    assert profile_of(live) == LATCHED
    for bad in ("", "- 3", "[", "- depth: -1", "a" * 10**6, None, 7, [{"depth": 1}]):
        assert offered(bad) == ()


@pytest.mark.skipif(not RESOURCES.is_dir(), reason=f"needs {RESOURCES.name} beside the repository")
def test_what_rosbag2_recorded_itself_is_copied_with_its_offers(tmp_path: Path) -> None:
    compared = 0
    for metadata in sorted(RESOURCES.rglob("metadata.yaml")):
        content = yaml.safe_load(metadata.read_text(encoding="utf-8"))
        information = content["rosbag2_bagfile_information"]
        entries = [e["topic_metadata"] for e in information["topics_with_message_count"]]
        if not information["message_count"] or any(
            entry["serialization_format"] != "cdr" for entry in entries
        ):
            continue
        out = tmp_path / f"copy_{compared}"
        try:
            count = converted(out, metadata.parent).messages
        except BagError:  # some are made to be refused
            continue
        compared += 1
        kept = profiles_in(out)
        assert kept == {
            entry["name"]: [p.document() for p in offered(entry["offered_qos_profiles"])]
            for entry in entries
            if entry["name"] in kept
        }
        assert sum(counts_by_rosbags(out).values()) == count
        assert sum(counts_by_mcap(out).values()) == count
    assert compared >= 8
