"""Fields of a command that are not the signal: never zero without a word, and limits per input."""

import math
import re
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from geometry_msgs.msg import TwistStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from bags.recordings.message_types import (
    decode,
    header_frames,
    header_stamp_ns,
    is_stamped,
    standard_types,
)
from bags.signals.message_reader import SignalVector
from bags.signals.sampling import Sampler
from bags.signals.signal import SignalPath, numeric_paths
from nlsid_core.errors import BagError
from nlsid_ros.message_classes import installed_types, message_class
from nlsid_ros.messages import SignalMessage, numbers_at
from tests.ros.processes import ros_test

pytestmark = ros_test
JOINTS = "sensor_msgs/msg/JointState"
GOALS = "nav_msgs/msg/Goals"  # a header and poses

TWIST = "geometry_msgs/msg/TwistStamped"
SPEED = SignalVector.parse(["/cmd_vel:twist.linear.x"])


def test_the_other_fields_are_as_the_template_says() -> None:
    made = SignalMessage(
        SPEED, TWIST, '{"twist": {"angular": {"z": 1}}, "header": {"frame_id": "b"}}'
    )
    message = made.make(5, 0.25)
    assert (message.twist.linear.x, message.twist.angular.z) == (0.25, 1.0)
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("b", 5)
    assert not made.lacking()


def test_a_number_that_is_none_is_never_sent_beside_the_signal() -> None:
    made, fit, unfit = SignalMessage(SPEED, TWIST, "/teleop"), TwistStamped(), TwistStamped()
    fit.twist.angular.z, unfit.twist.angular.z = 0.7, math.nan
    for message in (fit, unfit):
        made._on_other(message)
    assert made.lacking() == "on /teleop, twist.angular.z is nan"
    assert made.make(5, 0.25).twist.angular.z == 0.7, "on the way to rest"


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ("refused", "fields that are not the signal (twist.linear.y, twist.linear.z, twist.ang"),
        ('{"twist": {"turn": 1}}', "there is no 'turn'; there are: linear, angular"),
        ('{"twist": {"angular": {"z": "fast"}}}', "angular: The 'z' field must be of type 'float'"),
        ('{"twist": {"angular": {"z": true}}}', "angular: The 'z' field must be of type 'float'"),
        ('{"twist": {"angular": {"z": [1]}}}', "angular: The 'z' field must be of type 'float'"),
        ('{"twist": {"angular": {"z": NaN}}}', "NaN is not a number a document may hold"),
        ('{"twist": {"angular": {"z": -Infinity}}}', "-Infinity is not a number a document may h"),
        ('{"twist": {"angular": {"z": 1e400}}}', "1e400 does not fit a float64"),
        ('{"twist": {"angular": 1}}', "twist: angular: 1 should be an object of its fields"),
        ('{"twist": [0, 1]}', "twist: [0, 1] should be an object of its fields"),
        ('{"header": {"frame_id": {"a": 1}}}', "The 'frame_id' field must be of type 'str'"),
        ('{"header": {"stamp": {"sec": 3000000000}}}', "'sec' field must be an integer in [-2147"),
        ("{", "others, fields of geometry_msgs/msg/TwistStamped: "),
        ("/tele op", "others is no topic: Invalid topic name"),
        ("none", "others is 'none'; it should be zero, refused"),
    ],
)
def test_others_that_do_not_fit_are_refused_by_name(others: str, said: str) -> None:
    with pytest.raises(BagError, match=re.escape(said)):
        SignalMessage(SPEED, TWIST, others)


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ('{"velocity": [1, "a"]}', "must be real number, not str"),
        ('{"name": "wheel"}', "The 'name' field must be a set or sequence"),
        ('{"position": [1e400]}', "1e400 does not fit a float64"),
    ],
)
def test_others_in_lists_are_held_to_their_type_too(others: str, said: str) -> None:
    wheel, kind = SignalVector.parse(["/wheels:effort[0]"]), "sensor_msgs/msg/JointState"
    with pytest.raises(BagError, match=re.escape(said)):
        SignalMessage(wheel, kind, others)
    made = SignalMessage(wheel, kind, '{"name": ["a"], "velocity": [1, 2.5]}').make(0, 0.5)
    assert (made.name, list(made.velocity), list(made.effort)) == (["a"], [1.0, 2.5], [0.5])


def test_fields_on_a_topic_that_are_not_finite_are_not_passed_on() -> None:
    made, message = SignalMessage(SPEED, TWIST, "/teleop"), TwistStamped()
    for z, lacking in ((0.5, ""), (math.nan, "on /teleop, twist.angular.z is nan"), (0.5, "")):
        message.twist.angular.z = z
        made._on_other(message)
        assert made.lacking() == lacking


def test_numbers_of_a_node_are_a_message_like_any_other() -> None:
    for numbers, frame in (({"margin": 0.5, "latency": math.inf}, "of a run"), ({"low": -1.0}, "")):
        data = numbers_at(1_500_000_007, numbers, frame)
        message = deserialize_message(data, JointState)
        assert dict(zip(message.name, message.position, strict=True)) == numbers
        decoded: Any = decode(data, JOINTS, standard_types())  # to the byte
        assert decoded.position.tolist() == list(numbers.values())
        assert header_stamp_ns(data) == 1_500_000_007
        assert header_frames(data, JOINTS, standard_types()) == message.header.frame_id == frame


def test_a_message_that_is_all_signal_has_no_others_to_refuse() -> None:
    paths = [f"/u:twist.{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"]
    whole = SignalMessage(SignalVector.parse(paths), TWIST, "refused")
    assert whole.make(0, [1, 2, 3, 4, 5, 6]).twist.angular.z == 6.0


def test_an_installed_type_is_read_and_written_as_a_standard_one_is() -> None:
    assert GOALS not in standard_types().fielddefs
    types = installed_types(GOALS)
    assert is_stamped(GOALS, types)
    path = SignalPath.parse("/goals:goals[0].pose.position.x")
    path.check(GOALS, types)
    Sampler([str(path)], ["/goals:goals[0].pose.position.y"], period=0.1).check(
        "/goals", GOALS, types
    )
    with pytest.raises(BagError, match="Field 'goal' does not exist"):
        SignalPath.parse("/goals:goal[0].x").check(GOALS, types)
    header_only = SignalMessage(SignalVector.parse(["/goals:header.stamp.sec"]), GOALS)
    assert header_only.kind is message_class(GOALS)


def test_the_installed_definition_of_a_standard_type_is_the_standard_one() -> None:
    """What is made of rclpy's descriptions against the .msg files that rosbags ships."""
    standard = standard_types().fielddefs
    kinds = [kind for kind in standard if kind.partition("/")[0] in ("geometry_msgs", "nav_msgs")]
    for kind in ("sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", *kinds):
        for name, (_, fields) in installed_types(kind).fielddefs.items():
            assert fields == standard[name][1], name
    with pytest.raises(BagError, match="is not installed"):
        installed_types("no_such/msg/Thing")
    found = [path for path, *_ in numeric_paths(GOALS, installed_types(GOALS))]
    assert "goals[*].pose.position.x" in found
