"""What a controller promises, and what it is told wrongly: it says what, and comes to rest."""

import math
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files
from bags.designs.documents import FUNNEL, MODEL, POLICY, VECTOR_FIELD, load_model
from bags.monitoring.announcement import UNANNOUNCED, WAITING, Run
from nlsid_core import files
from nlsid_ros import qos
from nlsid_ros.messages import numbers_at, stamp_ns_of, stamp_of
from tests.continuous_stage import stage as continuous_stage
from tests.ros.processes import Bench, ros_test, stop
from tests.ros.robot import PERIOD_NS, Robot

pytestmark = ros_test
NAME, MARGINS = "tracking_controller", "/funnel_monitor/margin"
START, STOP = f"/{NAME}/start", f"/{NAME}/stop"
STOP_RATE = 2.0
LATE = 1.0  # s that the machine may be busy


class Driven(Robot):
    """A robot whose controller is fed by the test, with present stamps."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        super().__init__(stack, folder)
        self.commands: dict[int, float] = {}
        self.run = f"{self.bundle.digest} {WAITING}"  # as a monitor's verdict names it
        self.inside = 1.0  # as it says
        self.listen(TwistStamped, "/cmd_vel", self._command)
        self.listen(String, f"/{NAME}/run", self._begun, qos.DOCUMENT)

    def begins(self, **settings: object) -> None:
        """Start the controller, and a run unless it requires a monitor."""
        given = {"highest": 0.4, "stale_after": LATE} | settings
        self.controller = self.start(NAME, **given)
        self.hears("idle", NAME)
        self.spin_until(lambda: self.odom.get_subscription_count() >= 1)
        self.spin_until(lambda: self.node.count_publishers("/cmd_vel") >= 2)
        if "require_monitor" not in settings:
            assert self.call(START).success

    def _command(self, message: TwistStamped) -> None:
        self.commands[stamp_ns_of(message)] = message.twist.linear.x

    def _begun(self, message: String) -> None:
        run = Run.from_document(files.parse_document(message.data))
        self.run = f"{run.funnel} {WAITING}" if run.ended else run.name
        self.last_ns = run.last_ns

    def watch(self) -> None:
        """Stand in for the monitor that is required."""
        self.begins(require_monitor=True, monitor_patience=LATE, stop_within=0.1)
        self.margin = self.node.create_publisher(JointState, MARGINS, qos.STREAM)
        self.spin_until(lambda: self.margin.get_subscription_count() == 1)
        self.spin_until(lambda: self.call(START).success)

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
            message.header.stamp, message.header.frame_id = stamp_of(stamp_ns), frame
            message.twist.twist.linear.x = speed
            self.odom.publish(message)
            if margin_at is not None:
                of_ns = stamp_ns + round(margin_at * 1e9)
                numbers = {"margin": 0.5, "assumption": math.nan, "inside": self.inside}
                self.margin.publish(numbers_at(of_ns, numbers, judging or self.run))
            due = began + (k + 1) * PERIOD_NS * 1e-9
            self.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
        return stamps

    def expect_stop(self, because: str) -> None:
        """It says why, at ERROR, and the last command is that of a robot at rest."""
        self.hears(f"idle; stopped: {because}", NAME)
        assert self.levels[NAME] == DiagnosticStatus.ERROR
        self.spin_until(lambda: not self.commands or self.commands[max(self.commands)] == 0.0)


@pytest.fixture
def robot(stack: ExitStack, funnel: Path) -> Driven:
    return Driven(stack, funnel.parent)


@pytest.mark.parametrize("ahead", [0.0, 0.03, 0.3])
def test_every_sample_has_its_command_even_if_stamps_lead_the_clock(
    robot: Driven, ahead: float
) -> None:
    robot.begins()
    stamps = robot.feed(30, ahead=ahead)
    due = [stamp + 3 * PERIOD_NS // 4 for stamp in stamps]
    robot.spin_until(lambda: due[-1] in robot.commands)
    heard = due[due.index(min(robot.commands)) :]  # from the first that was matched
    assert len(heard) >= 20
    robot.spin_until(lambda: set(heard) <= robot.commands.keys())


def test_a_plan_that_is_over_has_sent_every_command_of_it(robot: Driven) -> None:
    """The last response may be here before this node's clock shows that a command is due."""
    robot.begins()
    robot.feed(125, ahead=0.3)
    robot.hears("idle; stopped: the plan is over", NAME)
    robot.spin_until(lambda: robot.last_ns - PERIOD_NS // 4 in robot.commands)


@pytest.mark.parametrize(
    ("fed", "because"),
    [
        ({"frame": "odom", "ahead": 3600.0}, "a response is stamped 3.6e+03 s after this node's"),
        ({"frame": "odom", "ahead": -3600.0}, "a response is stamped 3.6e+03 s before this node's"),
        ({"frame": "map"}, "the response is in frame 'map', not in 'odom'"),
        ({"frame": "odom", "speed": math.nan}, "speed is nan"),
    ],
    ids=["ahead", "old", "another frame", "no number"],
)
def test_a_response_that_is_none_stops_it_by_name(
    robot: Driven, fed: dict[str, Any], because: str
) -> None:
    robot.begins(response_frame="odom")
    robot.feed(3, **fed)
    robot.expect_stop(because)


def test_a_slow_stop_rate_does_not_keep_it_moving(robot: Driven) -> None:
    robot.begins(stop_rate=1e-6, stop_within=0.5, stop_at=0.1)
    robot.feed(20)
    robot.spin_until(lambda: max(robot.commands.values()) > 0.0)
    assert robot.call(STOP).success
    robot.hears("idle; stopped: asked to", NAME)
    robot.spin_until(lambda: robot.commands[max(robot.commands)] == 0.1)


@pytest.mark.parametrize(
    ("frame", "ahead", "because"),
    [("map", 0.0, "the response is in frame 'map'"), ("odom", -3600.0, "a response is stamped")],
)
def test_the_first_response_is_held_to_the_same_rules_and_moves_nothing(
    robot: Driven, frame: str, ahead: float, because: str
) -> None:
    robot.begins(response_frame="odom")
    robot.feed(1, frame=frame, ahead=ahead)
    robot.expect_stop(because)
    assert set(robot.commands.values()) <= {0.0}


def test_limits_beyond_the_fitted_range_do_not_let_it_command_more(
    robot: Driven, funnel: Path
) -> None:
    """A car that stands still while the plan goes on asks for more and more."""
    model = load_model(funnel.with_name(MODEL))
    lowest, highest = model.u_range
    robot.begins(highest=10.0, lowest=-10.0)
    robot.feed(100)
    robot.spin_until(lambda: max(robot.commands.values()) >= highest)
    assert max(robot.commands.values()) == highest == pytest.approx(0.4)
    assert min(robot.commands.values()) >= lowest


def test_a_controller_that_was_held_up_does_not_set_the_robot_in_motion_again(
    robot: Driven,
) -> None:
    """A base that stops when no command comes rests by then."""
    robot.begins()
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
    robot: Driven, margin_at: float
) -> None:
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
    robot: Driven, judging: str, because: str
) -> None:
    robot.watch()
    robot.feed(80, margin_at=0.0, judging=judging.format(digest=robot.bundle.digest))
    robot.expect_stop(because)
    assert set(robot.commands.values()) <= {0.0}


def test_a_verdict_that_an_assumption_is_violated_ends_it(robot: Driven) -> None:
    """Of the input, say: then the margin is good, and all is used of nothing."""
    robot.watch()
    robot.inside = 0.0
    robot.feed(80, margin_at=0.0)
    robot.expect_stop("assumption violated: funnel_monitor says so")


def test_a_second_node_that_publishes_verdicts_ends_it(robot: Driven) -> None:
    robot.watch()
    robot.node.create_publisher(JointState, MARGINS, qos.STREAM)
    robot.feed(40, margin_at=0.0)
    robot.expect_stop("2 nodes publish /funnel_monitor/margin")
    assert "2 nodes publish /funnel_monitor/margin" in robot.call(START).message


def test_with_fresh_verdicts_it_tracks_to_the_end_of_the_plan(robot: Driven) -> None:
    """What the test above needs: the same, but each verdict is of its sample."""
    robot.watch()
    robot.feed(140, margin_at=0.0)
    robot.hears("idle; stopped: the p", NAME)
    assert not robot.has_said("has judged nothing", NAME)


def test_without_the_monitor_it_requires_it_neither_starts_nor_goes_on(
    robot: Driven, funnel: Path
) -> None:
    robot.begins(require_monitor=True, monitor_patience=LATE)
    answer = robot.call(START)
    assert not answer.success
    assert "nobody publishes /funnel_monitor/margin" in answer.message
    assert robot.commands == {}
    watching = {"nominal": "profile", "controller": NAME, "command_wait": 0.5, "stale_after": LATE}
    plant = {"model": funnel.with_name("model.json")}
    for publisher in (robot.odom, robot.command):  # the plant is the only robot
        robot.node.destroy_publisher(publisher)
    robot.start("plant", **plant)
    monitor = robot.start("funnel_monitor", **watching)
    robot.hears("waiting for the controller")
    robot.spin_until(lambda: robot.call(START).success)  # it may hear of it later than we do
    robot.spin_until(lambda: len(robot.commands) > 10)  # of the 117 of the plan
    monitor.kill()
    robot.expect_stop("funnel_monitor has judged nothing for 1 s")


class Stage(Bench):
    """A controller that tracks, on the simulated plant, and what is heard of it."""

    def __init__(self, stack: ExitStack, funnel: Path, **settings: object) -> None:
        super().__init__(stack)
        self.commands: list[tuple[int, float]] = []
        self.designs: list[String] = []
        self.listen(TwistStamped, "/cmd_vel", self._hear_command)
        self.listen(String, "/funnel_publisher/design", self.designs.append, qos.DOCUMENT)
        self.start("funnel_publisher", funnel=funnel)
        self.plant = self.start("plant", model=funnel.with_name(MODEL))
        given = {"highest": 0.4, "stop_rate": STOP_RATE, "stale_after": LATE} | settings
        self.controller = self.start(NAME, **given)
        self.hears("idle", NAME)
        self.spin_until(lambda: self.node.count_subscribers("/odom") >= 1)

    def _hear_command(self, message: TwistStamped) -> None:
        self.commands.append((stamp_ns_of(message), message.twist.linear.x))

    def track(self, above: float = 0.1) -> None:
        """Begin, and wait until the robot is well on its way."""
        assert self.call(START).success
        self.spin_until(lambda: bool(self.commands) and self.commands[-1][1] > above)

    def expect_ramp_down(self, because: str) -> None:
        """It says why it stops, and comes to rest no faster than allowed."""
        self.hears(f"idle; stopped: {because}", NAME)
        self.expect_rest()

    def expect_rest(self) -> None:
        """It comes to rest no faster than allowed."""
        self.spin_until(lambda: self.commands[-1][1] == 0.0)
        falling = np.diff([u for _, u in self.commands])
        assert falling.min() >= -STOP_RATE * PERIOD_NS * 1e-9 * (1 + 1e-9)


@pytest.fixture
def stage(stack: ExitStack, funnel: Path) -> Callable[..., Stage]:
    """Sets a stage with parameters of the controller."""
    return partial(Stage, stack, funnel=funnel)


def test_commands_come_at_the_models_rate_and_the_start_is_announced_latched(
    stage: Callable[..., Stage], funnel: Path
) -> None:
    runs: list[String] = []
    robot = stage()
    robot.track()
    robot.listen(String, f"/{NAME}/run", runs.append, qos.DOCUMENT)
    robot.spin_until(lambda: len(runs) == 1)
    run = Run.from_document(files.parse_document(runs[0].data, source="run"))
    assert run.funnel == files.digest(files.load_document(funnel))
    stamps = np.array([stamp for stamp, _ in robot.commands])
    assert run.start_ns > stamps[0]
    assert (run.start_ns - stamps[0]) % PERIOD_NS == PERIOD_NS // 4, "a quarter period ahead"
    assert set(np.diff(stamps)) == {PERIOD_NS}
    assert not robot.call(START).success, "one run at a time"
    assert robot.call(STOP).success
    robot.expect_ramp_down("asked to")


def test_a_robot_that_falls_silent_is_stopped(stage: Callable[..., Stage]) -> None:
    robot = stage(stale_after=0.3)
    robot.track()
    robot.plant.kill()
    robot.expect_ramp_down("the response stopped coming")


def test_the_same_design_again_in_mid_run_does_not_stop_it(
    stage: Callable[..., Stage], funnel: Path
) -> None:
    robot = stage()
    robot.track()
    heard = len(robot.designs)
    assert robot.set("funnel_publisher", "funnel", str(funnel)) == ""
    robot.spin_until(lambda: len(robot.designs) > heard)
    count = len(robot.commands)
    robot.spin_until(lambda: len(robot.commands) > count + 10)
    assert not robot.has_said("stop", NAME)


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
        design_funnel_files(folder / MODEL, settings, folder)
    robot = stage(funnel=used / FUNNEL)
    robot.track()
    assert robot.set("funnel_publisher", "funnel", str(other / FUNNEL)) == ""
    robot.expect_ramp_down("the design was replaced")


def test_limits_that_would_cut_off_the_plan_are_refused_and_nothing_moves(
    stage: Callable[..., Stage],
) -> None:
    robot = stage(highest=0.2)
    answer = robot.call(START)
    assert not answer.success
    assert "beyond the limits [0, 0.2]" in answer.message
    robot.hears("idle; not started: the plan's input", NAME)
    assert robot.commands == []


def test_an_interrupted_controller_ramps_down_before_it_goes(stage: Callable[..., Stage]) -> None:
    robot = stage()
    robot.track(above=0.2)
    stop(robot.controller, signal.SIGTERM)
    robot.expect_rest()


def test_an_unproved_policy_runs_in_its_mode_only_and_with_what_stops_the_robot(
    bench: Bench, tmp_path: Path
) -> None:
    field, policy, _ = continuous_stage()
    files.write_document(tmp_path / VECTOR_FIELD, field.document())
    files.write_document(tmp_path / POLICY, policy.document())
    joints = "sensor_msgs/msg/JointState"
    commands: dict[int, float] = {}
    stopped: list[bool] = []

    def hear_command(message: JointState) -> None:
        commands[stamp_ns_of(message)] = message.effort[0]

    def brake(_: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        stopped.append(True)
        answer.success = True
        return answer

    states = bench.node.create_publisher(JointState, "/joints", qos.STREAM)
    bench.listen(JointState, "/effort", hear_command)
    bench.start(
        NAME,
        commissioning=tmp_path,
        stop_service="/robot/stop",
        lowest=-20.0,
        highest=20.0,
        stop_rate=100.0,
        response="/joints:position[0]",
        command="/effort:effort[0]",
        period=0.05,
        response_type=joints,
        command_type=joints,
        stale_after=20.0,
    )
    answer = bench.call(START)
    assert not answer.success
    assert "/robot/stop is not there" in answer.message
    bench.node.create_service(Trigger, "/robot/stop", brake)
    bench.spin_until(lambda: bench.node.count_subscribers("/joints") >= 1)
    bench.spin_until(lambda: bool(bench.call(START).success))
    first_ns, x = time.time_ns(), 0.9  # far outside of where any funnel of it would be
    for k in range(-1, 10):
        stamp_ns = first_ns + (k + 1) * 50_000_000
        message = JointState(name=["cart"], position=[x])
        message.header.stamp = stamp_of(stamp_ns)
        states.publish(message)
        bench.spin_until(lambda s=stamp_ns: s in commands)  # type: ignore[misc]
        if k >= 0:
            assert commands[stamp_ns] == pytest.approx(float(policy(k * 0.05, [x])[0]))
            x += 0.05 * commands[stamp_ns]
    assert not stopped
    assert bench.call(STOP).success
    bench.spin_until(lambda: bool(stopped))
    bench.hears("tracking", NAME)
    texts = [text for text, _ in bench.said[NAME]]
    assert all(text.startswith("COMMISSIONING, not proved: ") for text in texts)
    assert bench.levels[NAME] == DiagnosticStatus.WARN
