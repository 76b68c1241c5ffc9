"""Design, publish, track, monitor: the loop closed over DDS, pushed gently and too hard."""

import math
import signal
import time
from contextlib import ExitStack
from itertools import count
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from bags.designs import documents
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status
from nlsid_ros import qos
from tests.ros.processes import STARTED, node_here, process, ros_test, stop

pytestmark = ros_test
PERIOD_NS = 25_000_000
TOPICS = "['/odom', '/cmd_vel', '/tracking_controller/run', '/funnel_monitor/events']"


def time_of(stamp_ns: int) -> Time:
    """A stamp as messages have it."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    return Time(sec=sec, nanosec=nanosec)


class Loop:
    """What was heard of one run."""

    def __init__(self) -> None:
        self.margins: dict[int, tuple[float, ...]] = {}
        self.latencies: list[float] = []
        self.said: dict[str, list[str]] = {}

    def hear_margin(self, message: JointState) -> None:
        """Remember the numbers by stamp."""
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        self.margins[stamp_ns] = tuple(message.position)
        self.latencies.append(message.position[list(message.name).index("latency")])

    def hear_status(self, message: DiagnosticArray) -> None:
        """Remember every text by node."""
        for status in message.status:
            self.said.setdefault(status.name, []).append(status.message)

    def has_said(self, node: str, text: str) -> bool:
        """Whether `node` has said something with `text`."""
        return any(text in said for said in self.said.get(node, []))


def run_loop(funnel: Path, bag: Path, *, push: float, simulated: bool = False) -> Loop:
    """One run of the policy on the plant, pushed 1 s after it started tracking.

    simulated: /clock ticks once a sample, so that commands have the stamps of samples.
    """
    loop = Loop()
    model = funnel.with_name(documents.MODEL)
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_operator"))
        node.create_subscription(JointState, "/funnel_monitor/margin", loop.hear_margin, qos.STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", loop.hear_status, qos.EVENTS)
        clock, ticks = node.create_publisher(Clock, "/clock", qos.STREAM), count(10**18, PERIOD_NS)
        if simulated:
            node.create_timer(
                PERIOD_NS * 1e-9, lambda: clock.publish(Clock(clock=time_of(next(ticks))))
            )
        start = node.create_client(Trigger, "/tracking_controller/start")
        pushing = node.create_client(Trigger, "/plant/push")
        nodes: dict[str, dict[str, object]] = {
            "trajectory_recorder": {"topics": TOPICS, "bag": bag, "snapshot": 10.0},
            "funnel_publisher": {"funnel": funnel},
            "funnel_monitor": {
                "nominal": "profile",
                "controller": "tracking_controller",
                "stop_service": "/tracking_controller/stop",
                "snapshot_service": "/trajectory_recorder/snapshot",
                "command_wait": 0.5,  # the machine may be busy with other tests
                "stale_after": 1.0,
            },
            "tracking_controller": {"highest": 0.4, "stale_after": 1.0},
            "plant": {"model": model, "noise": 0.002, "push": push},
        }
        running = [
            stack.enter_context(process(f"nlsid_ros.{name}", **parameters, use_sim_time=simulated))
            for name, parameters in nodes.items()
        ]
        spin_until(lambda: start.service_is_ready() and pushing.service_is_ready())
        spin_until(lambda: loop.has_said("tracking_controller", "idle"))
        listeners = {"/cmd_vel": 3, "/odom": 3}  # recorder, monitor, and the one it is for
        spin_until(lambda: all(node.count_subscribers(t) >= n for t, n in listeners.items()))
        spin_until(lambda: loop.has_said("funnel_monitor", "waiting for the controller"))
        matched = time.monotonic() + 1.0  # the graph knows a recorder before the plant does
        spin_until(lambda: time.monotonic() > matched)
        start.call_async(Trigger.Request())
        spin_until(lambda: loop.has_said("funnel_monitor", "inside"))
        pushed_at = time.monotonic() + 1.0
        spin_until(lambda: time.monotonic() > pushed_at)
        pushing.call_async(Trigger.Request())
        spin_until(lambda: loop.has_said("tracking_controller", "idle; stopped"))
        over = ("the run has ended", "outside")
        spin_until(lambda: any(loop.has_said("funnel_monitor", text) for text in over))
        for each in running:
            stop(each)
    return loop


def live_and_replayed(
    funnel: Path, bag: Path, loop: Loop
) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]]:
    """The numbers (margin, ...) of every judged sample, heard live and replayed."""
    replay = replay_bag(documents.load(funnel), bag, centre=Centre.PROFILE)
    judged = {
        stamp_ns: tuple(reading.numbers.values())
        for stamp_ns, reading in zip(replay.stamps_ns, replay.readings, strict=True)
        if reading.status is not Status.UNKNOWN
    }
    live = {s: v[:-2] for s, v in loop.margins.items() if not math.isnan(v[0])}  # width, latency
    common = sorted(judged.keys() & live.keys())
    assert len(common) >= 0.9 * len(live) > 0
    return [live[s] for s in common], [judged[s] for s in common]


@pytest.mark.parametrize("simulated", [False, True])
def test_a_gentle_push_is_tracked_through_and_the_run_ends_inside(
    funnel: Path, tmp_path: Path, simulated: bool
) -> None:
    loop = run_loop(funnel, tmp_path / "gentle", push=0.05, simulated=simulated)
    assert loop.has_said("tracking_controller", "idle; stopped: the plan is over"), loop.said
    assert not loop.has_said("funnel_monitor", "outside")
    assert not loop.has_said("funnel_monitor", "violated")
    assert loop.has_said("funnel_monitor", "unknown: the run has ended: the plan is over")
    live, replayed = live_and_replayed(funnel, tmp_path / "gentle", loop)
    assert len(live) == 117
    assert live == replayed, "bit for bit"
    assert min(margins[0] for margins in live) > 0.3
    assert 0.0 <= np.median(loop.latencies) < 0.5, "s from stamp to margin, as it says itself"
    assert not (tmp_path / "gentle_snapshot_1").exists()


def test_a_hard_push_is_called_out_and_the_robot_is_stopped(funnel: Path, tmp_path: Path) -> None:
    loop = run_loop(funnel, tmp_path / "hard", push=0.6)
    assert loop.has_said("tracking_controller", "idle; stopped: asked to")
    assert loop.has_said("funnel_monitor", "above the level")
    assert loop.has_said("funnel_monitor", "outside the tube")
    live, replayed = live_and_replayed(funnel, tmp_path / "hard", loop)
    assert live == replayed, "bit for bit"
    assert min(margins[0] for margins in live) < 0
    with Bag(tmp_path / "hard") as bag:
        events = b"".join(m.data for m in bag.messages(["/funnel_monitor/events"]))
    assert b"above the level" in events
    with Bag(tmp_path / "hard_snapshot_1") as snapshot:
        assert snapshot.count("/odom") > 40, "what led there was kept"


def test_an_interrupted_controller_ramps_down_before_it_goes(funnel: Path) -> None:
    commands: list[float] = []

    def hear(message: TwistStamped) -> None:
        commands.append(message.twist.linear.x)

    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_operator"))
        node.create_subscription(TwistStamped, "/cmd_vel", hear, qos.STREAM)
        start = node.create_client(Trigger, "/tracking_controller/start")
        stack.enter_context(process("nlsid_ros.funnel_publisher", funnel=funnel))
        stack.enter_context(process("nlsid_ros.plant", model=funnel.with_name(documents.MODEL)))
        settings: dict[str, object] = {"highest": 0.4, "stop_rate": 2.0}
        running = stack.enter_context(process("nlsid_ros.tracking_controller", **settings))
        spin_until(start.service_is_ready)
        spin_until(lambda: node.count_publishers("/cmd_vel") == 1)
        start.call_async(Trigger.Request())
        spin_until(lambda: bool(commands) and commands[-1] > 0.2)
        running.send_signal(signal.SIGTERM)
        spin_until(lambda: commands[-1] == 0.0)
        assert running.wait(timeout=STARTED) == 0
    falling = np.diff(commands[commands.index(max(commands)) :])
    assert float(np.min(falling)) >= -2.0 * 0.025 * (1 + 1e-9)
    assert len(falling) >= 4
