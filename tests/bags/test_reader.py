"""Signals read from bags: values, stamps, clocks, digests, metadata."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from bags.recordings.bag import Bag
from bags.recordings.writer import BagWriter
from bags.signals.reader import HEADER_STAMP, LOG_TIME, bag_digest, bag_origin, read_signals
from bags.tools.recover import recover
from tests.bag_messages import (
    COMMAND,
    PERIOD_NS,
    SPEED,
    START_NS,
    serialised,
    speed_bag,
    twist,
)

TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
RESOURCES = Path(__file__).parents[2].parent / "shared" / "data" / "rosbag2_resources"


def test_values_and_header_stamps_come_back_bit_equal(tmp_path: Path) -> None:
    speeds = [0.1, 1 / 3, float(np.nextafter(0.2, 1))]
    stamps = [START_NS + 5, START_NS + PERIOD_NS + 7, START_NS + 2 * PERIOD_NS + 11]
    bag = speed_bag(tmp_path / "trial", speeds, [0.0, -0.5, 1e-300], stamps_ns=stamps)
    read = read_signals(bag, [SPEED, COMMAND])
    assert list(read) == [SPEED, COMMAND]
    assert read[SPEED].values.tolist() == speeds
    assert read[COMMAND].values.tolist() == [0.0, -0.5, 1e-300]
    assert read[SPEED].stamp_ns.tolist() == stamps
    assert read[SPEED].clock == HEADER_STAMP
    assert not read[SPEED].values.flags.writeable


def test_a_single_mcap_file_reads_as_its_folder_does(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4], custom={"repeat_group": "step"})
    file = bag / "trial.mcap"
    assert read_signals(file, [SPEED])[SPEED].values.tolist() == [0.1, 0.2]
    assert bag_origin(file)["custom"] == bag_origin(bag)["custom"] == {"repeat_group": "step"}
    assert bag_digest(file) == bag_digest(bag)
    assert bag_digest(bag) == "sha256:" + hashlib.sha256(file.read_bytes()).hexdigest()


def test_a_type_without_a_header_is_stamped_by_log_time_and_says_so(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/Twist"
    with BagWriter(tmp_path / "plain") as bag:
        for k in range(3):
            stamp = START_NS + k
            data = serialised(kind, twist(0.5 * k))
            bag.write("/cmd", kind, data, log_time_ns=stamp, publish_time_ns=stamp)
    samples = read_signals(tmp_path / "plain", ["/cmd:linear.x"])["/cmd:linear.x"]
    assert samples.clock == LOG_TIME
    assert samples.stamp_ns.tolist() == [START_NS, START_NS + 1, START_NS + 2]
    assert samples.values.tolist() == [0.0, 0.5, 1.0]


def test_messages_come_in_log_order_with_ties_as_recorded(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4])
    with Bag(bag) as source:
        topics = [message.topic for message in source.messages()]
        only = [message.topic for message in source.messages(["/odom"])]
    assert topics == ["/cmd_vel", "/odom", "/cmd_vel", "/odom"]
    assert only == ["/odom", "/odom"]


@pytest.mark.skipif(not RESOURCES.is_dir(), reason=f"needs {RESOURCES.name} beside the repository")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bags_that_ros2_recorded_itself_are_read(storage: str) -> None:
    bag = RESOURCES / "rosbag2_tests" / "resources" / storage / "cdr_test"
    with Bag(bag) as source:
        messages = list(source.messages())
        arrays = [t for t, kind in source.topics.items() if kind == "test_msgs/msg/Arrays"]
    assert len(messages) == 7
    path = f"{arrays[0]}:float64_values[0]"
    samples = read_signals(bag, [path])[path]
    assert samples.clock == LOG_TIME
    assert len(samples) > 0


def test_a_ros_1_bag_reads_as_its_ros_2_twin(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(tmp_path / "old.bag") as writer:
        connection = writer.add_connection("/cmd", TWIST_STAMPED, typestore=types)
        for k in range(3):
            stamp = types.types["builtin_interfaces/msg/Time"](sec=100 + k, nanosec=5)
            header = types.types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="base")
            vector = types.types["geometry_msgs/msg/Vector3"]
            twist = types.types["geometry_msgs/msg/Twist"](
                linear=vector(x=0.1 * k, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=-1.0)
            )
            message = types.types[TWIST_STAMPED](header=header, twist=twist)
            data = types.serialize_ros1(message, TWIST_STAMPED)
            writer.write(connection, START_NS + k, data)
    read = read_signals(tmp_path / "old.bag", ["/cmd:twist.linear.x", "/cmd:twist.angular.z"])
    assert read["/cmd:twist.linear.x"].values.tolist() == [0.0, 0.1, 0.2]
    assert read["/cmd:twist.angular.z"].values.tolist() == [-1.0] * 3
    assert read["/cmd:twist.linear.x"].stamp_ns.tolist() == [
        (100 + k) * 10**9 + 5 for k in range(3)
    ]
    recover(tmp_path / "old.bag", tmp_path / "new")
    again = read_signals(tmp_path / "new", ["/cmd:twist.linear.x"])["/cmd:twist.linear.x"]
    assert again.values.tolist() == [0.0, 0.1, 0.2]
