"""Fields of a command that are not the signal: never zero without a word, and limits per input."""

import math
import re
import time

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from geometry_msgs.msg import TwistStamped

from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core.errors import BagError
from nlsid_ros import qos
from nlsid_ros.messages import SignalMessage
from tests.ros.processes import call, node_here, process, refusal, ros_test

pytestmark = ros_test

TWIST = "geometry_msgs/msg/TwistStamped"
SPEED = SignalPath.parse("/cmd_vel:twist.linear.x")
PLAYED: dict[str, object] = {
    "kind": "steps",
    "hold": 0.2,
    "period": 0.02,
    "duration": 5.0,
    "pause": 0.0,
    "lowest": 0.1,
    "highest": 0.4,
    "slew": 5.0,
    "fade": 0.1,
    "rest": 0.1,
}


def test_the_other_fields_are_as_the_template_says() -> None:
    made = SignalMessage(
        SPEED, TWIST, '{"twist": {"angular": {"z": 1}}, "header": {"frame_id": "b"}}'
    )
    message = made.make(5, 0.25)
    assert (message.twist.linear.x, message.twist.angular.z) == (0.25, 1.0)
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("b", 5)
    assert not made.lacking()


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ("refused", "fields that are not the signal (twist.linear.y, twist.linear.z, twist.ang"),
        ('{"twist": {"turn": 1}}', "there is no 'turn'; there are: linear, angular"),
        ('{"twist": {"angular": {"z": "fast"}}}', "twist: angular: z is 'fast'; it should be dou"),
        ('{"twist": {"angular": {"z": true}}}', "twist: angular: z is True; it should be double"),
        ('{"twist": {"angular": {"z": [1]}}}', "z is [1]; it should be double"),
        ('{"twist": {"angular": {"z": NaN}}}', "NaN is not a number a document may hold"),
        ('{"twist": {"angular": {"z": -Infinity}}}', "-Infinity is not a number a document may h"),
        ('{"twist": {"angular": {"z": 1e400}}}', "1e400 does not fit a float64"),
        ('{"twist": {"angular": 1}}', "twist: angular: 1 should be an object of its fields"),
        ('{"twist": [0, 1]}', "twist: [0, 1] should be an object of its fields"),
        ('{"header": {"frame_id": {"a": 1}}}', "frame_id is {'a': 1}; it should be string"),
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
        ('{"velocity": [1, true]}', "velocity is [1, True]; it should be sequence<double>"),
        ('{"name": "wheel"}', "name is 'wheel'; it should be sequence<string>"),
        ('{"position": [1e400]}', "1e400 does not fit a float64"),
    ],
)
def test_others_in_lists_are_held_to_their_type_too(others: str, said: str) -> None:
    wheel, kind = SignalPath.parse("/wheels:effort[0]"), "sensor_msgs/msg/JointState"
    with pytest.raises(BagError, match=re.escape(said)):
        SignalMessage(wheel, kind, others)
    made = SignalMessage(wheel, kind, '{"name": ["a"], "velocity": [1, 2.5]}').make(0, 0.5)
    assert (made.name, list(made.velocity), list(made.effort)) == (["a"], [1.0, 2.5], [0.5])


@pytest.mark.parametrize("module", ["excitation", "tracking_controller"])
def test_a_node_refuses_others_that_do_not_fit_when_it_is_configured(module: str) -> None:
    others = '\'{"twist": {"angular": 1}}\''  # quoted, or ROS reads it itself
    said = refusal(f"nlsid_ros.{module}", highest=0.4, slew=1.0, others=others)
    assert "twist: angular: 1 should be an object of its fields" in said


def test_fields_on_a_topic_that_are_not_finite_are_not_passed_on() -> None:
    made, message = SignalMessage(SPEED, TWIST, "/teleop"), TwistStamped()
    for z, lacking in ((0.5, ""), (math.nan, "on /teleop, twist.angular.z is nan"), (0.5, "")):
        message.twist.angular.z = z
        made._on_other(message)
        assert made.lacking() == lacking


def test_a_message_that_is_all_signal_has_no_others_to_refuse() -> None:
    paths = [f"/u:twist.{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"]
    whole = SignalMessage(SignalVector.parse(paths), TWIST, "refused")
    assert whole.make(0, [1, 2, 3, 4, 5, 6]).twist.angular.z == 6.0


def test_what_is_not_the_signal_is_passed_through_from_a_topic_or_nothing_moves() -> None:
    """Steps of speed while another node steers; when that one stops, the robot goes to rest."""
    sent: list[TwistStamped] = []
    with (
        node_here("test_robot") as (node, spin_until),
        process("nlsid_ros.excitation", others="/teleop", **PLAYED),
    ):
        node.create_subscription(TwistStamped, "/cmd_vel", sent.append, qos.STREAM)
        steering = node.create_publisher(TwistStamped, "/teleop", qos.STREAM)
        spin_until(lambda: node.count_subscribers("/teleop") == 1)
        refused = call(node, spin_until, "/excitation/start")
        assert refused.message == "nothing on /teleop for 1 s, which has the other fields"
        message = TwistStamped()
        message.twist.linear.x, message.twist.angular.z = 9.0, 0.7
        timer = node.create_timer(0.1, lambda: steering.publish(message))
        settled = time.monotonic() + 0.5
        spin_until(lambda: time.monotonic() > settled)
        assert call(node, spin_until, "/excitation/start").success
        spin_until(lambda: len(sent) > 50)
        timer.cancel()
        quiet = [0, time.monotonic()]

        def ended() -> bool:
            if len(sent) != quiet[0]:
                quiet[:] = [len(sent), time.monotonic()]
            return time.monotonic() - quiet[1] > 1.0

        spin_until(ended)
    assert {each.twist.angular.z for each in sent} == {0.7}
    assert max(each.twist.linear.x for each in sent) <= 0.4
    assert len(sent) < 5.0 / 0.02, "it stopped before its end"
    assert sent[-1].twist.linear.x == 0.1, "at rest"
