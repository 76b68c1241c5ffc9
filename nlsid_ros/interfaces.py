"""docs/nodes.md, made by starting every node and asking it what it has.

python -m nlsid_ros.interfaces > docs/nodes.md
"""

import json
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import try_shutdown

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.monitoring import documents
from bags.samples import f1tenth
from nlsid_ros.excitation import Excitation
from nlsid_ros.funnel_monitor import FunnelMonitor
from nlsid_ros.funnel_publisher import FunnelPublisher
from nlsid_ros.model_identifier import ModelIdentifier
from nlsid_ros.plant import PlantNode
from nlsid_ros.running import ManagedNode
from nlsid_ros.tracking_controller import TrackingController
from nlsid_ros.trajectory_recorder import TrajectoryRecorder

HEAD = """# Every node's topics, services and parameters

Made from the running nodes by `python -m nlsid_ros.interfaces`; a test keeps it true. `~` is the
node's name; every name can be remapped, every node put in a namespace. Topics named by the funnel's
model or by a parameter (the robot's signals, what is recorded) come with them. All nodes also have
the services of a [lifecycle node](https://design.ros2.org/articles/node_lifecycle.html). Parameters
are read when a node is made and cannot be changed while it runs.
"""


def interfaces(folder: Path) -> str:
    """The page, in Markdown; `folder` takes a funnel and a bag."""
    config_path = config_file("f1tenth.yaml")
    config = load_config(config_path)
    identify_bags(f1tenth(), config, folder, progress=lambda _what, _fraction: None)
    design_funnel_files(folder / documents.MODEL, config, folder)
    bags = [str(f1tenth()[0])]
    nodes: list[tuple[Callable[[], ManagedNode], dict[str, object]]] = [
        (Excitation, {"highest": 1.0, "slew": 1.0}),
        (TrajectoryRecorder, {"topics": ["/odom"], "bag": str(folder / "bag")}),
        (ModelIdentifier, {"bags": bags, "config": str(config_path), "out": str(folder)}),
        (FunnelPublisher, {"funnel": str(folder / documents.FUNNEL)}),
        (TrackingController, {"highest": 0.4}),
        (FunnelMonitor, {}),
        (PlantNode, {"kind": "pendulum"}),
    ]
    return "\n".join([HEAD, *(_of(make, parameters) for make, parameters in nodes)])


def _of(make: Callable[[], ManagedNode], parameters: dict[str, object]) -> str:
    settings = [p for k, v in parameters.items() for p in ("-p", f"{k}:={json.dumps(v)}")]
    rclpy.init(args=["--ros-args", "--log-level", "fatal", *settings])
    try:
        node = make()
        node.trigger_configure()
        own = set(map(id, node.entities()))
        node.trigger_activate()
        made = [entity for entity in node.entities() if id(entity) not in own]
        page = _page(node, made)
        node.destroy_node()
    finally:
        try_shutdown()
    return page


def _page(node: ManagedNode, made: Iterable[Any]) -> str:
    name = node.get_name()
    lines = [f"## {name}\n", "| topic or service | type | | QoS |", "|---|---|---|---|"]
    rows = []
    for entity in made:
        if hasattr(entity, "topic_name"):
            way = "publishes" if hasattr(entity, "publish") else "subscribes"
            row = (entity.topic_name, entity.msg_type, way, _describe(entity.qos_profile))
        elif hasattr(entity, "srv_name"):
            way = "calls" if hasattr(entity, "call_async") else "serves"
            row = (entity.srv_name, entity.srv_type, way, "")
        else:
            continue
        rows.append((row[0].replace(f"/{name}/", "~/"), _type_name(row[1]), *row[2:]))
    lines += [f"| `{row[0]}` | {row[1]} | {row[2]} | {row[3]} |" for row in sorted(rows)]
    lines += ["\n| parameter | default | range | what |", "|---|---|---|---|"]
    for declared in sorted(node.declared):
        between = "" if declared.between is None else "{:g} to {:g}".format(*declared.between)
        default = json.dumps(declared.default)
        lines.append(f"| `{declared.name}` | `{default}` | {between} | {declared.description} |")
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
