"""A tube around the model's own simulation over DDS: what ends a run, and what begins the next."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from bags.chain.config import FunnelConfig, load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.samples import f1tenth
from nlsid_core.arrays import FloatArray
from nlsid_core.design import OutputTube, design
from nlsid_core.models import Signal
from nlsid_core.progress import silent
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests import implicit_models
from tests.core.kernel.tube_claims import MODELS, dataset
from tests.ros.processes import node_here, process, ros_test, stop
from tests.ros.robot import MONITOR, PERIOD_NS, Robot

pytestmark = ros_test


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The car's tube without a plan: `funnel: {}`."""
    out = tmp_path_factory.mktemp("tube")
    config = load_config(config_file("f1tenth.yaml"))
    config = config.model_copy(update={"funnel": FunnelConfig()})
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    return out


@pytest.fixture
def robot(tube: Path) -> Iterator[Robot]:
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True) as monitor,
    ):
        robot = Robot(node, spin_until, tube)
        robot.ready()
        yield robot
        stop(monitor)


def test_an_unknown_command_ends_the_run_and_a_new_one_begins_by_itself(robot: Robot) -> None:
    margins: dict[int, float] = {}

    def hear(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[message.name.index("margin")]

    def stamp_ns(k: int) -> int:
        return 10**18 + k * PERIOD_NS

    robot.node.create_subscription(JointState, "/funnel_monitor/margin", hear, qos.STREAM)
    k = -1
    while not any(margin >= 0.0 for margin in margins.values()):
        robot.drive([k := k + 1])
        assert k < 400, robot.said
    k = bad = k + 1
    unknown = TwistStamped()
    unknown.header.stamp.sec, unknown.header.stamp.nanosec = divmod(stamp_ns(bad), 10**9)
    unknown.twist.linear.x = math.nan
    robot.command.publish(unknown)
    robot.drive([bad])  # a command comes again at that stamp: the first one counts
    while not any(margin >= 0.0 for at, margin in margins.items() if at > stamp_ns(bad)):
        robot.drive([k := k + 1])
        assert k < 400, robot.said
    assert math.isnan(margins[stamp_ns(bad)])
    assert math.isnan(margins[stamp_ns(bad + 1)]), "a new run takes samples to begin"


def test_forecasts_are_published_for_later_stamps_and_hold_what_then_comes(tube: Path) -> None:
    ahead_ns, forecasts = 10 * PERIOD_NS, dict[int, dict[str, float]]()

    def hear(message: JointState) -> None:
        numbers = zip(message.name, message.position, strict=True)
        forecasts[stamp_ns_of(message)] = dict(numbers)

    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True, forecast=0.25) as monitor,
    ):
        node.create_subscription(JointState, "/funnel_monitor/forecast", hear, qos.STREAM)
        robot = Robot(node, spin_until, tube)
        robot.ready()
        k = -1
        while len(forecasts) < 5:
            robot.drive([k := k + 1])
            assert k < 400, robot.said
        stop(monitor)
    for stamp_ns, numbers in forecasts.items():
        assert (stamp_ns - 10**18) % PERIOD_NS == 0
        assert stamp_ns - 10**18 <= k * PERIOD_NS + ahead_ns
        assert numbers["ahead"] == pytest.approx(0.25)
        assert numbers["low"] < 0.0 < numbers["high"], "the car stands still, as it is told"


def test_of_a_robot_in_motion_nothing_is_said_until_the_start_has_faded(tube: Path) -> None:
    given = {"stale_after": 5.0, "allow_old_stamps": True, "nominal": "motion"}
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, **given) as monitor,
    ):
        robot = Robot(node, spin_until, tube)
        robot.ready()
        k = -1
        while not robot.has_said("samples: the start fades"):
            robot.drive([k := k + 1], speed=0.3 if k < 3 else 0.0)
            assert k < 400, robot.said
        while not robot.has_said("inside"):
            robot.drive([k := k + 1])
            assert k < 400, robot.said
        stop(monitor)
    assert k > 20
    assert not robot.has_said("violated"), "three outputs at the start were off"


@contextmanager
def sprung(folder: Path) -> Iterator[tuple[Robot, Callable[[FloatArray, FloatArray], FloatArray]]]:
    """A robot on a cubic spring, watched by a tube that is proved for commands up to 1.5 N.

    The second sends outputs (N,) and commands (N,) sample by sample and returns the margins (N,).
    """
    model = replace(
        implicit_models.cubic_spring(),
        y=(Signal("speed", "m/s", "/odom:twist.twist.linear.x"),),
        u=(Signal("force", "N", "/cmd_vel:twist.linear.x"),),
        window=((0, 0),),
    )
    box = ((-1.5, 1.5), (-1.0, 1.5))
    made = design(OutputTube(model, dataset(model, 0), dataset(model, 100), box=box))
    made.save(folder)
    margins: dict[int, float] = {}

    def hear(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[message.name.index("margin")]

    def send(y: FloatArray, u: FloatArray) -> FloatArray:
        stamps = [10**18 + round(k * model.period * 1e9) for k in range(len(y))]
        for k, stamp in enumerate(stamps):
            command, state = TwistStamped(), Odometry()
            for message in (command, state):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            command.twist.linear.x, state.twist.twist.linear.x = float(u[k]), float(y[k])
            robot.command.publish(command)
            robot.odom.publish(state)
            spin_until(lambda stamp=stamp: stamp in margins)  # type: ignore[misc]
        return np.array([margins[stamp] for stamp in stamps])

    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True) as monitor,
    ):
        robot = Robot(node, spin_until, folder)
        node.create_subscription(JointState, "/funnel_monitor/margin", hear, qos.STREAM)
        robot.ready()
        yield robot, send
        stop(monitor)


def test_a_box_that_is_left_is_named_and_nothing_is_judged_there(tmp_path: Path) -> None:
    far = 50
    trial = dataset(MODELS["implicit_box"](), 300, 1, 100).trajectories[0]
    u = trial.u[:, 0].copy()
    u[far] = 1.6
    with sprung(tmp_path) as (robot, send):
        margins = send(trial.y[:, 0], u)
        robot.spin_until(lambda: robot.has_said("outside the box in which the tube is proved"))
    assert (margins[20:far] >= 0.0).all()
    assert not (margins[far : far + 2] >= 0.0).any()
    assert np.isnan(margins[far])
    assert (margins[far + 10 :] >= 0.0).all(), "a new run begins inside the box"


def test_innovations_that_add_up_on_one_side_warn_while_the_tube_is_kept(tmp_path: Path) -> None:
    trial = dataset(MODELS["implicit_box"](), 300, 1, 100).trajectories[0]
    y = trial.y[:, 0].copy()
    y[40:] += 0.1  # m/s: within what is assumed
    with sprung(tmp_path) as (robot, send):
        margins = send(y, trial.u[:, 0])
        robot.spin_until(lambda: robot.has_said("cusum alarm"))
    assert (margins[20:] >= 0.0).all(), "it changes no verdict"
    assert not robot.has_said("above the level")
