"""Bags in several files, compressed or not, of custom types: as we, rosbags and mcap read them."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.message_types import decode
from bags.recordings.writer import BagWriter
from nlsid_core.errors import BagError
from tests.bag_messages import CMD, CMD_TYPE, ODOM, ODOM_TYPE, PERIOD_NS, START_NS, command
from tests.mcap_files import three_readers

ARM = "my_robot/msg/Arm"


def write(path: Path, count: int, **settings: object) -> list[bytes]:
    """Commands every 25 ms, with a little noise that does not compress away."""
    rng, data = np.random.default_rng(1), []
    with BagWriter(path, custom={"robot": "car"}, **settings) as bag:  # type: ignore[arg-type]
        bag.add_topic(ODOM, ODOM_TYPE)
        for k in range(count):
            stamp = START_NS + k * PERIOD_NS
            data.append(command(stamp, float(rng.standard_normal())))
            times = {"log_time_ns": stamp, "publish_time_ns": stamp}
            bag.write(CMD, CMD_TYPE, data[-1], **times)
            if k % 20 == 19:
                bag.close_chunk()
    return data


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_bag_split_by_time_is_read_back_bit_equal(tmp_path: Path, compression: str) -> None:
    data = write(tmp_path / "run", 300, split_seconds=2.0, compression=compression)
    assert three_readers(tmp_path / "run", CMD) == [data] * 3
    document = yaml.safe_load((tmp_path / "run" / "metadata.yaml").read_text())
    metadata = document["rosbag2_bagfile_information"]
    assert metadata["relative_file_paths"] == [f"run_{k}.mcap" for k in range(4)]
    assert [file["message_count"] for file in metadata["files"]] == [80, 80, 80, 60]
    starts = [file["starting_time"]["nanoseconds_since_epoch"] for file in metadata["files"]]
    assert starts == [START_NS + 80 * k * PERIOD_NS for k in range(4)]
    assert {file["duration"]["nanoseconds"] for file in metadata["files"][:3]} == {79 * PERIOD_NS}
    with (tmp_path / "run" / "run_2.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {c.compression for c in summary.chunk_indexes} == {
        "" if compression == "none" else compression
    }
    assert {channel.topic for channel in summary.channels.values()} == {ODOM, CMD}


def test_a_bag_split_by_size_has_files_of_about_that_size(tmp_path: Path) -> None:
    data = write(tmp_path / "run", 2000, split_bytes=20_000, compression="none")
    assert three_readers(tmp_path / "run", CMD) == [data] * 3
    sizes = [file.stat().st_size for file in sorted((tmp_path / "run").glob("*.mcap"))]
    assert len(sizes) > 5
    assert max(sizes) < 30_000
    with Bag(tmp_path / "run") as source:
        assert source.custom == {"robot": "car"}
        assert source.count(CMD) == 2000


def test_a_compression_that_does_not_exist_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="'zip'; it is one of zstd, lz4, none"):
        BagWriter(tmp_path / "run", compression="zip")
    assert not list(tmp_path.iterdir())


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
