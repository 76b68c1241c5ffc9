"""Field paths: what they parse to, what they refuse, and the numbers they find."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from bags.recordings.message_types import header_stamp_ns, is_stamped, standard_types, types_in_bag
from bags.signals.signal import SignalPath
from nlsid_core.errors import BagError
from tests.bag_messages import JOINT_TYPE, ODOM_TYPE, START_NS, joints, odometry


@pytest.mark.parametrize(
    "text",
    [
        "",
        "/odom",
        "/odom:",
        "odom-:twist",
        "/odom/:twist",
        "/odom:twist..x",
        "/odom:twist.x[",
        "/odom:twist.x[-1]",
        "/odom:twist.x[0][1]",
        "/odom:__class__.__mro__[0]",
        "/odom:twist.x()",
        "/odom:twist.x ",
        "/odom:twist.x\n",
        "/odom:x[٣]",
        "/ödom:x",
        "/odom:x[1234567890]",
    ],
)
def test_what_is_not_a_path_is_refused_with_the_form_it_should_have(text: str) -> None:
    with pytest.raises(BagError, match=r"a signal is written topic:field\.path\[index\]"):
        SignalPath.parse(text)


@given(st.text(max_size=40))
def test_any_text_is_a_path_that_prints_back_or_a_bag_error(text: str) -> None:
    try:
        path = SignalPath.parse(text)
    except BagError:
        return
    assert SignalPath.parse(str(path)) == path


def test_a_missing_field_is_named_beside_those_that_exist() -> None:
    path = SignalPath.parse("/imu:x")
    with pytest.raises(BagError) as caught:
        path.check("sensor_msgs/msg/Imu", standard_types())
    assert str(caught.value) == (
        "/imu:x: Field 'x' does not exist on 'sensor_msgs/msg/Imu'; it has: header, orientation, "
        "orientation_covariance, angular_velocity, angular_velocity_covariance, "
        "linear_acceleration, linear_acceleration_covariance; did you mean '/imu:orientation.x'?"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("/odom:twist.twist", "is a 'geometry_msgs/msg/Twist', not a number; it has: linear, ang"),
        ("/odom:child_frame_id", "is a string, not a number"),
        ("/odom:twist.covariance", r"is an array; name one element, e\.g\. covariance\[0\]"),
        ("/odom:twist.covariance[36]", r"has 36 elements, \[0\] to \[35\]"),
        ("/odom:twist.twist.linear.x.y", "a float64 has no field 'y'"),
        ("/odom:twist[0].twist.linear.x", r"not an array; leave out \[0\]"),
        ("/odom:twist.twist.linear.w", "has: x, y, z"),
    ],
)
def test_a_path_that_leads_to_no_number_says_why(text: str, message: str) -> None:
    with pytest.raises(BagError, match=message):
        SignalPath.parse(text).check(ODOM_TYPE, standard_types())


def test_values_come_from_nested_fields_fixed_arrays_and_dynamic_arrays() -> None:
    types = standard_types()
    message = types.deserialize_cdr(odometry(START_NS, 0.375), ODOM_TYPE)
    assert SignalPath.parse("/odom:twist.twist.linear.x").value(message) == 0.375
    assert SignalPath.parse("/odom:pose.covariance[35]").value(message) == 0.0
    assert SignalPath.parse("/odom:header.stamp.sec").value(message) == START_NS // 10**9
    position = SignalPath.parse("/joint_states:position[1]")
    position.check(JOINT_TYPE, types)
    arm = types.deserialize_cdr(joints(START_NS, [0.5, -0.25]), JOINT_TYPE)
    assert position.value(arm) == -0.25


def test_header_stamps_are_read_from_serialised_bytes_of_either_byte_order() -> None:
    stamp = START_NS + 123_456_789
    assert header_stamp_ns(odometry(stamp, 0.0)) == stamp
    types = standard_types()
    message = types.deserialize_cdr(odometry(stamp, 0.0), ODOM_TYPE)
    big = bytes(types.serialize_cdr(message, ODOM_TYPE, little_endian=False))
    assert header_stamp_ns(big) == stamp
    for damaged in (b"", big[:11], b"\x01" + big[1:], b"\x00\x07" + big[2:]):
        with pytest.raises(BagError, match="not a CDR message"):
            header_stamp_ns(damaged)
    assert is_stamped(ODOM_TYPE, types)
    assert not is_stamped("geometry_msgs/msg/Twist", types)


def test_a_custom_type_defined_in_the_bag_is_used() -> None:
    text = "float64[2] torque\nint32 from\nmy_robot/Gear[] gears\n" + "=" * 80
    text += "\nMSG: my_robot/Gear\nfloat32 ratio\n"
    types = types_in_bag("my_robot/msg/Drive", _msg(text))
    for path in ("torque[1]", "from", "gears[3].ratio"):
        SignalPath.parse(f"/drive:{path}").check("my_robot/msg/Drive", types)
    gear = types.types["my_robot/msg/Gear"](2.5)
    drive = types.types["my_robot/msg/Drive"](np.array([1.0, 2.0]), 7, [gear])
    data = types.serialize_cdr(drive, "my_robot/msg/Drive")
    decoded = types.deserialize_cdr(data, "my_robot/msg/Drive")
    assert SignalPath.parse("/drive:torque[1]").value(decoded) == 2.0
    assert SignalPath.parse("/drive:from").value(decoded) == 7.0
    assert SignalPath.parse("/drive:gears[0].ratio").value(decoded) == 2.5


@pytest.mark.parametrize(
    "text",
    [
        "float64 x\n" + "=" * 80 + "\nMSG: a/B('x')\nfloat64 y\n",
        "string[100000000] names\n",
        "my_robot/Loop loop\n",
        "not a definition at all $$$\n",
        "Unknown thing\n",
    ],
)
def test_a_definition_that_cannot_be_used_is_a_bag_error(text: str) -> None:
    with pytest.raises(BagError, match=r"definition of 'my_robot/msg/Loop' in the bag"):
        types_in_bag("my_robot/msg/Loop", _msg(text))


def _msg(text: str) -> MessageDefinition:
    return MessageDefinition(MessageDefinitionFormat.MSG, text)
