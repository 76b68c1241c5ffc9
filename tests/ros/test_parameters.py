"""Every node and its parameters: what makes no sense is refused by name, the rest is documented."""

import json
import re
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

import rclpy

from bags.chain.shipped import config_file
from docs.site import nodes as page
from docs.site.nodes import NODES, node_class
from nlsid import NlsidError, f1tenth
from tests.ros.processes import Bench, refusal, ros_test

pytestmark = ros_test
TRIAL = str(f1tenth()[4])
MOVED: dict[str, object] = {"highest": 0.4, "slew": 1.0}
RECORDED: dict[str, object] = {"topics": "[/x]"}
IDENTIFIED: dict[str, object] = {"bags": f"['{TRIAL}']", "config": str(config_file("f1tenth.yaml"))}
NOTHING: dict[str, tuple[dict[str, object], str]] = {  # by which a node refuses to start
    "excitation": ({}, "to what the robot may do"),
    "trajectory_recorder": ({}, "no topics to record; set the parameter topics"),
    "model_identifier": ({}, "set the parameters bags and out"),
    "funnel_publisher": ({}, "no funnel to publish; set the parameter funnel"),
    "tracking_controller": ({}, "no room between lowest and highest"),
    "funnel_monitor": ({"nominal": "profil"}, "it should be command or profile"),
    "plant": ({}, "no model to simulate; set the parameter model"),
    "viewer": ({"port": -1}, "parameter port (port; 0: one that is free)"),
    "bag_player": ({}, "no bag to play; set the parameter bag"),
}
OTHERS = '\'{"twist": {"angular": 1}}\''  # quoted, or ROS reads it itself
WRONG: list[tuple[str, dict[str, object], str]] = [
    ("tracking_controller", {"highest": 0.4, "settling": -1.0}, "parameter settling"),
    ("tracking_controller", {"highest": "much"}, "parameter highest (greatest input, or a list; "),
    ("tracking_controller", {"highest": 2 * 10**9}, "is not in [-1000000000.0, 1000000000.0]"),
    ("tracking_controller", {"lowest": 0.2, "highest": 0.4}, "limits: 0.0 should be in"),
    ("tracking_controller", MOVED | {"others": OTHERS}, "twist: angular: 1 should be an object"),
    ("tracking_controller", MOVED | {"commissioning": "x"}, "what is not proved: set stop_service"),
    ("funnel_publisher", {"funnel": "/nowhere/funnel.json"}, "nowhere"),
    ("funnel_publisher", {"funnel": "["}, "ROS refuses: Failed to parse ROS arguments"),
    ("funnel_monitor", {"stale_after": -0.1}, "parameter stale_after (s without a response, or"),
    ("funnel_monitor", {"stale_after": "soon"}, "parameter stale_after"),
    ("funnel_monitor", {"allow_old_stamps": 3}, "parameter allow_old_stamps"),
    ("funnel_monitor", {"check_seconds": 0}, "parameter check_seconds"),
    ("funnel_monitor", {"expected_digest": "abc"}, "it should have 64 hexadecimal digits"),
    ("funnel_monitor", {"source": "a-b"}, "Invalid topic name: topic name must not contain"),
    ("funnel_monitor", {"use_sim_time": "yes please"}, "ROS refuses: Trying to set parameter"),
    ("trajectory_recorder", RECORDED | {"chunk_period": 5.0}, "Min: 0.05, Max: 0.9, value: 5.0"),
    ("trajectory_recorder", RECORDED | {"snapshot": "long"}, "parameter snapshot (s kept in"),
    ("trajectory_recorder", {"topics": "['/x:=os/system']"}, "'os/system' is not a message type"),
    ("trajectory_recorder", {"topics": "['/x:=no_such/msg/Y']"}, "no_such/msg/Y"),
    ("trajectory_recorder", {"topics": "['/x*:=a/msg/B']"}, "a pattern cannot have a type"),
    ("trajectory_recorder", RECORDED | {"bag": TRIAL}, "trial_05 exists already"),
    ("trajectory_recorder", RECORDED | {"definitions": "[/nowhere]"}, "no message definitions"),
    ("excitation", MOVED | {"slew": 0.0}, "to what the robot may do"),
    ("excitation", MOVED | {"period": 0.0}, "parameter period (s between commands)"),
    ("excitation", MOVED | {"repeats": 0}, "parameter repeats (how often it is played)"),
    ("excitation", MOVED | {"kind": "noise"}, "kind is 'noise'; it should be one of multisine"),
    ("excitation", MOVED | {"highest_hz": 1000.0}, "half the sample rate"),
    ("excitation", MOVED | {"command": "/cmd_vel:twist.speed"}, "speed"),
    ("excitation", MOVED | {"others": OTHERS}, "twist: angular: 1 should be an object"),
    ("model_identifier", IDENTIFIED | {"last": -1}, "parameter last (only the last so many of"),
    ("model_identifier", IDENTIFIED | {"config": "nowhere.yaml", "out": "out"}, "nowhere.yaml"),
    ("plant", {"kind": "unicycle"}, "one of model, mujoco_arm, mujoco_pendulum"),
    ("plant", {"__ns": "robot1"}, "a namespace begins with a slash: /robot1"),
    ("bag_player", {"bag": TRIAL, "wait_for": -1}, "parameter wait_for (subscribers each topic"),
    ("bag_player", {"bag": "nowhere"}, "there is no bag nowhere"),
    ("bag_player", {"bag": TRIAL, "topics": "[/imu]"}, "has no topic /imu; it has: /cmd_vel"),
]


@pytest.fixture
def ros() -> Iterator[None]:
    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.mark.usefixtures("ros")
@pytest.mark.parametrize(("name", "parameters", "message"), WRONG)
def test_a_parameter_that_makes_no_sense_is_refused_by_name(
    name: str, parameters: dict[str, object], message: str
) -> None:
    settings = [
        word
        for key, value in parameters.items()
        for word in ("-r" if key.startswith("__") else "-p", f"{key}:={value}")
    ]
    with pytest.raises((NlsidError, OSError), match=re.escape(message)):
        node_class(name)(["--ros-args", *settings]).start_itself()


@pytest.mark.parametrize("name", NODES)
def test_a_node_that_cannot_start_says_why_in_a_line_and_ends_with_status_1(name: str) -> None:
    parameters, message = NOTHING[name]
    output = refusal(f"nlsid_ros.{name}", **parameters)
    assert re.search(rf"^{name}: .*{re.escape(message)}", output, re.MULTILINE)


@pytest.mark.parametrize("name", NODES)
def test_every_parameter_is_described_bounded_and_in_the_page(name: str) -> None:
    text = page.PAGE.read_text()
    for row in node_class(name).parameters:
        assert row.what, row.name
        is_number = isinstance(row.default, int | float) and not isinstance(row.default, bool)
        assert is_number is (row.between is not None), row.name
        assert f"| `{row.name}`" in text
        assert json.dumps(row.default) in text
    assert page.filled(text) == text, "run python -m docs.site.nodes"


def test_what_can_be_changed_while_a_node_runs_is_and_the_rest_is_refused(bench: Bench) -> None:
    monitor, controller = "funnel_monitor", "tracking_controller"
    bench.start(monitor)
    bench.start(controller, highest=1)
    assert bench.set(monitor, "warning_margin", 0.4) == ""
    assert bench.set(monitor, "stale_after", 0.5) == ""
    assert "stale_after" in bench.set(monitor, "stale_after", -1.0)
    assert "warning_margin" in bench.set(monitor, "warning_margin", 1.5)
    assert bench.set(monitor, "nominal", "profile") == "nominal: read when the node is configured"
    assert bench.set(controller, "highest", 0.3) == ""
    assert bench.set(controller, "highest", 1) == "", "a whole number is a number"
    assert "is not a number" in bench.set(controller, "highest", "much")
    assert "no room between" in bench.set(controller, "highest", 0.0)
    assert "stop_rate" in bench.set(controller, "stop_rate", 0.0)


def test_a_player_that_nobody_listens_to_says_so_and_ends() -> None:
    given = {"bag": TRIAL, "topics": "[/odom]", "wait_timeout": 0.2}
    said = refusal("nlsid_ros.bag_player", **given)
    assert "bag_player: fewer than 1 subscribers on /odom after 0.2 s" in said
