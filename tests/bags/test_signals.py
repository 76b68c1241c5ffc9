"""Signals: paths, units, angles, derivatives; parsed, checked against the type, and right."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

import bags
from bags.chain.training import load_trials, save_trials
from bags.recordings.message_types import header_stamp_ns, is_stamped, standard_types, types_in_bag
from bags.recordings.writer import BagWriter
from bags.signals.expressions import Expression, derivative
from bags.signals.reader import read_signals
from bags.signals.signal import SignalPath, numeric_paths, quaternion_angle
from bags.signals.units import UNITS, conversion, implied_unit
from nlsid_core.errors import BagError
from tests.bag_messages import (
    JOINT_TYPE,
    ODOM_TYPE,
    START_NS,
    joints,
    odometry,
    serialised,
    speed_bag,
)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "/odom",
        "/odom:",
        "-odom:twist",
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
        "/a b:x",
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
    for path, value in {
        "/odom:twist.twist.linear.x": 0.375,
        "/odom:pose.covariance[35]": 0.0,
        "/odom:header.stamp.sec": START_NS // 10**9,
    }.items():
        assert SignalPath.parse(path).value(message) == value
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
    for path, value in (("torque[1]", 2.0), ("from", 7.0), ("gears[0].ratio", 2.5)):
        assert SignalPath.parse(f"/drive:{path}").value(decoded) == value


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


# -- Signals with units, angles, derivatives: parsed, checked against the type, and right

ODOM_YAW = "/odom:pose.pose.orientation.yaw"


def arm_bag(path: Path, rows: int = 40) -> Path:
    with BagWriter(path) as bag:
        for k in range(rows):
            stamp = START_NS + k * 10_000_000
            data = joints(stamp, [0.01 * k, -1.0, 0.5 * (0.01 * k) ** 2])
            bag.write("/arm", JOINT_TYPE, data, log_time_ns=stamp + 7, publish_time_ns=stamp + 3)
    return path


def test_every_element_is_one_signal_each(tmp_path: Path) -> None:
    named = "/arm:position[name=joint_1]"
    read = read_signals(arm_bag(tmp_path / "arm"), ["/arm:position[*]", named])
    assert list(read) == [*(f"/arm:position[{k}]" for k in range(3)), named]
    assert {*read[named].values, *read["/arm:position[1]"].values} == {-1.0}
    assert read["/arm:position[0]"].unit == "rad or m"


def test_the_clock_can_be_chosen(tmp_path: Path) -> None:
    bag = arm_bag(tmp_path / "arm")
    for clock, after in (("", 0), ("|clock(header)", 0), ("|clock(log)", 7)):
        [read] = read_signals(bag, [f"/arm:position[0]{clock}"]).values()
        assert read.stamp_ns[0] == START_NS + after


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("/arn:position[0]", "did you mean '/arm'"),
        ("/arm:positions[0]", "did you mean '/arm:position"),
        ("/arm:position[0]|to(degg)", "did you mean 'deg'"),
        ("/arm:position[0]|derivate(1 s)", "did you mean 'derivative'"),
        ("/arm:position[0]|", "is not one of: unit, to, unwrap"),
        ("/arm:position[0]|__import__(os)", "is not one of: unit, to, unwrap"),
        ("/arm:position[0]|to(deg)(rad)", "is not one of: unit, to, unwrap"),
        ("/arm:position[0]|to()", "is not one of: unit, to, unwrap"),
        ("/arm:position[0]|to", "known units are"),
        ("/arm:position[0]|to(s)", "cannot be converted to 's'"),
        ("/arm:position[0]|unwrap(1 s)", "unwrap takes no argument"),
        ("/arm:position[0]|derivative", "state a time"),
        ("/arm:position[0]|derivative(5)", "state a time"),
        ("/arm:position[0]|washout", "state a time"),
        *(
            (f"/arm:position[0]|{text}", "should be above 0 and below 1e6 s")
            for text in ("derivative(0 s)", "washout(0 s)", "washout(1e6 s)", "derivative(1e9 s)")
        ),
        ("/arm:position[name=elbow]", "'name' has no 'elbow'; it has: joint_0, joint_1, joint_2"),
        ("/arm:position[frame=elbow]", "'frame' on 'sensor_msgs/msg/JointState' is not an array"),
    ],
)
def test_what_is_wrong_with_a_signal_is_said(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(BagError) as caught:
        read_signals(arm_bag(tmp_path / "arm", 2), [text])
    assert reason in str(caught.value)


def test_a_washed_out_signal_is_the_sum_of_its_steps_each_faded_and_gives_the_signal_back() -> None:
    rng = np.random.default_rng(4)
    stamps = np.cumsum(rng.integers(5_000_000, 200_000_000, 120))
    p = np.cumsum(rng.standard_normal(120)) + 1e3
    q = Expression.parse("/a:b|washout(0.5 s)").apply(p, stamps, "m")
    t = stamps / 1e9
    steps = np.diff(p, prepend=p[0])
    faded = [sum(steps[: k + 1] * np.exp((t[: k + 1] - t[k]) / 0.5)) for k in range(120)]
    np.testing.assert_allclose(q, faded, atol=1e-12)
    lost = 1.0 - np.exp(-np.diff(t) / 0.5)
    for m, k in ((0, 119), (17, 18), (40, 90)):
        assert p[k] - p[m] == pytest.approx(q[k] - q[m] + lost[m:k] @ q[m:k], abs=1e-9)


def test_a_washout_bridges_what_is_no_number_and_refuses_stamps_that_go_back() -> None:
    expression = Expression.parse("/a:b|washout(1 s)")
    stamps = np.array([0, 1, 2, 3]) * 10**9
    found = expression.apply(np.array([5.0, 7.0, np.nan, 8.0]), stamps, "m")
    np.testing.assert_allclose(found, [0.0, 2.0, np.nan, 2.0 * np.exp(-2.0) + 1.0])
    with pytest.raises(BagError, match="stamps do not increase, so there is no washout"):
        expression.apply(np.zeros(4), stamps[::-1], "m")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("/a:b|washout(2 s)", 2.0),
        ("/a:b|unit(deg)|unwrap|washout(500 ms)|to(rad)|clock(log)", 0.5),
        ("/a:b|washout(2 s)|linear(0.1 s)", None),  # messages between two samples are not judged
        ("/a:b|linear(0.1 s)|washout(2 s)", None),
        ("/a:b|washout(2 s)|derivative(1 s)", None),
        ("/a:b|derivative(1 s)|washout(2 s)", None),  # what a slope moved is no displacement
        ("/a:b|washout(2 s)|washout(1 s)", None),
        ("/a:b|derivative(1 s)", None),
        ("/a:b", None),
    ],
)
def test_only_samples_that_are_washed_out_messages_tell_a_displacement(
    text: str, seconds: float | None
) -> None:
    assert Expression.parse(text).washed_out == seconds


def test_an_expression_prints_as_it_is_written() -> None:
    for text in (
        "/arm:position[0]|washout(2 s)",
        "/arm:position[0]|washout(1.23456789 s)",  # all digits: a model keeps its signals as text
        "/arm:position[0]|unit(rad)|to(deg)|derivative(0.2 s)",
        f"{ODOM_YAW}|unwrap",
    ):
        assert str(Expression.parse(text)) == text


def test_units_are_converted_only_within_their_kind(tmp_path: Path) -> None:
    bag = arm_bag(tmp_path / "arm")
    text = "/arm:position[0]|to(deg)"
    found = read_signals(bag, [text])[text]
    np.testing.assert_allclose(found.values, np.degrees(0.01 * np.arange(40)), rtol=1e-15)
    assert found.unit == "deg"
    assert conversion("degC", "K") == (1.0, 273.15)
    assert conversion("rad or m", "mm")[0] == pytest.approx(1000.0)
    for name, unit in UNITS.items():
        assert conversion(name, name) == (1.0, 0.0), unit


def test_standard_types_imply_units() -> None:
    types = standard_types()
    units = {
        path: implied_unit(owners)
        for path, _, owners in numeric_paths("nav_msgs/msg/Odometry", types)
    }
    assert units.items() >= {
        ("twist.twist.linear.x", "m/s"),
        ("twist.twist.angular.z", "rad/s"),
        ("pose.pose.position.y", "m"),
        ("pose.pose.orientation.w", ""),
        ("pose.covariance[*]", ""),
    }


@pytest.mark.parametrize("scale", [1.0, 0.3, 7.0])
def test_angles_of_a_quaternion_are_those_it_was_made_of(scale: float) -> None:
    rng = np.random.default_rng(3)
    roll, pitch, yaw = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (200, 3)).T
    a, b, c = roll / 2, pitch / 2, yaw / 2
    x = np.sin(a) * np.cos(b) * np.cos(c) - np.cos(a) * np.sin(b) * np.sin(c)
    y = np.cos(a) * np.sin(b) * np.cos(c) + np.sin(a) * np.cos(b) * np.sin(c)
    z = np.cos(a) * np.cos(b) * np.sin(c) - np.sin(a) * np.sin(b) * np.cos(c)
    w = np.cos(a) * np.cos(b) * np.cos(c) + np.sin(a) * np.sin(b) * np.sin(c)
    q = scale * np.array([x, y, z, w])
    for name, expected in (("roll", roll), ("pitch", pitch), ("yaw", yaw)):
        np.testing.assert_allclose(quaternion_angle(name, q), expected, atol=1e-12)
    assert math.isnan(quaternion_angle("yaw", np.zeros((4, 1)))[0])


def test_an_angle_reads_from_a_bag_and_live_alike(tmp_path: Path) -> None:
    types = standard_types()
    kind = "geometry_msgs/msg/QuaternionStamped"
    quaternion = types.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
    header = types.types["std_msgs/msg/Header"](
        types.types["builtin_interfaces/msg/Time"](1, 0), ""
    )
    message = types.types[kind](header, quaternion)
    with BagWriter(tmp_path / "q") as bag:
        bag.write("/q", kind, serialised(kind, message), log_time_ns=1, publish_time_ns=1)
    read = read_signals(tmp_path / "q", ["/q:quaternion.yaw"])["/q:quaternion.yaw"]
    path = SignalPath.parse("/q:quaternion.yaw")
    assert read.values[0] == path.value(message) == pytest.approx(2 * math.atan2(0.6, 0.8))
    assert read.unit == "rad"


def test_the_derivative_of_a_line_is_its_slope_at_any_stamps() -> None:
    rng = np.random.default_rng(4)
    stamps = START_NS + np.cumsum(rng.integers(5_000_000, 15_000_000, 200))
    t = (stamps - stamps[0]) / 1e9
    found = derivative(2.0 - 3.0 * t, stamps, 0.1)
    complete = t >= 0.1
    np.testing.assert_allclose(found[complete], -3.0, rtol=1e-9)
    assert np.isnan(found[~complete]).all()


def test_a_derivative_uses_nothing_later_and_is_delayed_by_half_its_window() -> None:
    stamps = np.arange(1000) * 1_000_000
    t = stamps / 1e9
    jump = derivative(np.where(t >= 0.5, 1.0, 0.0), stamps, 0.1)
    assert (jump[101:500] == 0.0).all()
    assert jump[500] > 0.0
    bent = derivative(t * t, stamps, 0.1)[101:]
    np.testing.assert_allclose(bent, 2 * (t[101:] - 0.05), rtol=1e-6)


def test_the_derivative_has_the_stated_frequency_response() -> None:
    window = 0.2
    stamps = np.arange(4000) * 1_000_000
    t = stamps / 1e9
    for f, gain in ((0.5, None), (0.58 / window, 1 / math.sqrt(2)), (1.43 / window, 0.0)):
        found = derivative(np.sin(2 * np.pi * f * t), stamps, window)[500:-500]
        phi = math.pi * f * window
        stated = 3 * (math.sin(phi) - phi * math.cos(phi)) / phi**3
        measured = np.abs(found).max() / (2 * np.pi * f)
        assert measured == pytest.approx(abs(stated), abs=0.01)
        if gain is not None:
            assert measured == pytest.approx(gain, abs=0.01)


def test_a_derivative_without_samples_or_order_is_refused() -> None:
    stamps = np.arange(50) * 10_000_000
    with pytest.raises(BagError, match="a slope needs 3 of them in a window"):
        derivative(np.ones(50), stamps, 0.001)
    with pytest.raises(BagError, match="stamps do not increase"):
        derivative(np.ones(3), np.array([0, 1, 1]), 1.0)


def test_a_dataset_knows_where_it_comes_from(tmp_path: Path) -> None:
    for name in ("a", "b"):
        speed_bag(tmp_path / name, np.sin(np.arange(60.0)), np.cos(np.arange(60.0)))
    dataset = bags.read(
        [tmp_path / "a", tmp_path / "b"],
        responses=["/odom:twist.twist.linear.x"],
        excitations=["/cmd_vel:twist.linear.x"],
    )
    trial = dataset.trajectories[0]
    assert trial.y_units == ("m/s",)
    assert trial.y_paths == ("/odom:twist.twist.linear.x",)
    for part in (trial.digest, '"a.mcap"', '"/odom:twist.twist.linear.x"', '"resample":"none"'):
        assert part in trial.provenance
    digest = save_trials(tmp_path / "trials.npz", {"training": dataset})
    again = load_trials(tmp_path / "trials.npz", digest=digest)["training"]
    assert again.trajectories[1].provenance == dataset.trajectories[1].provenance
