"""What goes wrong on a robot, done to the monitor and the recorder over DDS."""

import itertools
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from benchmarks.monitor import COMMAND, STATE, bundle_of, timing_funnel
from nlsid_ros import qos
from nlsid_ros.messages import stamp_of
from tests.ros import domains
from tests.ros.domains import own_domain
from tests.ros.processes import Bench, node_here, process, ros_test, stop
from tests.ros.robot import GOOD, PERIOD_NS, Robot

pytestmark = ros_test
MONITOR = "nlsid_ros.funnel_monitor"


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """One for all these tests: they share a robot."""
    with own_domain():
        yield


@pytest.fixture(scope="module")
def robot(funnel: Path) -> Iterator[Robot]:
    """One robot with one monitor, which each test restarts."""
    with ExitStack() as stack:
        robot = Robot(stack, funnel.parent)
        robot.start("funnel_monitor", stale_after=0.5, allow_old_stamps=True)
        yield robot


@pytest.mark.parametrize(
    ("samples", "speed", "says"),
    [
        ([*GOOD, 4], 0.0, "time went back"),
        ([*GOOD, 150], 0.0, "of a new run: 140 samples are missing before t ="),
        ([0, 1, 2, 3, 5, 4], 0.0, "no speed for 0.5 s"),
        (GOOD, math.nan, "no speed for 0.5 s"),
        (GOOD, math.inf, "no speed for 0.5 s"),
        (GOOD, 1e300, "outside"),
        (GOOD, 0.0, "no speed for 0.5 s"),
    ],
    ids=["back", "ahead", "out of order", "nan", "infinite", "huge", "silence"],
)
def test_a_state_that_cannot_be_trusted_is_named_and_only_a_new_run_is_inside(
    robot: Robot, samples: list[int], speed: float, says: str
) -> None:
    """A tube around the simulation starts again, from four samples; an alarm is latched."""
    robot.restart()
    robot.drive(samples, speed=speed)
    robot.hears(says)
    robot.said.clear()
    robot.drive([300, 301, 302, 303])
    robot.hears("")
    assert not robot.has_said("inside")
    robot.drive([304, 305])
    if says == "outside":
        robot.spin_until(lambda: len(robot.said["funnel_monitor"]) > 1)
        assert not robot.has_said("inside")
    else:
        robot.hears("inside")


def test_the_terminal_says_when_the_robot_leaves(robot: Robot) -> None:
    with process(
        "nlsid_ros.funnel_monitor", __node="talking_monitor", allow_old_stamps=True
    ) as monitor:
        robot.ready(monitors=2)
        robot.hears(" yet", "talking_monitor")
        robot.drive(GOOD)
        robot.hears("inside", "talking_monitor")
        robot.drive([10, 11], speed=1e300)
        robot.hears("outside", "talking_monitor")
        output = stop(monitor)
    assert "[INFO]" in next(line for line in output.splitlines() if line.endswith(": inside"))
    [outside] = [line for line in output.splitlines() if "outside" in line]
    assert outside.startswith("[ERROR]")


def test_messages_that_come_twice_count_once(robot: Robot) -> None:
    robot.restart()
    robot.drive([k for k in range(12) for _ in range(2)], slower=0.5)
    robot.hears("unknown: no speed")
    texts = [text for text, _ in robot.said["funnel_monitor"]]
    assert "inside" in texts
    assert texts[-1] == "unknown: no speed for 0.5 s", "nothing else went wrong"
    assert int(robot.said["funnel_monitor"][-1][1]["duplicate responses"]) == 12


def test_a_publisher_that_dies_ends_the_run_and_one_that_returns_can_begin_another(
    robot: Robot,
) -> None:
    robot.restart()
    robot.drive(GOOD)
    robot.hears("inside")
    robot.node.destroy_publisher(robot.odom)
    robot.hears("unknown: no speed")
    robot.odom = robot.node.create_publisher(Odometry, "/odom", qos.STREAM)
    robot.restart()
    robot.drive(GOOD)
    robot.hears("inside")


def test_two_monitors_say_the_same(robot: Robot) -> None:
    with process(
        "nlsid_ros.funnel_monitor", __node="second_monitor", allow_old_stamps=True
    ) as second:
        robot.ready(monitors=2)
        robot.hears(" yet", "second_monitor")
        robot.restart()
        robot.drive(GOOD)
        robot.hears("inside")
        robot.hears("inside", "second_monitor")
        stop(second)


def test_in_simulated_time_a_slow_simulation_is_not_a_silent_robot(robot: Robot) -> None:
    simulated = {"use_sim_time": True, "stale_after": 0.1, "__node": "simulated_monitor"}
    with process(MONITOR, **simulated) as monitor:
        robot.ready(monitors=2)
        robot.spin_until(lambda: robot.clock.get_subscription_count() >= 1)
        robot.hears(" yet", "simulated_monitor")
        robot.drive(GOOD, slower=8.0, clock=True)  # 0.2 s of wall time between samples
        robot.hears("inside", "simulated_monitor")
        assert not robot.has_said("no speed for", "simulated_monitor")
        stop(monitor)


def test_a_robot_that_is_silent_after_simulated_time_went_back_is_not_inside(
    robot: Robot,
) -> None:
    """A simulation is reset, and its robot does not come back: nothing is due for a long time."""
    name = "simulated_monitor"
    with process(
        "nlsid_ros.funnel_monitor", use_sim_time=True, stale_after=0.5, __node=name
    ) as monitor:
        robot.ready(monitors=2)
        robot.spin_until(lambda: robot.clock.get_subscription_count() >= 1)
        robot.hears(" yet", name)
        robot.drive(GOOD, clock=True)
        robot.hears("inside", name)
        for k in range(80):
            past = stamp_of(10**18 - 10**11 + k * PERIOD_NS)
            robot.clock.publish(Clock(clock=past))
            robot.waits(PERIOD_NS * 1e-9)
        robot.hears("this node's clock went back by 100 s", name)
        robot.said.clear()
        robot.hears("", name)
        assert not robot.has_said("inside", name)
        stop(monitor)


def test_a_recorder_that_waits_for_simulated_time_says_so(robot: Robot, tmp_path: Path) -> None:
    settings: dict[str, object] = {"topics": "[/odom]", "bag": tmp_path / "bag"}
    with process("nlsid_ros.trajectory_recorder", **settings, use_sim_time=True) as recorder:
        robot.hears("nobody publishes /clock", "trajectory_recorder")
        stop(recorder)


def test_a_recording_stops_while_there_is_room_to_finish_it(robot: Robot, tmp_path: Path) -> None:
    bag = tmp_path / "full"
    settings: dict[str, object] = {"topics": "[/odom]", "bag": bag, "least_free": 1e11}
    with process("nlsid_ros.trajectory_recorder", **settings) as recorder:
        robot.hears("are to stay free", "trajectory_recorder")
        stop(recorder)
    assert (bag / "metadata.yaml").is_file(), "the bag was closed"


def test_a_recorder_whose_bag_is_taken_away_says_so(robot: Robot, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    robot.said.clear()
    with process("nlsid_ros.trajectory_recorder", topics="[/odom]", bag=bag) as recorder:
        robot.hears("nothing on /odom yet", "trajectory_recorder")
        shutil.rmtree(bag)
        robot.hears("recording stopped: ", "trajectory_recorder")
        assert robot.levels["trajectory_recorder"] == DiagnosticStatus.ERROR
        stop(recorder)
    assert not bag.exists()


@pytest.mark.parametrize("role", ["response", "excitation"])
def test_an_array_of_another_length_is_named_and_a_run_goes_on_if_it_is_no_command(
    role: str, stack: ExitStack
) -> None:
    design = timing_funnel(1000)
    stack.enter_context(own_domain())
    bench = Bench(stack)
    bench.start("funnel_monitor", source="/benchmark", stale_after=5.0, allow_old_stamps=True)
    latched = bench.node.create_publisher(String, "/benchmark/design", qos.DOCUMENT)
    latched.publish(String(data=bundle_of(design).text()))
    state, command = (
        bench.node.create_publisher(JointState, path.partition(":")[0], qos.STREAM)
        for path in (STATE, COMMAND)
    )
    bench.spin_until(lambda: min(p.get_subscription_count() for p in (state, command)) == 1)

    def send(samples: range, *, short: str = "") -> None:
        for k in samples:
            for publisher, whose in ((command, "excitation"), (state, "response")):
                message = JointState(position=[] if whose == short else [0.0])
                message.header.stamp.sec, message.header.stamp.nanosec = 7, k * 10**6
                publisher.publish(message)

    send(range(10))
    bench.hears("inside")
    send(range(10, 11), short=role)
    bench.hears("'position' has 0 elements")
    bench.said.clear()
    send(range(11, 11 + len(design.model) - 1))  # too few to start a run
    if role == "response":  # its sample is lost, and its command is known
        bench.hears("inside")
        return
    bench.hears("waiting for the first")
    bench.said.clear()  # the sample before the short one may have been judged late
    bench.spin_until(lambda: len(bench.said.get("funnel_monitor", [])) > 1)  # a heartbeat or two
    assert all(text.startswith("unknown") for text, _ in bench.said["funnel_monitor"])


def test_discovery_is_kept_to_this_machine_and_to_one_domain_per_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another process that begins with the same number gets another domain too."""
    names = []
    with ExitStack() as stack:
        for _ in range(3):
            monkeypatch.setattr(domains, "_tried", itertools.count(7))
            stack.enter_context(own_domain())
            assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
            names.append(os.environ["ROS_DOMAIN_ID"])
            node, spin_until = stack.enter_context(node_here("test_elsewhere"))
            spin_until(lambda: True)
            assert node.get_node_names() == ["test_elsewhere"]
    assert len(set(names)) == 3
