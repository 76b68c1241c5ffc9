"""What a monitor must not forget, must not believe, and must not wait for; what an alarm does."""

from collections.abc import Callable

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.monitoring.announcement import Run
from nlsid_core import files
from nlsid_ros import qos
from tests.ros.processes import ros_test
from tests.ros.robot import GOOD, PERIOD_NS, Robot

pytestmark = ros_test
NAME = "funnel_monitor"
LATE = 1.0  # s that the machine may be busy
PLAYED = {"stale_after": 5.0, "allow_old_stamps": True}


def served(
    robot: Robot, name: str, called: list[str], says: Callable[[], tuple[bool, str]]
) -> None:
    """A service that a monitor may call."""

    def serve(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        called.append(name)
        response.success, response.message = says()
        return response

    robot.node.create_service(Trigger, name, serve)


def test_outside_stays_outside_until_a_restart_whatever_is_published_meanwhile(
    robot: Robot,
) -> None:
    robot.watched(stale_after=0.5, allow_old_stamps=True)
    robot.ready()
    robot.drive(GOOD)
    robot.drive([10], speed=1e3)
    robot.hears("outside")
    assert {"margin", "worst axis", "assumption", "assuming"} <= robot.said[NAME][-1][1].keys()
    robot.said.clear()
    robot.publish(robot.bundle)
    robot.drive([11, 12, 13])
    robot.spin_until(lambda: any(v["now"] == "unknown" for _, v in robot.said.get(NAME, [])))
    robot.spin_until(lambda: len(robot.said[NAME]) > 5)  # heartbeats after the silence
    assert {text[:7] for text, _ in robot.said[NAME]} == {"outside"}
    assert robot.levels[NAME] == DiagnosticStatus.ERROR
    robot.restart()
    robot.drive(GOOD)
    robot.hears("inside")
    assert robot.levels[NAME] == DiagnosticStatus.OK


@pytest.mark.parametrize(
    ("ahead", "period_ns", "says"),
    [
        (-3600.0, PERIOD_NS, " is stamped 3.6e+03 s before this node's clock"),
        (3600.0, PERIOD_NS, " is stamped 3.6e+03 s after this node's clock"),
        (0.0, 30_303_030, "unknown: the sample at t ="),
    ],
    ids=["an hour old", "an hour ahead", "33 Hz"],
)
def test_samples_that_are_not_of_now_or_not_of_the_models_rate_are_not_inside(
    robot: Robot, ahead: float, period_ns: int, says: str
) -> None:
    robot.period_ns = period_ns
    robot.watched(stale_after=LATE)
    robot.ready()
    while not robot.has_said(says):  # on a busy machine a command may be late for its sample
        robot.drive_now(10, ahead=ahead)
    robot.said.clear()
    robot.drive_now(10, ahead=ahead)
    assert not robot.has_said("inside")


def test_samples_of_now_are_inside_and_another_frame_is_not(robot: Robot) -> None:
    robot.watched(stale_after=LATE)
    robot.ready()
    robot.drive_now(10, frame="odom")
    robot.hears("inside")
    robot.restart()
    while not robot.has_said("unknown: the response is in frame 'map', not in"):
        robot.drive_now(3, frame="odom")  # on a busy machine they may be late
        robot.drive_now(3, frame="map")


def test_two_values_at_one_stamp_are_named(robot: Robot) -> None:
    robot.watched(stale_after=LATE, allow_old_stamps=True)
    robot.ready()
    robot.drive(GOOD)
    robot.hears("inside")
    robot.drive([GOOD[-1]], speed=0.001)
    robot.hears("unknown: speed has two values at one stamp")
    robot.said.clear()
    for k in range(GOOD[-1] + 1, GOOD[-1] + 8):
        robot.drive([k])
        robot.drive([k], speed=0.001)
    robot.waits(2.0)
    assert not robot.has_said("inside"), "nobody knows which of the two is the robot"


def test_the_right_type_is_taken_after_a_wrong_one(robot: Robot) -> None:
    robot.watched(stale_after=LATE, allow_old_stamps=True)
    robot.node.destroy_publisher(robot.odom)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 0)
    wrong = robot.node.create_publisher(PoseStamped, "/odom", 10)
    robot.hears("/odom")
    robot.node.destroy_publisher(wrong)
    robot.odom = robot.node.create_publisher(Odometry, "/odom", 10)
    robot.restart()
    robot.drive(GOOD)
    robot.hears("inside")


def test_simulated_time_is_heard_in_regular_runs_and_where_it_stands_still_none_is_inside(
    robot: Robot,
) -> None:
    robot.watched(use_sim_time=True, stale_after=0.1)
    robot.ready()
    robot.spin_until(lambda: robot.clock.get_subscription_count() >= 1)
    robot.drive_now(100, clock=True)
    robot.hears("inside")
    assert not robot.has_said("no speed for")
    robot.said.clear()
    robot.hears("unknown: simulated time stands still")
    robot.said.clear()
    robot.waits(2.5)
    assert robot.said[NAME]
    assert not robot.has_said("inside")


def test_a_low_margin_is_a_warning_and_its_threshold_can_be_moved_in_mid_run(robot: Robot) -> None:
    robot.watched(warning_margin=1.0, **PLAYED)
    robot.ready()
    robot.drive(GOOD, speed=0.001)
    robot.hears("warning")
    assert not robot.has_said("inside")
    assert robot.set(NAME, "warning_margin", 0.0) == ""
    robot.drive([10, 11, 12], speed=0.001)
    robot.hears("inside")


def test_every_alarm_calls_all_services_once(robot: Robot) -> None:
    """After a restart, and when a run is announced before anybody looked at the alarm."""
    called: list[str] = []
    settings = {"nominal": "profile", "controller": "controller"}
    for name in ("/halt", "/keep"):
        served(robot, name, called, lambda: (True, ""))
    robot.watched(stop_service="/halt", snapshot_service="/keep", **settings, **PLAYED)
    announce = robot.node.create_publisher(String, "/controller/run", qos.DOCUMENT)
    robot.ready()
    robot.spin_until(lambda: announce.get_subscription_count() == 1)

    def leave(run: int) -> None:
        """A run that is announced, begins inside and leaves."""
        start_ns = 10**18 + 100 * run * PERIOD_NS
        begun = Run(start_ns, robot.bundle.digest).document()
        announce.publish(String(data=files.encode(begun).decode()))
        robot.drive([100 * run + k for k in range(-6, 6)])
        robot.drive([100 * run + k for k in (6, 7, 8)], speed=1e3)

    leave(1)
    robot.hears("outside")
    robot.spin_until(lambda: len(called) == 2)
    robot.drive([109, 110], speed=1e3)
    assert sorted(called) == ["/halt", "/keep"]
    robot.restart()
    leave(2)
    robot.hears("outside")
    robot.spin_until(lambda: len(called) == 4)
    leave(3)  # nobody has restarted the monitor: it calls because a run begins
    robot.spin_until(lambda: len(called) >= 6)


def test_an_alarm_with_nobody_to_call_says_so_and_calls_until_somebody_answers(
    robot: Robot,
) -> None:
    robot.watched(stop_service="/nobody", **PLAYED)
    robot.ready()
    robot.drive(GOOD)
    robot.drive([10, 11], speed=1e3)
    robot.hears("outside")
    robot.hears("; /nobody: not there to be called")
    assert robot.levels[NAME] == DiagnosticStatus.ERROR
    busy = "; /nobody: the base is busy"
    served(robot, "/nobody", [], lambda: (robot.has_said(busy), "the base is busy"))
    robot.hears(busy)
    robot.spin_until(lambda: "/nobody" not in robot.said[NAME][-1][0])  # it did it
    assert "outside" in robot.said[NAME][-1][0]
