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
from tests.ros.processes import node_here, process, ros_test, stop
from tests.ros.robot import GOOD, MONITOR, Robot

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


def test_the_page_says_what_the_monitor_says_and_that_it_is_gone(funnel: Path) -> None:
    port = free_port()
    proved = documents.load(funnel).funnel
    assert isinstance(proved, TubeFunnel)
    width = proved.half_width
    names = {"__ns": "/robot1"}
    shared = {"/robot1/odom": "/odom", "/robot1/cmd_vel": "/cmd_vel"}
    signals = {"allow_old_stamps": True, "source": "/funnel_publisher", "stale_after": 5.0}
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, **signals, **names, **shared) as monitor,
        process("nlsid_ros.viewer", port=port, **names) as viewer,
    ):
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        margin = "/robot1/funnel_monitor/margin"
        spin_until(lambda: node.count_subscribers(margin) == 1)
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
        assert reader.samples > 5
        spin_until(lambda: reader.verdict == "late")
        monitor.send_signal(signal.SIGSTOP)
        spin_until(lambda: reader.verdict == "stale")
        monitor.send_signal(signal.SIGCONT)
        spin_until(lambda: reader.verdict != "stale")
        stop(viewer)
