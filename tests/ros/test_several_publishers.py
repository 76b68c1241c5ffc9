"""Who else is on a topic: nobody knows whose messages come, or who commands; and who comes back."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

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
from tests.ros.processes import ROOT, call, node_here, process, ros_test, stop
from tests.ros.robot import GOOD, MONITOR, PERIOD_NS, Ear, Robot

pytestmark = ros_test
NAME = "funnel_monitor"
CONTROLLER = "nlsid_ros.tracking_controller"
RECORDER = "nlsid_ros.trajectory_recorder"
LATE = 1.0  # s that the machine may be busy
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def made(funnel: Path) -> Iterator[Callable[..., Robot]]:
    """A robot and a node beside it, which takes parameters."""
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))

        def make(module: str, says: str, **settings: object) -> Robot:
            stack.enter_context(process(module, **settings))
            robot = Robot(node, spin_until, funnel.parent)
            name = module.rpartition(".")[2]
            robot.spin_until(lambda: robot.has_said(says, name))
            return robot

        yield make


def watched(made: Callable[..., Robot]) -> Robot:
    """A robot whose monitor has said inside."""
    robot = made(MONITOR, "no speed yet", stale_after=LATE, allow_old_stamps=True)
    robot.ready()
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))
    robot.said.clear()
    return robot


def both(robot: Robot, second: Publisher, message: type, samples: range) -> None:
    """Samples of the robot, and between them the same at rest from `second`, 1 ms earlier."""
    for k in samples:
        early = message()
        stamp = early.header.stamp
        stamp.sec, stamp.nanosec = divmod(10**18 + k * PERIOD_NS - 10**6, 10**9)
        second.publish(early)
        robot.drive([k])


def test_a_simulator_beside_the_robot_makes_the_state_unknown_until_it_is_gone(
    made: Callable[..., Robot],
) -> None:
    robot = watched(made)
    simulator = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.spin_until(lambda: robot.has_said("unknown: /odom has 2 publishers: /test_robot, /test"))
    robot.said.clear()
    both(robot, simulator, Odometry, range(10, 30))
    robot.spin_until(lambda: robot.has_said("publishers"))
    assert not robot.has_said("inside")
    robot.node.destroy_publisher(simulator)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 1)
    robot.restart()
    robot.drive(list(range(40, 60)))
    robot.spin_until(lambda: robot.has_said("inside"))


def test_a_second_publisher_of_commands_is_named_and_if_both_send_the_state_is_unknown(
    made: Callable[..., Robot],
) -> None:
    robot = watched(made)
    other = robot.node.create_publisher(TwistStamped, "/cmd_vel", qos.STREAM)
    robot.spin_until(lambda: robot.has_said("/cmd_vel has 2 publishers"))
    robot.restart()
    robot.drive(list(range(10, 20)))
    robot.spin_until(lambda: robot.has_said("inside; /cmd_vel has 2 publishers"))
    both(robot, other, TwistStamped, range(20, 40))
    robot.spin_until(lambda: robot.has_said("unknown: messages of several publishers come in turn"))


def test_a_publisher_that_is_there_and_says_nothing_is_named(made: Callable[..., Robot]) -> None:
    robot = made(MONITOR, "no speed yet")
    robot.spin_until(lambda: robot.has_said("nothing on /odom for 2 s, though /test_robot publish"))
    assert robot.levels[NAME] in (DiagnosticStatus.WARN, DiagnosticStatus.STALE)


def test_a_driver_that_comes_back_best_effort_is_heard_again(made: Callable[..., Robot]) -> None:
    robot = watched(made)
    robot.node.destroy_publisher(robot.odom)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 0)
    robot.odom = robot.node.create_publisher(Odometry, "/odom", BEST_EFFORT)
    robot.restart()
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))


def test_a_driver_that_was_killed_and_replaced_counts_for_the_lease_of_dds(
    made: Callable[..., Robot],
) -> None:
    robot = watched(made)
    robot.node.destroy_publisher(robot.odom)
    robot.spin_until(lambda: robot.node.count_publishers("/odom") == 0)
    code = (
        "import rclpy, time; from nav_msgs.msg import Odometry; rclpy.init(); "
        "n = rclpy.create_node('driver'); p = n.create_publisher(Odometry, '/odom', 10); "
        "time.sleep(100)"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT) as driver:
        robot.spin_until(lambda: robot.has_said("nothing on /odom for 2 s, though /driver"))
        driver.kill()
    killed = time.monotonic()
    robot.odom = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.spin_until(lambda: robot.has_said("/odom has 2 publishers: /driver, /test_robot"))
    robot.spin_until(lambda: time.monotonic() > killed + graph.LEASE + LATE)
    robot.restart()
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))


@pytest.mark.parametrize(
    ("ahead", "says"),
    [
        (None, "unknown: a command on /cmd_vel is stamped 0: its publisher does not fill in"),
        (3600.0, "unknown: a command on /cmd_vel is stamped 3.6e+03 s after this node's clock"),
    ],
    ids=["0", "an hour ahead"],
)
def test_a_command_with_a_stamp_that_is_none_is_told_as_that(
    made: Callable[..., Robot], ahead: float | None, says: str
) -> None:
    robot = made(MONITOR, "no speed yet", stale_after=LATE)
    robot.ready()
    for _ in range(20):
        now_ns = time.time_ns()
        command, state = TwistStamped(), Odometry()
        stamp = state.header.stamp
        stamp.sec, stamp.nanosec = divmod(now_ns, 10**9)
        if ahead is not None:
            command.header.stamp.sec = now_ns // 10**9 + round(ahead)
        robot.command.publish(command)
        robot.odom.publish(state)
        due = time.monotonic() + 0.025
        robot.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
    robot.spin_until(lambda: robot.has_said(says))
    assert not robot.has_said("inside")
    first_ns = time.time_ns()
    for k in range(40):
        command, state = TwistStamped(), Odometry()
        for message in (command, state):
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(first_ns + k * PERIOD_NS, 10**9)
        robot.odom.publish(state)
        time.sleep(0.005)  # for which a sample waits
        robot.command.publish(command)
        due = time.monotonic() + 0.02
        robot.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
    robot.spin_until(lambda: robot.has_said("inside"))
    assert robot.said[NAME][-1][1]["late commands"] == "0"


def test_a_controller_does_not_act_on_two_robots_and_names_who_else_commands(
    made: Callable[..., Robot],
) -> None:
    robot = made(CONTROLLER, "idle", highest=0.4, stale_after=LATE)
    name = "tracking_controller"
    robot.spin_until(lambda: robot.has_said("/cmd_vel has 2 publishers: /test_robot, /", name))
    assert robot.levels[name] == DiagnosticStatus.WARN
    simulator = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    time.sleep(1.0)  # until the controller knows of it
    answer = call(robot.node, robot.spin_until, f"/{name}/start")
    assert not answer.success
    assert "/odom has 2 publishers" in answer.message
    robot.node.destroy_publisher(simulator)
    robot.spin_until(lambda: call(robot.node, robot.spin_until, f"/{name}/start").success)
    robot.drive([0, 1, 2], shift_ns=time.time_ns() - 10**18)
    robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.spin_until(lambda: robot.has_said("stopped: /odom has 2 publishers", name))
    with process(CONTROLLER, highest=0.4):
        robot.spin_until(lambda: robot.has_said("2 nodes are called /tracking_controller", name))


def test_a_recorder_names_publishers_in_turn_and_one_that_says_nothing_and_follows_another(
    tmp_path: Path,
) -> None:
    bag = tmp_path / "bag"
    topics = ["/odom", "/silent", "/driver"]
    with node_here("test_robot") as (node, spin_until), ExitStack() as stack:
        robot = Ear(node, spin_until)
        recorder = stack.enter_context(process(RECORDER, topics=topics, bag=bag))
        first, second = (node.create_publisher(Odometry, "/odom", qos.STREAM) for _ in range(2))
        node.create_publisher(Odometry, "/silent", qos.STREAM)
        reliable = node.create_publisher(Odometry, "/driver", qos.STREAM)
        spin_until(lambda: min(p.get_subscription_count() for p in (first, second, reliable)) == 1)
        for k in range(20):
            for publisher in (first, second) if k > 10 else (first,):
                publisher.publish(Odometry())
            time.sleep(0.01)
        node.destroy_publisher(reliable)
        driver = node.create_publisher(Odometry, "/driver", BEST_EFFORT)
        spin_until(lambda: driver.get_subscription_count() == 1)
        driver.publish(Odometry())
        name = "trajectory_recorder"
        for text in (
            "/odom has 2 publishers: /test_robot, /test_robot; stop all but one",
            "lost messages are not counted: several publishers send on it",
            "/driver: /test_robot came later and offers less (Best effort publisher and reliable",
            "nothing on /silent for 2 s, though /test_robot publishes it",
        ):
            spin_until(lambda text=text: robot.has_said(text, name))  # type: ignore[misc]
        stop(recorder)
    with Bag(bag) as source:
        assert source.count("/driver") == 1
        [counts] = [batch.sequence for _, batch in source.batches(["/odom"])]
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
        spin_until(lambda: driver.count_subscribers("/cmd_vel") == 1)
        said = graph.rivals(driver, commands)
    assert said.startswith(deaf)
    assert bool(said) is bool(deaf)
