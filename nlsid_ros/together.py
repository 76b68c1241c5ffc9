"""Several nodes in one process, on one executor of one thread: `nlsid run ... --one-process`.

Each has its own parameters and remappings, and none keeps the others waiting: proofs are decided
and models identified in processes of their own. They end together, the controller first, which
brings the robot to rest.

python -m nlsid_ros.together '[["funnel_monitor", "--ros-args", "-p", "stale_after:=0.2"], ...]'
"""

import importlib
import json
import sys
from collections.abc import Callable, Sequence
from functools import partial

from nlsid_core.errors import DataError, NlsidError
from nlsid_ros.running import ManagedNode
from nlsid_ros.starting import run_all

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
}  # in the order in which they start, and end


def node_class(name: str) -> type[ManagedNode]:
    """The class of a node of NODES."""
    found: type[ManagedNode] = getattr(importlib.import_module(f"nlsid_ros.{name}"), NODES[name])
    return found


def makers(commands: Sequence[Sequence[str]]) -> list[Callable[[], ManagedNode]]:
    """What makes each node, in the order of NODES; DataError if one is not known."""
    order = list(NODES)
    if unknown := {name for name, *_ in commands} - set(order):
        raise DataError(f"{', '.join(sorted(unknown))}: not one of {', '.join(order)}")
    return [
        partial(node_class(name), arguments)
        for name, *arguments in sorted(commands, key=lambda command: order.index(command[0]))
    ]


def main() -> None:
    """Run the nodes that the first argument lists."""
    try:
        run_all(makers(json.loads(sys.argv[1])), None)
    except (NlsidError, OSError) as error:
        sys.exit(f"together: {error}")


if __name__ == "__main__":
    main()
