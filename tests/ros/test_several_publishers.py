"""Who else is on a topic: nobody knows whose messages come, or who commands; and who comes back."""

import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy

from bags.recordings.bag import Bag
from bags.signals.publishers import counted_in_turn
from nlsid_ros import graph, qos
from nlsid_ros.messages import stamp_of
from tests.ros.processes import ROOT, Bench, node_here, ros_test, stop
from tests.ros.robot import GOOD, PERIOD_NS, Robot

pytestmark = ros_test
NAME = "funnel_monitor"
LATE = 1.0  # s that the machine may be busy
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def watched(robot: Robot) -> Robot:
    """A robot whose monitor has said inside."""
    robot.watched(stale_after=LATE, allow_old_stamps=True)
    robot.ready()
    robot.drive(GOOD)
    robot.hears("inside")
    robot.said.clear()
    return robot


def both(robot: Robot, second: Publisher, message: type, samples: range) -> None:
    """Samples of the robot, and between them the same at rest from `second`, 1 ms earlier."""
    for k in samples:
        early = message()
        early.header.stamp = stamp_of(10**18 + k * PERIOD_NS - 10**6)
        second.publish(early)
        robot.drive([k])


def test_a_simulator_beside_the_robot_makes_the_state_unknown_until_it_is_gone(
    watched: Robot,
) -> None:
    robot = watched
    simulator = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.hears("unknown: /odom has 2 publishers: /test_robot, /test")
    robot.said.clear()
    both(robot, simulator, Odometry, range(10, 30))
    robot.hears("publishers")
    assert not robot.has_said("inside")
    robot.node.destroy_publisher(simulator)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 1)
    robot.restart()
    robot.drive(list(range(40, 60)))
    robot.hears("inside")


def test_a_second_publisher_of_commands_is_named_and_if_both_send_the_state_is_unknown(
    watched: Robot,
) -> None:
    robot = watched
    other = robot.node.create_publisher(TwistStamped, "/cmd_vel", qos.STREAM)
    robot.hears("/cmd_vel has 2 publishers")
    robot.restart()
    robot.drive(list(range(10, 20)))
    robot.hears("inside; /cmd_vel has 2 publishers")
    both(robot, other, TwistStamped, range(20, 40))
    robot.hears("unknown: messages of several publishers come in turn")


def test_a_publisher_that_is_there_and_says_nothing_is_named(robot: Robot) -> None:
    robot.watched()
    robot.hears("nothing on /odom for 2 s, though /test_robot publish")
    assert robot.levels[NAME] in (DiagnosticStatus.WARN, DiagnosticStatus.STALE)


def test_a_driver_that_comes_back_best_effort_is_heard_again(watched: Robot) -> None:
    robot = watched
    robot.node.destroy_publisher(robot.odom)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 0)
    robot.odom = robot.node.create_publisher(Odometry, "/odom", BEST_EFFORT)
    robot.restart()
    robot.drive(GOOD)
    robot.hears("inside")


def test_a_driver_that_was_killed_and_replaced_counts_for_the_lease_of_dds(
    watched: Robot,
) -> None:
    robot = watched
    robot.node.destroy_publisher(robot.odom)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 0)
    code = (
        "import rclpy, time; from nav_msgs.msg import Odometry; rclpy.init(); "
        "n = rclpy.create_node('driver'); p = n.create_publisher(Odometry, '/odom', 10); "
        "time.sleep(100)"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT) as driver:
        robot.hears("nothing on /odom for 2 s, though /driver")
        driver.kill()
    killed = time.monotonic()
    robot.odom = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.hears("/odom has 2 publishers: /driver, /test_robot")
    robot.spin_until(lambda: time.monotonic() > killed + graph.LEASE + LATE)
    robot.restart()
    robot.drive(GOOD)
    robot.hears("inside")


@pytest.mark.parametrize(
    ("ahead", "says"),
    [
        (None, "unknown: a command on /cmd_vel is stamped 0: its publisher does not fill in"),
        (3600.0, "unknown: a command on /cmd_vel is stamped 3.6e+03 s after this node's clock"),
    ],
    ids=["0", "an hour ahead"],
)
def test_a_command_with_a_stamp_that_is_none_is_told_as_that(
    robot: Robot, ahead: float | None, says: str
) -> None:
    robot.watched(stale_after=10.0, command_wait=1.0)  # on a machine that is busy
    robot.ready()

    def drive(samples: int, command_ahead: float | None) -> None:
        """States, and after each its command, for which it waits."""
        first_ns = time.time_ns()
        for k in range(samples):
            command, state = TwistStamped(), Odometry()
            state.header.stamp = stamp_of(first_ns + k * PERIOD_NS)
            if command_ahead is not None:
                ahead_ns = round(command_ahead * 1e9)
                command.header.stamp = stamp_of(first_ns + k * PERIOD_NS + ahead_ns)
            robot.odom.publish(state)
            robot.waits(0.005)
            robot.command.publish(command)
            robot.waits(0.02)

    drive(20, ahead)
    robot.hears(says)
    assert not robot.has_said("inside")
    drive(40, 0.0)
    robot.hears("inside")
    assert robot.said[NAME][-1][1]["late commands"] == "0"


def test_a_controller_does_not_act_on_two_robots_and_names_who_else_commands(
    robot: Robot,
) -> None:
    name = "tracking_controller"
    robot.start(name, highest=0.4, stale_after=LATE)
    robot.hears("idle", name)
    robot.hears("/cmd_vel has 2 publishers: /test_robot, /", name)
    assert robot.levels[name] == DiagnosticStatus.WARN
    simulator = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    time.sleep(1.0)  # until the controller knows of it
    answer = robot.call(f"/{name}/start")
    assert not answer.success
    assert "/odom has 2 publishers" in answer.message
    robot.node.destroy_publisher(simulator)
    robot.spin_until(lambda: robot.call(f"/{name}/start").success)
    robot.drive_now(3)
    robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.hears("stopped: /odom has 2 publishers", name)
    robot.start(name, highest=0.4)
    robot.hears("2 nodes are called /tracking_controller", name)


def test_a_recorder_names_publishers_in_turn_and_one_that_says_nothing_and_follows_another(
    bench: Bench, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    topics, node, name = ["/odom", "/silent", "/driver"], bench.node, "trajectory_recorder"
    recorder = bench.start(name, topics=topics, bag=bag)
    first, second = (node.create_publisher(Odometry, "/odom", qos.STREAM) for _ in range(2))
    node.create_publisher(Odometry, "/silent", qos.STREAM)
    reliable = node.create_publisher(Odometry, "/driver", qos.STREAM)
    heard = (first, second, reliable)
    bench.spin_until(lambda: min(p.get_subscription_count() for p in heard) == 1)
    for k in range(20):
        for publisher in (first, second) if k > 10 else (first,):
            publisher.publish(Odometry())
        time.sleep(0.01)
    node.destroy_publisher(reliable)
    driver = node.create_publisher(Odometry, "/driver", BEST_EFFORT)
    bench.spin_until(lambda: driver.get_subscription_count() == 1)
    driver.publish(Odometry())
    for text in (
        "/odom has 2 publishers: /test_robot, /test_robot; stop all but one",
        "lost messages are not counted: several publishers send on it",
        "/driver: /test_robot came later and offers less (Best effort publisher and reliable",
        "nothing on /silent for 2 s, though /test_robot publishes it",
    ):
        bench.hears(text, name)
    stop(recorder)
    with Bag(bag) as source:
        assert source.count("/driver") == 1
        counts = np.concatenate([batch.sequence for _, batch in source.batches(["/odom"])])
    assert counted_in_turn(counts), "the bag shows it too"


@pytest.mark.parametrize(
    ("asked", "deaf"),
    [(qos.STREAM, ""), (qos.SENSOR, ""), (qos.DOCUMENT, "/cmd_vel: /test_base cannot hear it: ")],
)
def test_only_who_asks_for_more_than_is_offered_cannot_hear_commands(
    asked: QoSProfile, deaf: str
) -> None:
    with node_here("test_driver") as (driver, spin_until), node_here("test_base") as (base, _):
        commands = driver.create_publisher(TwistStamped, "/cmd_vel", qos.command(0.025))
        base.create_subscription(TwistStamped, "/cmd_vel", lambda _: None, asked)
        spin_until(lambda: driver.count_publishers("/cmd_vel") == 1)
        heard = partial(driver.get_subscriptions_info_by_topic, "/cmd_vel")
        spin_until(lambda: [each.node_name for each in heard()] == ["test_base"])
        said = graph.rivals(driver, commands)
    assert said.startswith(deaf)
    assert bool(said) is bool(deaf)
