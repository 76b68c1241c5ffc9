"""The controller over DDS: its rate, its announcement, its limits, and all that makes it stop."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files
from bags.designs import documents
from bags.monitoring.announcement import Run
from nlsid_core import files
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.ros.processes import call, node_here, process, ros_test

pytestmark = ros_test

CONTROLLER = "nlsid_ros.tracking_controller"
PERIOD_NS = 25_000_000
STOP_RATE = 2.0


class Stage:
    """A controller that tracks, on the simulated plant, and what is heard of it."""

    def __init__(
        self, stack: ExitStack, funnel: Path, folder: Path | None = None, **settings: object
    ) -> None:
        self.commands: list[tuple[int, float]] = []
        self.said: list[str] = []
        self.monitor: list[str] = []
        self.node, self.spin_until = stack.enter_context(node_here("test_operator"))
        self.node.create_subscription(TwistStamped, "/cmd_vel", self._hear, qos.STREAM)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear_said, qos.EVENTS)
        self.designs: list[String] = []
        self.node.create_subscription(
            String, "/funnel_publisher/design", self.designs.append, qos.DOCUMENT
        )
        if folder is not None:
            for path in funnel.parent.iterdir():
                (folder / path.name).write_bytes(path.read_bytes())
            funnel = folder / funnel.name
        self.publisher = stack.enter_context(process("nlsid_ros.funnel_publisher", funnel=funnel))
        self.plant = stack.enter_context(
            process("nlsid_ros.plant", model=funnel.with_name(documents.MODEL))
        )
        given = {"highest": 0.4, "stop_rate": STOP_RATE, "stale_after": 1.0} | settings
        self.controller = stack.enter_context(process(CONTROLLER, **given))
        self.spin_until(lambda: self.has_said("idle"))
        self.spin_until(lambda: self.node.count_subscribers("/odom") >= 1)

    def _hear(self, message: TwistStamped) -> None:
        self.commands.append((stamp_ns_of(message), message.twist.linear.x))

    def _hear_said(self, message: DiagnosticArray) -> None:
        for status in message.status:
            heard = {"tracking_controller": self.said, "funnel_monitor": self.monitor}
            heard.get(status.name, []).append(status.message)

    def has_said(self, text: str) -> bool:
        """Whether the controller has said `text`."""
        return any(text in said for said in self.said)

    def call(self, service: str) -> Trigger.Response:
        """The answer of a service of the controller."""
        return call(self.node, self.spin_until, f"/tracking_controller/{service}")

    def track(self, above: float = 0.1) -> None:
        """Begin, and wait until the robot is well on its way."""
        assert self.call("start").success
        self.spin_until(lambda: bool(self.commands) and self.commands[-1][1] > above)

    def expect_ramp_down(self, because: str) -> None:
        """It says why it stops, and comes to rest no faster than allowed."""
        self.spin_until(lambda: self.has_said(f"idle; stopped: {because}"))
        self.spin_until(lambda: self.commands[-1][1] == 0.0)
        falling = np.diff([u for _, u in self.commands])
        assert falling.min() >= -STOP_RATE * PERIOD_NS * 1e-9 * (1 + 1e-9)


@pytest.fixture
def stage(funnel: Path) -> Iterator[Callable[..., Stage]]:
    """Sets a stage with parameters of the controller."""
    with ExitStack() as stack:
        yield partial(Stage, stack, funnel=funnel)


def test_commands_come_at_the_models_rate_and_the_start_is_announced_latched(
    stage: Callable[..., Stage], funnel: Path
) -> None:
    runs: list[String] = []
    robot = stage()
    robot.track()
    robot.node.create_subscription(String, "/tracking_controller/run", runs.append, qos.DOCUMENT)
    robot.spin_until(lambda: len(runs) == 1)
    run = Run.from_document(files.parse_document(runs[0].data, source="run"))
    assert run.funnel == files.digest(files.load_document(funnel))
    stamps = np.array([stamp for stamp, _ in robot.commands])
    assert run.start_ns > stamps[0]
    assert (run.start_ns - stamps[0]) % PERIOD_NS == PERIOD_NS // 4, "a quarter period ahead"
    assert set(np.diff(stamps)) == {PERIOD_NS}
    assert not robot.call("start").success, "one run at a time"
    assert robot.call("stop").success
    robot.expect_ramp_down("asked to")


def test_a_robot_that_falls_silent_is_stopped(stage: Callable[..., Stage]) -> None:
    robot = stage(stale_after=0.3)
    robot.track()
    robot.plant.kill()
    robot.expect_ramp_down("the response stopped coming")


def test_the_same_design_again_in_mid_run_does_not_stop_it(
    stage: Callable[..., Stage], tmp_path: Path
) -> None:
    robot = stage(folder=tmp_path)
    robot.track()
    heard = len(robot.designs)
    (tmp_path / documents.FUNNEL).touch()
    robot.spin_until(lambda: len(robot.designs) > heard)
    count = len(robot.commands)
    robot.spin_until(lambda: len(robot.commands) > count + 10)
    assert not robot.has_said("stop")


def test_another_design_in_mid_run_stops_it(
    stage: Callable[..., Stage], funnel: Path, tmp_path: Path
) -> None:
    """A run of half a minute: publisher and controller each have the other design decided first."""
    used, other = tmp_path / "used", tmp_path / "other"
    config = load_config(config_file("f1tenth.yaml"))
    assert config.funnel is not None
    assert config.funnel.profile is not None
    long = [*config.funnel.profile[:-1], (30.0, config.funnel.profile[-1][1])]
    for folder, safety in ((used, 1.5), (other, 2.0)):
        shutil.copytree(funnel.parent, folder)
        changed = {"profile": long, "horizon": None, "safety_factor": safety}
        settings = config.model_copy(update={"funnel": config.funnel.model_copy(update=changed)})
        design_funnel_files(folder / documents.MODEL, settings, folder)
    robot = stage(funnel=used / documents.FUNNEL)
    robot.track()
    for name in (documents.POLICY, documents.FUNNEL, documents.FUNNEL_PROOF):
        shutil.copyfile(other / name, used / name)
    robot.expect_ramp_down("the design was replaced")


def test_limits_that_would_cut_off_the_plan_are_refused_and_nothing_moves(
    stage: Callable[..., Stage],
) -> None:
    robot = stage(highest=0.2)
    answer = robot.call("start")
    assert not answer.success
    assert "beyond the limits [0, 0.2]" in answer.message
    robot.spin_until(lambda: robot.has_said("idle; not started: the plan's input"))
    assert robot.commands == []
