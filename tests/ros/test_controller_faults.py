"""What a controller is told wrongly, or no longer told: it says what, and comes to rest."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.ros.processes import node_here, process, ros_test, use_domain_of_this_run
from tests.ros.robot import PERIOD_NS, Robot

pytestmark = ros_test
CONTROLLER = "nlsid_ros.tracking_controller"
NAME = "tracking_controller"
LATE = 1.0  # s that the machine may be busy


class Driven(Robot):
    """A robot whose controller is fed by the test, with present stamps."""

    def __init__(self, stack: ExitStack, funnel: Path, **settings: object) -> None:
        node, spin_until = stack.enter_context(node_here("test_robot"))
        given = {"highest": 0.4, "stale_after": LATE} | settings
        self.controller = stack.enter_context(process(CONTROLLER, **given))
        super().__init__(node, spin_until, funnel.parent)
        self.commands: dict[int, float] = {}
        node.create_subscription(TwistStamped, "/cmd_vel", self._command, qos.STREAM)
        spin_until(lambda: self.has_said("idle", NAME))
        spin_until(lambda: self.odom.get_subscription_count() >= 1)
        spin_until(lambda: node.count_publishers("/cmd_vel") >= 2)

    def _command(self, message: TwistStamped) -> None:
        self.commands[stamp_ns_of(message)] = message.twist.linear.x

    def call(self, service: str) -> Trigger.Response:
        """The answer of a service of the controller."""
        client = self.node.create_client(Trigger, f"/{NAME}/{service}")
        self.spin_until(client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.spin_until(answer.done)
        response: Trigger.Response = answer.result()
        return response

    def feed(self, samples: int, *, ahead: float = 0.0, frame: str = "") -> list[int]:
        """Responses at rest in real time; their stamps (ns), `ahead` s of now at the first."""
        first = time.time_ns() + round(ahead * 1e9)
        began = time.monotonic()
        stamps = [first + k * PERIOD_NS for k in range(samples)]
        for k, stamp_ns in enumerate(stamps):
            message = Odometry()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            message.header.frame_id = frame
            self.odom.publish(message)
            due = began + (k + 1) * PERIOD_NS * 1e-9
            self.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
        return stamps

    def expect_stop(self, because: str) -> None:
        """It says why, at ERROR, and the last command is that of a robot at rest."""
        self.spin_until(lambda: self.has_said(f"idle; stopped: {because}", NAME))
        assert self.levels[NAME] == DiagnosticStatus.ERROR
        self.spin_until(lambda: not self.commands or self.commands[max(self.commands)] == 0.0)


@pytest.fixture
def stack(monkeypatch: pytest.MonkeyPatch) -> Iterator[ExitStack]:
    use_domain_of_this_run(monkeypatch)
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize("ahead", [0.0, 0.03, 0.3])
def test_every_sample_has_its_command_even_if_stamps_lead_the_clock(
    stack: ExitStack, funnel: Path, ahead: float
) -> None:
    robot = Driven(stack, funnel)
    assert robot.call("start").success
    stamps = robot.feed(30, ahead=ahead)
    due = [stamp + 3 * PERIOD_NS // 4 for stamp in stamps]
    robot.spin_until(lambda: due[-1] in robot.commands)
    heard = due[due.index(min(robot.commands)) :]  # from the first that was matched
    assert len(heard) >= 20
    robot.spin_until(lambda: set(heard) <= robot.commands.keys())


@pytest.mark.parametrize(("ahead", "way"), [(3600.0, "after"), (-3600.0, "before")])
def test_stamps_of_another_hour_stop_it_by_name(
    stack: ExitStack, funnel: Path, ahead: float, way: str
) -> None:
    robot = Driven(stack, funnel)
    assert robot.call("start").success
    robot.feed(3, ahead=ahead)
    robot.expect_stop(f"a response is stamped 3.6e+03 s {way} this node's clock")


def test_another_frame_stops_it_by_name(stack: ExitStack, funnel: Path) -> None:
    robot = Driven(stack, funnel, response_frame="odom")
    assert robot.call("start").success
    robot.feed(3, frame="map")
    robot.expect_stop("the response is in frame 'map', not in 'odom'")


def test_a_slow_stop_rate_does_not_keep_it_moving(stack: ExitStack, funnel: Path) -> None:
    robot = Driven(stack, funnel, stop_rate=1e-6, stop_within=0.5, stop_at=0.1)
    assert robot.call("start").success
    robot.feed(20)
    asked = time.monotonic()
    robot.spin_until(lambda: max(robot.commands.values()) > 0.0)
    assert robot.call("stop").success
    robot.spin_until(lambda: robot.has_said("idle; stopped: asked to", NAME))
    assert time.monotonic() - asked < 5.0
    robot.spin_until(lambda: robot.commands[max(robot.commands)] == 0.1)


def test_without_the_monitor_it_requires_it_neither_starts_nor_goes_on(
    stack: ExitStack, funnel: Path
) -> None:
    robot = Driven(stack, funnel, require_monitor=True, monitor_patience=LATE)
    answer = robot.call("start")
    assert not answer.success
    assert "nobody publishes /funnel_monitor/margin" in answer.message
    assert robot.commands == {}
    watching = {"nominal": "profile", "controller": NAME, "command_wait": 0.5, "stale_after": LATE}
    plant = {"model": funnel.with_name("model.json")}
    stack.enter_context(process("nlsid_ros.plant", **plant))
    monitor = stack.enter_context(process("nlsid_ros.funnel_monitor", **watching))
    robot.spin_until(lambda: robot.has_said("waiting for the controller"))
    assert robot.call("start").success
    robot.spin_until(lambda: robot.has_said("inside"))
    monitor.kill()
    robot.expect_stop("funnel_monitor has judged nothing for 1 s")
