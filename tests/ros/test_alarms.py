"""What an alarm does: it comes at once, says what it knows, and calls for help once."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.monitoring.announcement import Run
from nlsid_core import files
from nlsid_ros import qos
from tests.ros.processes import (
    node_here,
    process,
    ros_test,
    set_parameter,
    stop,
)
from tests.ros.robot import GOOD, MONITOR, PERIOD_NS, Robot

pytestmark = ros_test


def test_an_exit_is_said_at_once_whatever_is_done_against_chattering(funnel: Path) -> None:
    slow: dict[str, object] = {
        "hysteresis": 1.0,
        "clear_after": 60.0,
        "stale_after": 5.0,
        "allow_old_stamps": True,
    }
    with node_here("test_robot") as (node, spin_until), process(MONITOR, **slow) as monitor:
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        robot.drive(GOOD)
        robot.spin_until(lambda: robot.has_said("inside"))
        robot.drive([10], speed=1e3)
        robot.spin_until(lambda: robot.has_said("outside"))
        robot.said.clear()
        robot.drive([11, 12, 13, 14])
        settled = time.monotonic() + 1.5
        robot.spin_until(lambda: time.monotonic() > settled)
        assert not robot.has_said("inside")
        assert not robot.has_said("warning")
        texts, values = robot.said["funnel_monitor"][-1]
        assert texts.startswith("outside")
        assert {"margin", "worst axis", "assumption", "time to exit", "assuming"} <= values.keys()
        stop(monitor)


def test_a_low_margin_is_a_warning_and_its_threshold_can_be_moved_in_mid_run(funnel: Path) -> None:
    wary: dict[str, object] = {"warning_margin": 1.0, "stale_after": 5.0, "allow_old_stamps": True}
    with node_here("test_robot") as (node, spin_until), process(MONITOR, **wary) as monitor:
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        robot.drive(GOOD, speed=0.001)
        robot.spin_until(lambda: robot.has_said("warning"))
        assert not robot.has_said("inside")
        assert set_parameter(node, spin_until, "funnel_monitor", "warning_margin", 0.0) == ""
        robot.drive([10, 11, 12], speed=0.001)
        robot.spin_until(lambda: robot.has_said("inside"))
        stop(monitor)


def test_an_alarm_calls_the_services_it_was_given_once(funnel: Path) -> None:
    called: list[str] = []

    def answer(name: str) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def serve(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            called.append(name)
            response.success = True
            return response

        return serve

    services: dict[str, object] = {"stop_service": "/halt", "snapshot_service": "/keep"}
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True, **services) as monitor,
    ):
        for name in ("/halt", "/keep"):
            node.create_service(Trigger, name, answer(name))
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        robot.drive(GOOD)
        robot.spin_until(lambda: robot.has_said("inside"))
        assert not called
        robot.drive([10, 11, 12], speed=1e3)
        robot.spin_until(lambda: len(called) == 2)
        robot.drive([13, 14, 15], speed=1e3)
        assert sorted(called) == ["/halt", "/keep"]
        stop(monitor)


def test_every_alarm_calls_not_the_first_one_only(funnel: Path) -> None:
    """After a restart, and when a run is announced before anybody looked at the alarm."""
    called: list[str] = []

    def serve(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        called.append("/halt")
        response.success = True
        return response

    settings = {"nominal": "profile", "controller": "controller", "stop_service": "/halt"}
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True, **settings) as monitor,
    ):
        node.create_service(Trigger, "/halt", serve)
        announce = node.create_publisher(String, "/controller/run", qos.DOCUMENT)
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        spin_until(lambda: announce.get_subscription_count() == 1)

        def leave(run: int) -> None:
            """A run that is announced, begins inside and leaves."""
            start_ns = 10**18 + 100 * run * PERIOD_NS
            begun = Run(start_ns, robot.bundle.digest).document()
            announce.publish(String(data=files.encode(begun).decode()))
            robot.drive([100 * run + k for k in range(-6, 6)])
            robot.drive([100 * run + k for k in (6, 7, 8)], speed=1e3)

        leave(1)
        spin_until(lambda: robot.has_said("outside"))
        spin_until(lambda: len(called) == 1)
        robot.restart()
        leave(2)
        spin_until(lambda: robot.has_said("outside"))
        spin_until(lambda: len(called) == 2)
        leave(3)  # nobody has restarted the monitor: it calls because a run begins
        spin_until(lambda: len(called) >= 3)
        stop(monitor)


def test_an_alarm_with_nobody_to_call_says_so_and_calls_until_somebody_answers(
    funnel: Path,
) -> None:
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True, stop_service="/nobody") as monitor,
    ):
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        robot.drive(GOOD)
        robot.drive([10, 11], speed=1e3)
        robot.spin_until(lambda: robot.has_said("outside"))
        robot.spin_until(lambda: robot.has_said("; /nobody: not there to be called"))
        assert robot.levels["funnel_monitor"] == DiagnosticStatus.ERROR
        called: list[str] = []

        def late(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            called.append("/nobody")
            response.success = len(called) > 2
            response.message = "the base is busy"
            return response

        node.create_service(Trigger, "/nobody", late)
        robot.spin_until(lambda: robot.has_said("; /nobody: the base is busy"))
        robot.spin_until(lambda: len(called) == 3)
        robot.said.clear()
        robot.spin_until(lambda: robot.has_said("outside"))
        assert not robot.has_said("/nobody"), "it did it"
        assert "/nobody: not there to be called" in stop(monitor)
