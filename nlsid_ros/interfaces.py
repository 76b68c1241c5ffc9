"""docs/nodes.md, made by starting every node and asking it what it has.

python -m nlsid_ros.interfaces > docs/nodes.md
"""

import json
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import try_shutdown

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.samples import f1tenth
from nlsid_core.errors import NlsidError
from nlsid_core.progress import silent
from nlsid_ros.bag_player import BagPlayer
from nlsid_ros.excitation import Excitation
from nlsid_ros.funnel_monitor import FunnelMonitor
from nlsid_ros.funnel_publisher import FunnelPublisher
from nlsid_ros.model_identifier import ModelIdentifier
from nlsid_ros.plant import PlantNode
from nlsid_ros.running import ManagedNode, PlainNode
from nlsid_ros.tracking_controller import TrackingController
from nlsid_ros.trajectory_recorder import TrajectoryRecorder
from nlsid_ros.viewer import Viewer

HEAD = """# Every node's topics, services and parameters

Made from the running nodes by `python -m nlsid_ros.interfaces`; tests keep it true and hold the
graph of the running processes against it. `~` is the node's name; every name can be remapped, every
node put in a namespace. Topics in *italics* are named by the funnel's model or by a parameter; here
they are the F1TENTH car's. All nodes also have the services of a
[lifecycle node](https://design.ros2.org/articles/node_lifecycle.html). A parameter is read when the
node is configured; those marked • can be changed while it runs. The words are explained
in the [glossary](glossary.md).
"""
PLAYER = """## bag_player

No lifecycle: it plays a bag once and ends.

| topic or service | type | | QoS |
|---|---|---|---|
| *each topic of the bag* | as recorded | publishes | reliable, latched if it was, depth 5000 |
"""
PATIENCE = 20.0  # s for the nodes to find each other
SIGNALS = {"/odom", "/cmd_vel"}
LISTENS = {
    "funnel_monitor": SIGNALS,
    "tracking_controller": {"/odom"},
    "trajectory_recorder": {"/odom"},
}


def interfaces(folder: Path) -> str:
    """The page, in Markdown; `folder` takes a funnel and a bag.

    Raises NlsidError if the nodes do not find each other.
    """
    nodes = example_nodes(folder)
    settings = [
        part
        for name, _, parameters in nodes
        for key, value in parameters.items()
        for part in ("-p", f"{name}:{key}:={json.dumps(value)}")
    ] + ["-p", "bag_player:bag:=bag"]
    rclpy.init(args=["--ros-args", "--log-level", "fatal", *settings])
    executor = SingleThreadedExecutor()
    made = []
    try:
        for _, make, _ in nodes:
            node = make()
            made.append((node, set(map(id, node.entities())), _activated(node)))
            executor.add_node(node)
        deadline = time.monotonic() + PATIENCE
        while not all(LISTENS.get(node.get_name(), set()) <= _heard(node) for node, *_ in made):
            if time.monotonic() > deadline:
                raise NlsidError("the nodes did not find the robot's signals")
            executor.spin_once(timeout_sec=0.1)
        player = BagPlayer()
        pages = [*(_page(*each) for each in made), PLAYER + _parameters(player)]
        player.destroy_node()
        return "\n".join([HEAD, *pages])
    finally:
        for node, *_ in made:
            node.destroy_node()
        try_shutdown()


def example_nodes(folder: Path) -> list[tuple[str, Callable[[], ManagedNode], dict[str, object]]]:
    """(name, maker, parameters) of the nodes the page is about, on a funnel made in `folder`."""
    config_path = config_file("f1tenth.yaml")
    config = load_config(config_path)
    identify_bags(f1tenth(), config, folder, progress=silent)
    design_funnel_files(folder / documents.MODEL, config, folder)
    bags = [str(f1tenth()[0])]
    return [
        ("excitation", Excitation, {"highest": 1.0, "slew": 1.0}),
        (
            "trajectory_recorder",
            TrajectoryRecorder,
            {"topics": ["/odom"], "bag": str(folder / "bag"), "snapshot": 10.0},
        ),
        (
            "model_identifier",
            ModelIdentifier,
            {"bags": bags, "config": str(config_path), "out": str(folder)},
        ),
        ("funnel_publisher", FunnelPublisher, {"funnel": str(folder / documents.FUNNEL)}),
        ("tracking_controller", TrackingController, {"highest": 0.4}),
        (
            "funnel_monitor",
            FunnelMonitor,
            {
                "controller": "tracking_controller",
                "stop_service": "tracking_controller/stop",
                "snapshot_service": "trajectory_recorder/snapshot",
            },
        ),
        ("plant", PlantNode, {"model": str(folder / documents.MODEL)}),
        ("viewer", Viewer, {"page": True, "port": _free_port()}),
    ]


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
    return port


def _heard(node: ManagedNode) -> set[str]:
    return {subscription.topic_name for subscription in node.subscriptions}


def _activated(node: ManagedNode) -> set[int]:
    """The ids of all it has once it is active; raises what made it fail."""
    for transition in (node.trigger_configure, node.trigger_activate):
        if transition() != TransitionCallbackReturn.SUCCESS and node.failure is not None:
            raise node.failure
    return set(map(id, node.entities()))


def _page(node: ManagedNode, before: set[int], activated: set[int]) -> str:
    """One node: what it made, and in italics what others named."""
    name = node.get_name()
    lines = [f"## {name}\n", "| topic or service | type | | QoS |", "|---|---|---|---|"]
    rows = []
    entities: list[Any] = [entity for entity in node.entities() if id(entity) not in before]
    for entity in entities:
        if hasattr(entity, "topic_name"):
            way = "publishes" if hasattr(entity, "publish") else "subscribes"
            row = (entity.topic_name, entity.msg_type, way, _describe(entity.qos_profile))
        elif hasattr(entity, "srv_name"):
            way = "calls" if hasattr(entity, "call_async") else "serves"
            row = (node.resolve_service_name(entity.srv_name), entity.srv_type, way, "")
        else:
            continue
        given = id(entity) not in activated or row[0] in SIGNALS
        shown = row[0].replace(f"/{name}/", "~/")
        if row[2] == "calls" and shown.startswith("~/"):
            continue  # a node that asks itself needs nobody
        rows.append((f"*`{shown}`*" if given else f"`{shown}`", _type_name(row[1]), *row[2:]))
    lines += [f"| {row[0]} | {row[1]} | {row[2]} | {row[3]} |" for row in sorted(rows)]
    return "\n".join(lines) + "\n" + _parameters(node)


def _parameters(node: ManagedNode | PlainNode) -> str:
    lines = ["\n| parameter | default | range | what |", "|---|---|---|---|"]
    for declared in sorted(node.declared):
        between = "" if declared.between is None else "{:g} to {:g}".format(*declared.between)
        default = json.dumps(declared.default)
        marked = " •" if declared.tunable else ""
        lines.append(
            f"| `{declared.name}`{marked} | `{default}` | {between} | {declared.description} |"
        )
    return "\n".join(lines) + "\n"


def _type_name(kind: Any) -> str:
    package, section, *_ = kind.__module__.split(".")
    return f"{package}/{section}/{kind.__name__}"


def _describe(profile: QoSProfile) -> str:
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    words = ["reliable" if reliable else "best effort"] + (["latched"] if latched else [])
    return ", ".join([*words, f"depth {profile.depth}"])


def main() -> None:
    """Print the page."""
    with tempfile.TemporaryDirectory() as folder:
        print(interfaces(Path(folder)), end="")


if __name__ == "__main__":
    main()
