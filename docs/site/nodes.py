"""The tables of parameters in docs/nodes.md, made from the rows that the nodes declare.

python -m docs.site.nodes        writes them into the page
"""

import importlib
import json
import re
from pathlib import Path

from nlsid_ros.running import AUTOSTART, HARDWARE, ManagedNode

PAGE = Path(__file__).parents[1] / "nodes.md"
TABLE = re.compile(r"^\| parameter \|.*\n(\|.*\n)+", re.MULTILINE)


NODES = {
    "tracking_controller": "TrackingController",
    "excitation": "Excitation",
    "funnel_monitor": "FunnelMonitor",
    "trajectory_recorder": "TrajectoryRecorder",
    "plant": "PlantNode",
    "viewer": "Viewer",
    "model_identifier": "ModelIdentifier",
    "funnel_publisher": "FunnelPublisher",
    "bag_player": "BagPlayer",
}


def node_class(name: str) -> type[ManagedNode]:
    """The class of a node of NODES."""
    found: type[ManagedNode] = getattr(importlib.import_module(f"nlsid_ros.{name}"), NODES[name])
    return found


def filled(page: str) -> str:
    """The page with the table of parameters in the section of each node as it is today."""
    for name in NODES:
        before, heading, rest = page.partition(f"## {name}\n")
        page = before + heading + TABLE.sub(table(name).replace("\\", r"\\"), rest, count=1)
    return page


def table(name: str) -> str:
    """The parameters of a node, in Markdown."""
    lines = ["| parameter | default | range | what |", "|---|---|---|---|"]
    for row in sorted(
        (AUTOSTART, HARDWARE, *node_class(name).parameters), key=lambda row: row.name
    ):
        marked = " •" if row.tunable else ""
        between = "" if row.between is None else "{:g} to {:g}".format(*row.between)
        default = json.dumps(row.default)
        lines.append(f"| `{row.name}`{marked} | `{default}` | {between} | {row.what} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
