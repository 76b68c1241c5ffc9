"""A tube around the model's own simulation over DDS: what ends a run, and what begins the next."""

import math
from collections.abc import Iterator
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
from nlsid_core.design import OutputTube, design
from nlsid_core.models import Signal
from nlsid_core.progress import silent
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests import implicit_models
from tests.core.kernel.tube_claims import dataset
from tests.ros.processes import node_here, process, ros_test, stop, use_domain_of_this_run
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
def robot(monkeypatch: pytest.MonkeyPatch, tube: Path) -> Iterator[Robot]:
    use_domain_of_this_run(monkeypatch)
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


def test_a_box_that_is_left_is_named_and_nothing_is_judged_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A tube that is proved for commands up to 1.5 N, and one command of 1.6 N."""
    model = replace(
        implicit_models.cubic_spring(),
        y=(Signal("speed", "m/s", "/odom:twist.twist.linear.x"),),
        u=(Signal("force", "N", "/cmd_vel:twist.linear.x"),),
        window=((0, 0),),
    )
    box = ((-1.5, 1.5), (-1.0, 1.5))
    made = design(OutputTube(model, dataset(model, 0), dataset(model, 100), box=box))
    made.save(tmp_path)
    trial, far = dataset(model, 300, 1, 100).trajectories[0], 50
    margins: dict[int, float] = {}

    def hear(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[message.name.index("margin")]

    use_domain_of_this_run(monkeypatch)
    with (
        node_here("test_robot") as (node, spin_until),
        process(MONITOR, stale_after=5.0, allow_old_stamps=True) as monitor,
    ):
        robot = Robot(node, spin_until, tmp_path)
        node.create_subscription(JointState, "/funnel_monitor/margin", hear, qos.STREAM)
        robot.ready()
        stamps = [10**18 + round(t * 1e9) for t in trial.t]
        for k, stamp in enumerate(stamps):
            command, state = TwistStamped(), Odometry()
            for message in (command, state):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            command.twist.linear.x = 1.6 if k == far else float(trial.u[k, 0])
            state.twist.twist.linear.x = float(trial.y[k, 0])
            robot.command.publish(command)
            robot.odom.publish(state)
            spin_until(lambda stamp=stamp: stamp in margins)  # type: ignore[misc]
        spin_until(lambda: robot.has_said("outside the box in which the tube is proved"))
        stop(monitor)
    inside = [margins[stamp] >= 0.0 for stamp in stamps]
    assert all(inside[20:far])
    assert not any(inside[far : far + 2])
    assert np.isnan(margins[stamps[far]])
    assert all(inside[far + 10 :]), "a new run begins inside the box"
