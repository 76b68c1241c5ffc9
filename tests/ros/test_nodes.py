"""What every node promises: its interface, its lifecycle, its parameters, a clean end."""

import re
import signal
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from bags.designs import documents
from bags.samples import f1tenth
from tests.ros.processes import ROOT, Bench, ros_test, stop

pytestmark = ros_test

ROW = re.compile(r"\| \*?`([^`]+)`\*? \| (\S+) \| (publishes|subscribes|serves|calls) \| (.*) \|")
OF_EVERY_NODE = re.compile(
    r"/rosout|/parameter_events|/clock|~/(transition_event|change_state|get_state|"
    r"get_available_states|get_available_transitions|get_transition_graph|get_type_description|"
    r"(describe|get|list|set)_\w*parameter\w*)"
)


def documented(name: str) -> set[tuple[str, str, str, str]]:
    """(topic or service, type, way, QoS) of a node in docs/nodes.md."""
    section = (ROOT / "docs" / "nodes.md").read_text().split(f"## {name}\n")[1].split("\n## ")[0]
    return {match.groups() for match in map(ROW.match, section.splitlines()) if match}  # type: ignore[misc]


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


def settings_of(funnel: Path, folder: Path) -> dict[str, dict[str, object]]:
    """What every node needs to work on the car's funnel."""
    return {
        "excitation": {"highest": 1.0, "slew": 1.0},
        "trajectory_recorder": {"topics": "[/odom]", "bag": folder / "bag", "snapshot": 10.0},
        "model_identifier": {
            "bags": f"['{f1tenth()[0]}']",
            "config": ROOT / "config" / "f1tenth.yaml",
            "out": folder,
        },
        "funnel_publisher": {"funnel": funnel},
        "tracking_controller": {"highest": 0.4},
        "funnel_monitor": {
            "controller": "tracking_controller",
            "stop_service": "tracking_controller/stop",
            "snapshot_service": "trajectory_recorder/snapshot",
        },
        "plant": {"model": funnel.with_name(documents.MODEL)},
        "viewer": {"port": 0},
    }


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_the_graph_of_the_running_processes_is_the_documented_one_and_they_end_cleanly(
    bench: Bench, funnel: Path, tmp_path: Path, how: signal.Signals
) -> None:
    given = settings_of(funnel, tmp_path)
    started = [bench.start(name, **parameters) for name, parameters in given.items()]
    bench.spin_until(lambda: given.keys() <= set(bench.node.get_node_names()))
    for name in given:
        expected = documented(name)
        assert len(expected) >= 2
        try:
            bench.spin_until(lambda n=name, e=expected: running(bench.node, n) == e)  # type: ignore[misc]
        except AssertionError:
            assert running(bench.node, name) == expected, name
    for each in started:
        assert "Traceback" not in stop(each, how)
    assert (tmp_path / "bag" / "metadata.yaml").is_file(), "the bag was closed"


@pytest.mark.parametrize("waited", [0.0, 1.0, 3.0])
def test_a_player_ends_like_the_others_when_it_is_told_to_while_it_starts(
    bench: Bench, waited: float
) -> None:
    player = bench.start("bag_player", bag=f1tenth()[4])
    bench.spin_until(lambda: "bag_player" in bench.node.get_node_names())
    bench.waits(waited)
    assert "Traceback" not in stop(player, signal.SIGTERM)


def test_nodes_hear_each_other_under_other_names_and_in_a_namespace(
    bench: Bench, funnel: Path
) -> None:
    moved = {"__ns": "/robot"}
    bench.start("funnel_publisher", funnel=funnel, __node="publisher", **moved)
    bench.start("funnel_monitor", source="publisher", **moved)
    bench.hears("no speed yet", "robot/funnel_monitor")
    assert bench.call("/robot/funnel_monitor/restart").success
