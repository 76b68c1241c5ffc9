"""What every node promises: its interface, its lifecycle, its parameters, a clean end."""

import json
import re
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from bags.designs import documents
from bags.designs.bundle import Bundle
from nlsid_core import files
from nlsid_ros import qos
from nlsid_ros.interfaces import example_nodes
from tests.ros.processes import (
    ROOT,
    call,
    node_here,
    process,
    refusal,
    ros_test,
    service,
    set_parameter,
    stop,
)

pytestmark = ros_test

ROW = re.compile(r"\| \*?`([^`]+)`\*? \| (\S+) \| (publishes|subscribes|serves|calls) \| (.*) \|")
OF_EVERY_NODE = re.compile(
    r"/rosout|/parameter_events|/clock|~/(transition_event|change_state|get_state|"
    r"get_available_states|get_available_transitions|get_transition_graph|get_type_description|"
    r"(describe|get|list|set)_\w*parameter\w*)"
)


def documented(name: str) -> set[tuple[str, str, str, str]]:
    """(topic or service, type, way, QoS without its depth) of a node in docs/nodes.md."""
    section = (ROOT / "docs" / "nodes.md").read_text().split(f"## {name}\n")[1].split("\n## ")[0]
    rows = {match.groups() for match in map(ROW.match, section.splitlines()) if match}
    return {(topic, kind, way, re.sub(r",? *depth \d+", "", q)) for topic, kind, way, q in rows}


def running(node: Node, name: str) -> set[tuple[str, str, str, str]]:
    """The same of a running process, as the graph knows it."""
    asked: list[tuple[str, Any, Any]] = [
        (
            "publishes",
            node.get_publisher_names_and_types_by_node,
            node.get_publishers_info_by_topic,
        ),
        (
            "subscribes",
            node.get_subscriber_names_and_types_by_node,
            node.get_subscriptions_info_by_topic,
        ),
        ("serves", node.get_service_names_and_types_by_node, None),
        ("calls", node.get_client_names_and_types_by_node, None),
    ]
    found = set()
    for way, names, infos in asked:
        for topic, [kind] in names(name, "/"):
            shown = topic.replace(f"/{name}/", "~/")
            if OF_EVERY_NODE.fullmatch(shown):
                continue
            profiles = [i.qos_profile for i in infos(topic) if i.node_name == name] if infos else []
            found.add((shown, kind, way, describe(profiles[0]) if profiles else ""))
    return found


def describe(profile: QoSProfile) -> str:
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return ("reliable" if reliable else "best effort") + (", latched" if latched else "")


def test_the_graph_of_the_running_processes_is_the_documented_one(tmp_path: Path) -> None:
    nodes = example_nodes(tmp_path)
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_onlooker"))
        for name, _, parameters in nodes:
            given = {key: json.dumps(value) for key, value in parameters.items()}
            stack.enter_context(process(f"nlsid_ros.{name}", **given))
        names = [name for name, *_ in nodes]
        spin_until(lambda: set(names) <= set(node.get_node_names()))
        for name in names:
            expected = documented(name)
            assert len(expected) >= (2 if name == "viewer" else 3), "it hears two topics"
            try:
                spin_until(lambda n=name, e=expected: running(node, n) == e)  # type: ignore[misc]
            except AssertionError:
                assert running(node, name) == expected, name


EACH: dict[str, dict[str, object]] = {
    "excitation": {"highest": 1.0, "slew": 1.0},
    "trajectory_recorder": {"topics": "[/odom]"},
    "model_identifier": {},
    "funnel_publisher": {},
    "tracking_controller": {"highest": 0.4},
    "funnel_monitor": {},
    "plant": {"kind": "pendulum"},
    "viewer": {"page": True, "port": 18_080},
}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_every_node_ends_cleanly_when_asked_to(
    funnel: Path, tmp_path: Path, how: signal.Signals
) -> None:
    given = {name: dict(values) for name, values in EACH.items()}
    given["trajectory_recorder"]["bag"] = tmp_path / "bag"
    given["funnel_publisher"]["funnel"] = funnel
    given["model_identifier"] = {
        "bags": f"['{tmp_path}']",
        "config": ROOT / "config" / "f1tenth.yaml",
        "out": tmp_path / "out",
    }
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_onlooker"))
        started = [
            stack.enter_context(process(f"nlsid_ros.{name}", **values))
            for name, values in given.items()
        ]
        spin_until(lambda: given.keys() <= set(node.get_node_names()))
        for name in given:
            service(node, spin_until, f"/{name}/change_state", ChangeState)
        settled = time.monotonic() + 1.0
        spin_until(lambda: time.monotonic() > settled)
        for each in started:
            assert "Traceback" not in stop(each, how)
    assert (tmp_path / "bag" / "metadata.yaml").is_file(), "the bag was closed"


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("tracking_controller", {"highest": 0.4, "settling": -1.0}, "parameter settling"),
        (
            "tracking_controller",
            {"highest": "much"},
            "parameter highest (greatest input, or a list; must be",
        ),
        ("tracking_controller", {"highest": 2 * 10**9}, "is not in [-1000000000.0, 1000000000.0]"),
        ("tracking_controller", {}, "no room between lowest and highest"),
        ("tracking_controller", {"lowest": 0.2, "highest": 0.4}, "limits: 0.0 should be in"),
        ("funnel_publisher", {"funnel": "/nowhere/funnel.json"}, "nowhere"),
        ("funnel_publisher", {"watch": 3}, "parameter watch"),
        ("funnel_monitor", {"check_seconds": 0}, "parameter check_seconds"),
        (
            "funnel_monitor",
            {"stale_after": -0.1},
            "parameter stale_after (s without a response, or",
        ),
        ("funnel_monitor", {"stale_after": "soon"}, "parameter stale_after"),
        ("funnel_monitor", {"nominal": "profil"}, "profil"),
        ("funnel_monitor", {"source": "a-b"}, "Invalid topic name: topic name must not contain"),
        ("plant", {"__ns": "robot1"}, "a namespace begins with a slash: /robot1"),
        ("funnel_publisher", {"funnel": "["}, "ROS refuses: failed to initialize rcl: Couldn't"),
        ("funnel_monitor", {"use_sim_time": "yes please"}, "ROS refuses: Trying to set parameter"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_refused_at_the_start(
    name: str, parameters: dict[str, object], message: str
) -> None:
    assert message in refusal(f"nlsid_ros.{name}", **parameters)


def test_what_can_be_changed_while_a_node_runs_is_and_the_rest_is_refused(funnel: Path) -> None:
    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.funnel_monitor") as monitor,
        process("nlsid_ros.tracking_controller", highest=1) as controller,
    ):

        def ask(name: str, key: str, value: float | str) -> str:
            return set_parameter(node, spin_until, name, key, value)

        assert ask("funnel_monitor", "warning_margin", 0.4) == ""
        assert ask("funnel_monitor", "stale_after", 0.5) == ""
        assert "stale_after" in ask("funnel_monitor", "stale_after", -1.0)
        assert "warning_margin" in ask("funnel_monitor", "warning_margin", 1.5)
        refused = ask("funnel_monitor", "nominal", "profile")
        assert refused == "nominal: read when the node is configured"
        assert ask("tracking_controller", "highest", 0.3) == ""
        assert ask("tracking_controller", "highest", 1) == "", "a whole number is a number"
        assert "is not a number" in ask("tracking_controller", "highest", "much")
        assert "no room between" in ask("tracking_controller", "highest", 0.0)
        assert "stop_rate" in ask("tracking_controller", "stop_rate", 0.0)
        assert funnel.is_file()
        stop(monitor)
        stop(controller)


def test_the_publisher_takes_another_funnel_while_it_runs_if_it_is_proved(
    funnel: Path, tmp_path: Path
) -> None:
    heard: list[str] = []

    def hear(message: String) -> None:
        heard.append(Bundle.parse(message.data).digest)

    names = (documents.MODEL, documents.POLICY, documents.FUNNEL, documents.FUNNEL_PROOF)
    for place in ("good", "forged"):
        (tmp_path / place).mkdir()
        for name in names:
            (tmp_path / place / name).write_bytes((funnel.parent / name).read_bytes())
    forged = files.load_document(tmp_path / "forged" / documents.FUNNEL)
    forged["tubes"][0]["level"] *= 2.0
    files.write_document(tmp_path / "forged" / documents.FUNNEL, forged)
    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.funnel_publisher", funnel=funnel) as publisher,
    ):
        node.create_subscription(String, "/funnel_publisher/design", hear, qos.DOCUMENT)
        spin_until(lambda: len(heard) == 1)
        good, bad = (str(tmp_path / place / documents.FUNNEL) for place in ("good", "forged"))
        assert "not the funnel this proof is about" in set_parameter(
            node, spin_until, "funnel_publisher", "funnel", bad
        )
        assert set_parameter(node, spin_until, "funnel_publisher", "funnel", good) == ""
        spin_until(lambda: len(heard) == 2)
        stop(publisher)
    assert heard[0] == heard[1], "the forged one was never published"


@pytest.mark.parametrize("name", ["funnel_publisher", "funnel_monitor", "tracking_controller"])
def test_a_node_goes_through_its_lifecycle_again_and_again(funnel: Path, name: str) -> None:
    own = {
        "funnel_publisher": "/funnel_publisher/design",
        "funnel_monitor": "/funnel_monitor/margin",
        "tracking_controller": "/tracking_controller/run",
    }[name]
    given: dict[str, object] = {"autostart": False}
    given |= {"funnel": funnel} if name == "funnel_publisher" else {}
    given |= {"highest": 0.4} if name == "tracking_controller" else {}
    takes = {"funnel_monitor": "no speed yet", "tracking_controller": "idle"}.get(name, "PROVED")
    said: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        said.extend(status.message for status in message.status if status.name == name)

    with (
        node_here("test_manager") as (node, spin_until),
        process("nlsid_ros.funnel_publisher", funnel=funnel, __node="source"),
        process(f"nlsid_ros.{name}", **given, source="source") as managed,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)

        def to(transition: int) -> None:
            wanted = Transition(id=transition)
            assert call(
                node, spin_until, f"/{name}/change_state", ChangeState, transition=wanted
            ).success

        for _ in range(2):
            to(Transition.TRANSITION_CONFIGURE)
            assert node.count_publishers(own) == 0
            for _ in range(2):
                to(Transition.TRANSITION_ACTIVATE)
                spin_until(lambda: node.count_publishers(own) == 1)
                spin_until(lambda: any(takes in text for text in said))
                said.clear()
                to(Transition.TRANSITION_DEACTIVATE)
                spin_until(lambda: node.count_publishers(own) == 0)
            to(Transition.TRANSITION_CLEANUP)
        to(Transition.TRANSITION_CONFIGURE)
        to(Transition.TRANSITION_ACTIVATE)
        stop(managed)


def test_the_funnels_picture_is_in_the_frame_that_was_asked_for(funnel: Path) -> None:
    tubes: list[MarkerArray] = []
    plans: list[JointTrajectory] = []
    with (
        node_here("test_onlooker") as (node, spin_until),
        process("nlsid_ros.funnel_publisher", funnel=funnel, frame="odom") as publisher,
    ):
        node.create_subscription(MarkerArray, "/funnel_publisher/tube", tubes.append, qos.DOCUMENT)
        node.create_subscription(
            JointTrajectory, "/funnel_publisher/nominal", plans.append, qos.DOCUMENT
        )
        spin_until(lambda: len(tubes) > 1 and bool(plans))
        stop(publisher)
    assert {marker.header.frame_id for marker in tubes[0].markers} == {"odom"}
    assert tubes[0].markers[0].action == Marker.DELETEALL
    assert all(marker.header.stamp.sec > 0 for marker in tubes[0].markers)
    assert all(marker.frame_locked for marker in tubes[0].markers[1:])
    assert all(marker.lifetime.sec == 3 for marker in tubes[0].markers[1:]), "it goes with its node"
    assert tubes[0].markers[1].header.stamp != tubes[1].markers[1].header.stamp
    assert all(marker.pose.orientation.w == 1.0 for marker in tubes[0].markers)
    times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in plans[0].points]
    assert times[:2] == [0.0, pytest.approx(0.025)]
    assert max(p.positions[0] for p in plans[0].points) == pytest.approx(0.35, abs=0.1), "m/s"


def test_nodes_hear_each_other_under_other_names_and_in_a_namespace(funnel: Path) -> None:
    said: dict[str, str] = {}
    margins: list[JointState] = []

    def hear(message: DiagnosticArray) -> None:
        said.update({status.name: status.message for status in message.status})

    moved: dict[str, object] = {"__ns": "/robot", "__node": "publisher"}
    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.funnel_publisher", funnel=funnel, **moved) as publisher,
        process("nlsid_ros.funnel_monitor", source="publisher", __ns="/robot") as monitor,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        node.create_subscription(
            JointState, "/robot/funnel_monitor/margin", margins.append, qos.STREAM
        )
        service(node, spin_until, "/robot/funnel_monitor/restart")
        spin_until(lambda: "no speed yet" in said.get("robot/funnel_monitor", ""))
        stop(publisher)
        stop(monitor)
