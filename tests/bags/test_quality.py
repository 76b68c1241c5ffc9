"""Bags that are written: split, compressed, with quality of service, as every reader reads them."""

import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from rosbags.typesys import Stores, get_typestore

from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.message_types import decode
from bags.recordings.quality import LATCHED, Profile, offered, offered_text, profile_of
from bags.recordings.writer import BagWriter, whole_bag
from bags.tools.copies import Into
from bags.tools.recover import recover
from nlsid_core.errors import BagError
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    ODOM,
    ODOM_TYPE,
    PERIOD_NS,
    START_NS,
    command,
    converted,
    odometry,
    speed_bag,
)
from tests.conftest import SHARED
from tests.mcap_files import three_readers


def test_rosbags_reads_back_every_byte_type_hash_and_custom_datum(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4], custom={"repeat_group": "step"})
    with Reader(bag) as reader:
        assert reader.message_count == 4
        assert (reader.start_time, reader.duration) == (START_NS, PERIOD_NS + 1)
        assert {c.topic: c.msgtype for c in reader.connections} == {ODOM: ODOM_TYPE, CMD: CMD_TYPE}
        metadata: Any = reader.storage.metadata
        assert metadata.custom == {"repeat_group": "step"}
        assert metadata.ros_distro == "jazzy"
        read = [(c.topic, stamp, data) for c, stamp, data in reader.messages()]
    expected = [
        (CMD, START_NS, command(START_NS, 0.3)),
        (ODOM, START_NS, odometry(START_NS, 0.1)),
        (CMD, START_NS + PERIOD_NS, command(START_NS + PERIOD_NS, 0.4)),
        (ODOM, START_NS + PERIOD_NS, odometry(START_NS + PERIOD_NS, 0.2)),
    ]
    assert read == expected
    with AnyReader([bag]) as reader_with_types:  # recomputes every type hash from the schemas
        assert len(list(reader_with_types.messages())) == 4


def test_mcap_reads_profile_times_and_metadata_record(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "trial", custom={"source": "test"}) as bag:
        bag.write(CMD, CMD_TYPE, command(7, 0.5), log_time_ns=9, publish_time_ns=7)
    with (tmp_path / "trial" / "trial.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        [(schema, channel, message)] = reader.iter_messages()
        assert schema is not None
        assert (schema.name, schema.encoding) == (CMD_TYPE, "ros2msg")
        assert (channel.topic, channel.message_encoding) == (CMD, "cdr")
        assert (message.log_time, message.publish_time) == (9, 7)
        [record] = reader.iter_metadata()
        assert (record.name, record.metadata) == ("custom_data", {"source": "test"})


def test_a_topic_without_messages_is_listed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "quiet") as bag:
        bag.add_topic(CMD, CMD_TYPE)
    with Reader(tmp_path / "quiet") as reader:
        assert [(c.topic, c.msgcount) for c in reader.connections] == [(CMD, 0)]
        assert reader.message_count == 0


def test_an_existing_folder_is_refused_and_untouched(tmp_path: Path) -> None:
    (tmp_path / "trial").mkdir()
    with pytest.raises(BagError, match="trial exists already"):
        BagWriter(tmp_path / "trial")
    assert list(tmp_path.rglob("*")) == [tmp_path / "trial"]


@pytest.mark.parametrize("write", [BagWriter, whole_bag])
def test_an_exception_leaves_nothing_of_a_bag(tmp_path: Path, write: Any) -> None:
    with pytest.raises(BagError, match="is not known"), write(tmp_path / "trial") as bag:
        bag.write("/x", "no/msg/Type", b"", log_time_ns=1, publish_time_ns=1)
    assert list(tmp_path.iterdir()) == []


def test_a_whole_bag_has_its_name_in_the_end_and_replaces_nothing(tmp_path: Path) -> None:
    with whole_bag(tmp_path / "run") as bag:
        bag.write(CMD, CMD_TYPE, command(1, 0.5), log_time_ns=1, publish_time_ns=1)
        bag.close_chunk()
        assert not (tmp_path / "run").exists()
    assert _stamps_on_disk(tmp_path / "run") == [1]
    with pytest.raises(BagError, match="late exists already"), whole_bag(tmp_path / "late"):
        (tmp_path / "late").mkdir()
    assert list((tmp_path / "late").iterdir()) == []
    assert {path.name for path in tmp_path.iterdir()} == {"run", "late"}


def test_a_second_type_on_a_topic_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "trial") as bag:
        bag.add_topic(CMD, CMD_TYPE)
        with pytest.raises(BagError, match=r"/cmd_vel holds 'geometry_msgs/msg/TwistStamped'"):
            bag.write(CMD, ODOM_TYPE, b"", log_time_ns=0, publish_time_ns=0)


def test_an_unknown_type_and_a_negative_time_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "trial") as bag:
        with pytest.raises(BagError, match="'my_robot/msg/Arm' is not known"):
            bag.add_topic("/arm", "my_robot/msg/Arm")
        with pytest.raises(BagError, match="times -1, 0 ns"):
            bag.write(CMD, CMD_TYPE, b"", log_time_ns=-1, publish_time_ns=0)


def test_a_closed_chunk_is_on_disk(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "trial")
    bag.write(CMD, CMD_TYPE, command(1, 0.5), log_time_ns=1, publish_time_ns=1)
    assert _stamps_on_disk(bag.path) == []
    bag.close_chunk()
    assert _stamps_on_disk(bag.path) == [1]
    bag.write(CMD, CMD_TYPE, command(2, 0.5), log_time_ns=2, publish_time_ns=2)
    assert _stamps_on_disk(bag.path) == [1]
    bag.close()
    assert _stamps_on_disk(bag.path) == [1, 2]


def _stamps_on_disk(bag: Path) -> list[int]:
    """Log times of the messages in complete chunks of a file that may be unfinished."""
    stamps: list[int] = []
    with (bag / f"{bag.name}.mcap").open("rb") as stream:
        try:
            stamps.extend(
                record.log_time
                for record in StreamReader(stream, validate_crcs=True).records
                if isinstance(record, Message)
            )
        except EndOfFile:
            return stamps
    return stamps


# -- Bags in several files, compressed or not, of custom types: as we, rosbags and mcap read them

ARM = "my_robot/msg/Arm"


@pytest.fixture
def my_robot(tmp_path: Path) -> Path:
    """A package's folder with two message definitions, one made of the other."""
    folder = tmp_path / "share" / "my_robot" / "msg"
    folder.mkdir(parents=True)
    (folder / "Arm.msg").write_text("std_msgs/Header header\nJoint[] joints\nuint8 OK=1\n")
    (folder / "Joint.msg").write_text("string name\ngeometry_msgs/Vector3 place\nfloat64[2] q\n")
    return folder.parent


@pytest.mark.parametrize("given", ["package", "share", "files"])
def test_a_custom_type_given_as_msg_files_reads_back(
    my_robot: Path, tmp_path: Path, given: str
) -> None:
    paths = {
        "package": [my_robot],
        "share": [my_robot.parent],
        "files": sorted((my_robot / "msg").iterdir()),
    }[given]
    definition = read_definitions(paths)[ARM]
    assert definition.is_stamped
    # an Arm by hand: header, one joint "a", a place and two numbers
    data = (
        b"\0\1\0\0" + b"\1\0\0\0\2\0\0\0" + b"\1\0\0\0\0\0\0\0" + b"\1\0\0\0" + b"\2\0\0\0a\0\0\0"
    )
    data += b"\0" * (-(len(data) - 4) % 8)
    data += np.array([1.0, 2.0, 3.0, 0.25, -0.5]).tobytes()
    with BagWriter(tmp_path / "run") as bag:
        bag.add_topic("/arm", ARM, definition=definition)
        bag.write("/arm", ARM, data, log_time_ns=1, publish_time_ns=1)
    assert three_readers(tmp_path / "run", "/arm") == [[data]] * 3
    with Bag(tmp_path / "run") as source:
        msgtype, types = source.types_on("/arm")
    for arm in (
        decode(data, msgtype, types),
        AnyReader([tmp_path / "run"]),
    ):
        if isinstance(arm, AnyReader):
            with arm as reader:
                [connection] = reader.connections
                arm = reader.deserialize(data, connection.msgtype)
        joint = arm.joints[0]  # type: ignore[attr-defined]
        assert (joint.name, joint.place.y, joint.q.tolist()) == ("a", 2.0, [0.25, -0.5])
    metadata = yaml.safe_load((tmp_path / "run" / "metadata.yaml").read_text())
    [topic] = metadata["rosbag2_bagfile_information"]["topics_with_message_count"]
    assert topic["topic_metadata"]["type_description_hash"] == definition.type_hash


def test_definitions_that_are_none_or_lack_something_are_refused(
    my_robot: Path, tmp_path: Path
) -> None:
    with pytest.raises(BagError, match="holds no message definitions; give a PACKAGE/msg/Type"):
        read_definitions([tmp_path / "nowhere"])
    loose = tmp_path / "Arm.msg"
    loose.write_text("float64 x\n")
    with pytest.raises(BagError, match=r"a definition's place is PACKAGE/msg/Type.msg"):
        read_definitions([loose])
    with pytest.raises(BagError, match="Joint"):
        read_definitions([my_robot / "msg" / "Arm.msg"])
    (my_robot / "msg" / "Bad.msg").write_text("float64[ x\n")
    with pytest.raises(BagError, match="'my_robot/msg/Bad' cannot be used"):
        read_definitions([my_robot])


# -- Quality of service in copies of bags: kept, and such that every reader finds every message

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
    with Reader(bag) as reader:
        return Counter(connection.topic for connection, *_ in reader.messages(reader.connections))


def counts_by_mcap(bag: Path) -> dict[str, int]:
    found: Counter[str] = Counter()
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            found.update(channel.topic for _, channel, _ in make_reader(stream).iter_messages())
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
