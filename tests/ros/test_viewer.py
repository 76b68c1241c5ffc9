"""`nlsid view --page` beside a live monitor: its word, and what is said when it says no more."""

import http.client
import json
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from bags.designs import documents
from nlsid_core.funnels.tube import TubeFunnel
from tests.ros.processes import ros_test, stop
from tests.ros.robot import GOOD, Robot

pytestmark = ros_test


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


class Reader:
    """Reads the page's stream in a thread of its own, as a browser would."""

    def __init__(self, port: int) -> None:
        self.verdict, self.samples, self.names = "", 0, list[str]()
        self.signals: list[float] = []
        self._port = port
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for news in self._news():
            self.verdict, self.names = news["verdict"][0], news["names"]
            self.samples += len(news["samples"])
            self.signals = news["samples"][-1][6][0] if news["samples"] else self.signals

    def _news(self) -> Iterator[dict[str, Any]]:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=60)
        connection.request("GET", "/stream")
        answer = connection.getresponse()
        while line := answer.readline():
            if line.startswith(b"data: "):
                yield json.loads(line[6:])


def test_the_page_says_what_the_monitor_says_and_that_it_is_gone(
    robot: Robot, funnel: Path
) -> None:
    port = free_port()
    proved = documents.load(funnel).funnel
    assert isinstance(proved, TubeFunnel)
    width = float(proved.half_widths[0])
    names = {"__ns": "/robot1"}
    shared = {"/robot1/odom": "/odom", "/robot1/cmd_vel": "/cmd_vel"}
    signals = {"allow_old_stamps": True, "source": "/funnel_publisher", "stale_after": 5.0}
    monitor = robot.start("funnel_monitor", **signals, **names, **shared)
    viewer = robot.start("viewer", port=port, **names)
    robot.ready()
    margin = "/robot1/funnel_monitor/margin"
    robot.spin_until(lambda: robot.node.count_subscribers(margin) == 1)
    reader = Reader(port)
    k = 0

    def drive_until(word: str) -> None:
        nonlocal k
        while reader.verdict != word:
            robot.drive([k := k + 1])

    robot.drive(GOOD)
    k = GOOD[-1]
    drive_until("inside")
    assert reader.names == ["speed [m/s]"]
    assert reader.signals[1] == pytest.approx(width, rel=1e-4)
    robot.spin_until(lambda: reader.samples > 5)
    robot.spin_until(lambda: reader.verdict == "late")
    monitor.send_signal(signal.SIGSTOP)
    robot.spin_until(lambda: reader.verdict == "stale")
    monitor.send_signal(signal.SIGCONT)
    robot.spin_until(lambda: reader.verdict != "stale")
    stop(viewer)
