"""What a monitor must not forget, must not believe, and must not wait for."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock

from tests.ros.processes import node_here, process, ros_test
from tests.ros.robot import GOOD, MONITOR, PERIOD_NS, Robot

pytestmark = ros_test
NAME = "funnel_monitor"
LATE = 1.0  # s that the machine may be busy


@pytest.fixture
def watched(funnel: Path) -> Iterator[Callable[..., Robot]]:
    """A robot and its monitor, which takes parameters."""
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))

        def make(**settings: object) -> Robot:
            stack.enter_context(process(MONITOR, **settings))
            robot = Robot(node, spin_until, funnel.parent)
            robot.spin_until(lambda: robot.has_said("no speed yet"))
            return robot

        yield make


def waits(robot: Robot, seconds: float) -> None:
    until = time.monotonic() + seconds
    robot.spin_until(lambda: time.monotonic() > until)


def feed(
    robot: Robot,
    samples: int,
    *,
    ahead: float = 0.0,
    period_ns: int = PERIOD_NS,
    frame: str = "",
    clock: bool = False,
) -> int:
    """Samples at rest in real time, stamped `ahead` s of now at the first; the next stamp (ns)."""
    first, began = time.time_ns() + round(ahead * 1e9), time.monotonic()
    for k in range(samples):
        command, state = TwistStamped(), Odometry()
        for message in (command, state):
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(first + k * period_ns, 10**9)
        state.header.frame_id = frame
        if clock:
            robot.clock.publish(Clock(clock=state.header.stamp))
        robot.command.publish(command)
        robot.odom.publish(state)
        due = began + (k + 1) * period_ns * 1e-9
        robot.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
    return first + samples * period_ns


def test_outside_stays_outside_until_a_restart_whatever_is_published_meanwhile(
    watched: Callable[..., Robot],
) -> None:
    robot = watched(stale_after=0.5, allow_old_stamps=True)
    robot.ready()
    robot.drive(GOOD)
    robot.drive([10], speed=1e3)
    robot.spin_until(lambda: robot.has_said("outside"))
    robot.said.clear()
    robot.publish(robot.bundle)
    robot.drive([11, 12, 13])
    robot.spin_until(lambda: any(v["now"] == "unknown" for _, v in robot.said.get(NAME, [])))
    robot.spin_until(lambda: len(robot.said[NAME]) > 5)  # heartbeats after the silence
    assert {text[:7] for text, _ in robot.said[NAME]} == {"outside"}
    assert robot.levels[NAME] == DiagnosticStatus.ERROR
    robot.restart()
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))
    assert robot.levels[NAME] == DiagnosticStatus.OK


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"ahead": -3600.0}, "unknown: a response is stamped 3.6e+03 s before this node's clock"),
        ({"ahead": 3600.0}, "unknown: a response is stamped 3.6e+03 s after this node's clock"),
        ({"period_ns": 30_303_030}, "unknown: the sample at t ="),
    ],
    ids=["an hour old", "an hour ahead", "33 Hz"],
)
def test_samples_that_are_not_of_now_or_not_of_the_models_rate_are_not_inside(
    watched: Callable[..., Robot], given: dict[str, float], says: str
) -> None:
    robot = watched(stale_after=LATE)
    robot.ready()
    while not robot.has_said(says):  # on a busy machine a command may be late for its sample
        feed(robot, 10, **given)  # type: ignore[arg-type]
    robot.said.clear()
    feed(robot, 10, **given)  # type: ignore[arg-type]
    assert not robot.has_said("inside")


def test_samples_of_now_are_inside_and_another_frame_is_not(watched: Callable[..., Robot]) -> None:
    robot = watched(stale_after=LATE)
    robot.ready()
    feed(robot, 10, frame="odom")
    robot.spin_until(lambda: robot.has_said("inside"))
    robot.restart()
    feed(robot, 3, frame="odom")
    feed(robot, 3, frame="map")
    robot.spin_until(lambda: robot.has_said("unknown: the response is in frame 'map', not in"))


def test_two_values_at_one_stamp_are_named(watched: Callable[..., Robot]) -> None:
    robot = watched(stale_after=LATE, allow_old_stamps=True)
    robot.ready()
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))
    robot.drive([GOOD[-1]], speed=0.001)
    robot.spin_until(lambda: robot.has_said("unknown: speed has two values at one stamp"))
    robot.said.clear()
    for k in range(GOOD[-1] + 1, GOOD[-1] + 8):
        robot.drive([k])
        robot.drive([k], speed=0.001)
    waits(robot, 2.0)
    assert not robot.has_said("inside"), "nobody knows which of the two is the robot"


def test_the_right_type_is_taken_after_a_wrong_one(watched: Callable[..., Robot]) -> None:
    robot = watched(stale_after=LATE, allow_old_stamps=True)
    robot.node.destroy_publisher(robot.odom)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 0)
    wrong = robot.node.create_publisher(PoseStamped, "/odom", 10)
    robot.spin_until(lambda: robot.has_said("/odom"))
    robot.node.destroy_publisher(wrong)
    robot.odom = robot.node.create_publisher(Odometry, "/odom", 10)
    robot.ready()
    robot.restart()
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))


def test_a_dead_simulator_is_not_a_robot_that_is_inside(watched: Callable[..., Robot]) -> None:
    robot = watched(use_sim_time=True, stale_after=0.1)
    robot.ready()
    robot.spin_until(lambda: robot.clock.get_subscription_count() >= 1)
    feed(robot, 10, clock=True)
    robot.spin_until(lambda: robot.has_said("inside"))
    robot.said.clear()
    robot.spin_until(lambda: robot.has_said("unknown: simulated time stands still"))
    robot.said.clear()
    waits(robot, 2.5)
    assert robot.said[NAME]
    assert not robot.has_said("inside")


def test_the_clock_is_heard_in_regular_runs_in_simulated_time(
    watched: Callable[..., Robot],
) -> None:
    robot = watched(use_sim_time=True, stale_after=0.1)
    robot.ready()
    robot.spin_until(lambda: robot.clock.get_subscription_count() >= 1)
    feed(robot, 100, clock=True)
    robot.spin_until(lambda: robot.has_said("inside"))
    assert not robot.has_said("no speed for")
