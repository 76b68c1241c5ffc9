"""Bags in several files, compressed or not, of custom types: as we, rosbags and mcap read them."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.message_types import decode
from bags.recordings.writer import BagWriter
from nlsid_core.errors import BagError
from tests.mcap_files import three_readers

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
