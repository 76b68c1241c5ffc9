"""What a controller is told wrongly, or no longer told: it says what, and comes to rest."""

import math
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.documents import MODEL, load_model
from bags.monitoring.announcement import UNANNOUNCED, WAITING, Run
from nlsid_core import files
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.ros.processes import call, node_here, process, ros_test
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
        self.run = f"{self.bundle.digest} {WAITING}"  # as a monitor's verdict names it
        node.create_subscription(TwistStamped, "/cmd_vel", self._command, qos.STREAM)
        node.create_subscription(String, f"/{NAME}/run", self._begun, qos.DOCUMENT)
        spin_until(lambda: self.has_said("idle", NAME))
        spin_until(lambda: self.odom.get_subscription_count() >= 1)
        spin_until(lambda: node.count_publishers("/cmd_vel") >= 2)

    def _command(self, message: TwistStamped) -> None:
        self.commands[stamp_ns_of(message)] = message.twist.linear.x

    def _begun(self, message: String) -> None:
        run = Run.from_document(files.parse_document(message.data))
        self.run = f"{run.funnel} {WAITING}" if run.ended else run.name

    def call(self, service: str) -> Trigger.Response:
        """The answer of a service of the controller."""
        return call(self.node, self.spin_until, f"/{NAME}/{service}")

    def watch(self) -> None:
        """Stand in for the monitor that is required."""
        self.margin = self.node.create_publisher(JointState, "/funnel_monitor/margin", qos.STREAM)
        self.spin_until(lambda: self.margin.get_subscription_count() == 1)
        self.spin_until(lambda: self.call("start").success)

    def feed(
        self,
        samples: int,
        *,
        ahead: float = 0.0,
        frame: str = "",
        speed: float = 0.0,
        margin_at: float | None = None,
        judging: str = "",
    ) -> list[int]:
        """Responses in real time; their stamps (ns), `ahead` s of now at the first.

        margin_at: a monitor's verdict comes with each, stamped so many s from it. judging: of which
        funnel and run it says to be; empty: of the controller's.
        """
        first = time.time_ns() + round(ahead * 1e9)
        began = time.monotonic()
        stamps = [first + k * PERIOD_NS for k in range(samples)]
        for k, stamp_ns in enumerate(stamps):
            message = Odometry()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            message.header.frame_id = frame
            message.twist.twist.linear.x = speed
            self.odom.publish(message)
            if margin_at is not None:
                said = JointState(name=["margin", "assumption"], position=[0.5, math.nan])
                of_ns = stamp_ns + round(margin_at * 1e9)
                said.header.stamp.sec, said.header.stamp.nanosec = divmod(of_ns, 10**9)
                said.header.frame_id = judging or self.run
                self.margin.publish(said)
            due = began + (k + 1) * PERIOD_NS * 1e-9
            self.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
        return stamps

    def expect_stop(self, because: str) -> None:
        """It says why, at ERROR, and the last command is that of a robot at rest."""
        self.spin_until(lambda: self.has_said(f"idle; stopped: {because}", NAME))
        assert self.levels[NAME] == DiagnosticStatus.ERROR
        self.spin_until(lambda: not self.commands or self.commands[max(self.commands)] == 0.0)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
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


@pytest.mark.parametrize(
    ("fed", "because"),
    [
        (
            {"frame": "odom", "ahead": 3600.0},
            "a response is stamped 3.6e+03 s after this node's clock",
        ),
        (
            {"frame": "odom", "ahead": -3600.0},
            "a response is stamped 3.6e+03 s before this node's clock",
        ),
        ({"frame": "map"}, "the response is in frame 'map', not in 'odom'"),
        ({"frame": "odom", "speed": math.nan}, "speed is nan"),
    ],
    ids=["ahead", "old", "another frame", "no number"],
)
def test_a_response_that_is_none_stops_it_by_name(
    stack: ExitStack, funnel: Path, fed: dict[str, Any], because: str
) -> None:
    robot = Driven(stack, funnel, response_frame="odom")
    assert robot.call("start").success
    robot.feed(3, **fed)
    robot.expect_stop(because)


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


@pytest.mark.parametrize(
    ("frame", "ahead", "because"),
    [("map", 0.0, "the response is in frame 'map'"), ("odom", -3600.0, "a response is stamped")],
)
def test_the_first_response_is_held_to_the_same_rules_and_moves_nothing(
    stack: ExitStack, funnel: Path, frame: str, ahead: float, because: str
) -> None:
    robot = Driven(stack, funnel, response_frame="odom")
    assert robot.call("start").success
    robot.feed(1, frame=frame, ahead=ahead)
    robot.expect_stop(because)
    assert set(robot.commands.values()) <= {0.0}


def test_limits_beyond_the_fitted_range_do_not_let_it_command_more(
    stack: ExitStack, funnel: Path
) -> None:
    """A car that stands still while the plan goes on asks for more and more."""
    model = load_model(funnel.with_name(MODEL))
    lowest, highest = model.u_range
    robot = Driven(stack, funnel, highest=10.0, lowest=-10.0)
    assert robot.call("start").success
    robot.feed(100)
    robot.spin_until(lambda: max(robot.commands.values()) >= highest)
    assert max(robot.commands.values()) == highest == pytest.approx(0.4)
    assert min(robot.commands.values()) >= lowest


def test_a_controller_that_was_held_up_does_not_set_the_robot_in_motion_again(
    stack: ExitStack, funnel: Path
) -> None:
    """A base that stops when no command comes rests by then."""
    robot = Driven(stack, funnel)
    assert robot.call("start").success
    robot.feed(40)
    robot.spin_until(lambda: max(robot.commands.values()) > 0.1)
    robot.controller.send_signal(signal.SIGSTOP)
    robot.feed(100)
    before = dict(robot.commands)
    robot.controller.send_signal(signal.SIGCONT)
    robot.expect_stop("")
    robot.spin_until(lambda: len(robot.commands) > len(before))
    after = robot.commands.keys() - before.keys()
    assert {robot.commands[stamp] for stamp in after} == {0.0}


@pytest.mark.parametrize("margin_at", [-3600.0, -5.0, 3600.0])
def test_a_verdict_that_is_not_of_this_run_and_of_now_is_none(
    stack: ExitStack, funnel: Path, margin_at: float
) -> None:
    robot = Driven(stack, funnel, require_monitor=True, monitor_patience=LATE, stop_within=0.1)
    robot.watch()
    robot.feed(80, margin_at=margin_at)
    robot.expect_stop("funnel_monitor has judged nothing for 1 s")


OTHER = "sha256:" + 64 * "0"


@pytest.mark.parametrize(
    ("judging", "because"),
    [
        (" ", "funnel_monitor judges a funnel that it does not name, not sha256:"),
        ("odom", "funnel_monitor judges the funnel odom, not sha256:"),
        (f"{OTHER} {WAITING}", f"funnel_monitor judges the funnel {OTHER}, not sha256:"),
        (f"{{digest}} {UNANNOUNCED}", "funnel_monitor judges no run: set its controller"),
        ("{digest} 7", "funnel_monitor has judged nothing for 1 s"),
    ],
)
def test_verdicts_of_another_funnel_or_run_end_it_before_it_moves(
    stack: ExitStack, funnel: Path, judging: str, because: str
) -> None:
    robot = Driven(stack, funnel, require_monitor=True, monitor_patience=LATE)
    robot.watch()
    robot.feed(80, margin_at=0.0, judging=judging.format(digest=robot.bundle.digest))
    robot.expect_stop(because)
    assert set(robot.commands.values()) <= {0.0}


def test_a_second_node_that_publishes_verdicts_ends_it(stack: ExitStack, funnel: Path) -> None:
    robot = Driven(stack, funnel, require_monitor=True, monitor_patience=LATE)
    robot.watch()
    robot.node.create_publisher(JointState, "/funnel_monitor/margin", qos.STREAM)
    robot.feed(40, margin_at=0.0)
    robot.expect_stop("2 nodes publish /funnel_monitor/margin")
    assert "2 nodes publish /funnel_monitor/margin" in robot.call("start").message


def test_with_fresh_verdicts_it_tracks_to_the_end_of_the_plan(
    stack: ExitStack, funnel: Path
) -> None:
    """What the test above needs: the same, but each verdict is of its sample."""
    robot = Driven(stack, funnel, require_monitor=True, monitor_patience=LATE)
    robot.watch()
    robot.feed(140, margin_at=0.0)
    robot.spin_until(lambda: robot.has_said("idle; stopped: the p", NAME))
    assert not robot.has_said("has judged nothing", NAME)


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
    for publisher in (robot.odom, robot.command):  # the plant is the only robot
        robot.node.destroy_publisher(publisher)
    stack.enter_context(process("nlsid_ros.plant", **plant))
    monitor = stack.enter_context(process("nlsid_ros.funnel_monitor", **watching))
    robot.spin_until(lambda: robot.has_said("waiting for the controller"))
    for _ in range(20):  # the controller may hear of the monitor later than we do
        if robot.call("start").success:
            break
        time.sleep(0.2)
    robot.spin_until(lambda: len(robot.commands) > 10)  # of the 117 of the plan
    monitor.kill()
    robot.expect_stop("funnel_monitor has judged nothing for 1 s")
