"""A stack of live nodes as processes, without ROS launch: started together, ended together."""

import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from bags.monitoring.documents import MODEL

Nodes = dict[str, Mapping[str, object]]
LOOK = 0.2  # s between looks at whether all still run
PATIENCE = 20.0  # s for a node to end when asked to


def monitoring(funnel: Path) -> Nodes:
    """Publish a proved funnel and watch a robot that others drive."""
    return {"funnel_publisher": {"funnel": funnel}, "funnel_monitor": {}}


def tracking(funnel: Path, *, lowest: float, highest: float, plant: bool) -> Nodes:
    """Publish, track and watch; with `plant` on the funnel's own model instead of a robot."""
    nodes: Nodes = {
        "funnel_publisher": {"funnel": funnel},
        "tracking_controller": {"lowest": float(lowest), "highest": float(highest)},
        "funnel_monitor": {
            "nominal": "profile",
            "controller": "tracking_controller",
            "stop_service": "tracking_controller/stop",
        },
    }
    if plant:
        nodes["plant"] = {"model": funnel.with_name(MODEL)}
    return nodes


def run_stack(nodes: Nodes) -> int:
    """Run until SIGINT or until one node ends, then end all; the worst of their exit statuses."""
    running = [subprocess.Popen(_command(name, given)) for name, given in nodes.items()]
    try:
        while all(process.poll() is None for process in running):
            time.sleep(LOOK)
    except KeyboardInterrupt:
        pass
    finally:
        for process in running:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in running:
            try:
                process.wait(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
    return max(abs(process.wait()) for process in running)


def _command(name: str, parameters: Mapping[str, object]) -> list[str]:
    settings = [part for key, value in parameters.items() for part in ("-p", f"{key}:={value}")]
    ros = ["--ros-args", *settings] if settings else []
    return [sys.executable, "-m", f"nlsid_ros.{name}", *ros]
