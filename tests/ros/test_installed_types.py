"""Types that are installed beside ROS but not among the definitions that rosbags ships."""

import pytest

pytest.importorskip("rclpy", reason="needs rclpy (extra `ros`)")

from bags.recordings.message_types import is_stamped, standard_types
from bags.signals.sampling import Sampler
from bags.signals.signal import SignalPath, numeric_paths
from nlsid_core.errors import BagError
from nlsid_ros.message_classes import installed_types, message_class
from nlsid_ros.messages import SignalMessage

pytestmark = [
    pytest.mark.ros,
    pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning"),
]
GOALS = "nav_msgs/msg/Goals"  # a header and poses


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
    header_only = SignalMessage(SignalPath.parse("/goals:header.stamp.sec"), GOALS)
    assert header_only.kind is message_class(GOALS)


def test_the_installed_definition_of_a_standard_type_is_the_standard_one() -> None:
    """What is made of rclpy's descriptions against the .msg files that rosbags ships."""
    from nlsid_ros.message_classes import _describe

    for kind in ("sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry", "sensor_msgs/msg/Image"):
        texts: dict[str, str] = {}
        _describe(kind, texts)
        fields = [line.split()[1] for line in texts[kind].splitlines()]
        assert fields == list(dict.fromkeys(f for f, _ in standard_types().fielddefs[kind][1]))
    assert installed_types("sensor_msgs/msg/Imu") is standard_types()
    with pytest.raises(BagError, match="is not installed"):
        installed_types("no_such/msg/Thing")
    found = [path for path, *_ in numeric_paths(GOALS, installed_types(GOALS))]
    assert "goals[*].pose.position.x" in found
