"""The excitation node over DDS: within its limits, repeated exactly, stopped when asked."""

import json
import math
import signal
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from std_msgs.msg import String

from bags.signals.reader import bag_origin
from nlsid import Grid, read_bags
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.designs import VECTOR_FIELD
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.continuous_stage import stage
from tests.ros.processes import Bench, ros_test, service, stop

pytestmark = ros_test

LIMITS: dict[str, object] = {"lowest": -0.1, "highest": 0.4, "slew": 2.0, "fade": 0.2}


class Excited(Bench):
    """Hears (sent: stamp in ns, command) the excitation that runs in a process."""

    def __init__(self, stack: ExitStack, **parameters: object) -> None:
        super().__init__(stack)
        self.sent: list[tuple[int, float]] = []
        self.did: list[str] = []
        self.listen(TwistStamped, "/cmd_vel", self._on_command)
        self.listen(String, "/excitation/experiment", self._on_experiment, qos.DOCUMENT)
        self.running = self.start("excitation", **(LIMITS | parameters))
        self.hears("idle", "excitation")
        self.spin_until(lambda: self.node.count_publishers("/cmd_vel") == 1)

    def _on_command(self, message: TwistStamped) -> None:
        self.sent.append((stamp_ns_of(message), message.twist.linear.x))

    def _on_experiment(self, message: String) -> None:
        self.did.append(message.data)

    def inputs(self) -> FloatArray:
        """The commands that were sent."""
        return np.array([u for _, u in self.sent])

    def begin(self, above: float = -math.inf) -> None:
        """Begin, and wait for a command that is large enough."""
        self.waits(0.5)
        assert not self.sent, "nothing moves before it is asked to"
        assert self.call("/excitation/start").success
        self.spin_until(lambda: bool(self.sent) and self.sent[-1][1] > above)

    def end(self) -> None:
        """Wait until it has said how it ended, and the robot rests."""
        self.spin_until(lambda: bool(self.did) and "ended" in json.loads(self.did[-1]))
        self.spin_until(lambda: self.sent[-1][1] == 0.0)
        self.waits(0.5)


def test_repeats_are_the_same_signal_within_the_limits(stack: ExitStack) -> None:
    parameters: dict[str, object] = {
        "period": 0.02,
        "duration": 2.0,
        "pause": 0.5,
        "repeats": 2,
        "lowest_hz": 0.5,
        "highest_hz": 3.0,
    }
    robot = Excited(stack, **parameters)
    robot.begin()
    robot.end()
    stamps, inputs = np.array([s for s, _ in robot.sent]), robot.inputs()
    assert (np.diff(stamps) == 20_000_000).all(), "on an exact grid"
    half = len(inputs) // 2
    assert half >= 125
    np.testing.assert_array_equal(inputs[:half], inputs[half:])
    assert inputs.min() >= -0.1
    assert inputs.max() <= 0.4
    assert np.ptp(inputs) > 0.3
    assert np.abs(np.diff(inputs)).max() <= 2.0 * 0.02 * (1 + 1e-9)
    assert inputs[-1] == 0.0
    said = [json.loads(text) for text in robot.did]
    assert [(each["repeat"], each.get("ended", "")) for each in said] == [
        (1, ""),
        (2, ""),
        (2, "done"),
    ]
    assert {each["repeat_group"] for each in said} == {said[0]["repeat_group"]}
    assert said[0]["repeat_group"].startswith("/cmd_vel:twist.linear.x, multisine, sha256:")
    named = said[0]["kind"], said[0]["repeats"], said[0]["limits"]["highest"]
    assert named == ("multisine", 2, 0.4)


@pytest.mark.parametrize("kind", ["chirp", "prbs", "steps"])
def test_every_kind_stays_within_the_limits(kind: str, stack: ExitStack) -> None:
    parameters: dict[str, object] = {
        "kind": kind,
        "period": 0.02,
        "duration": 2.0,
        "pause": 0.1,
        "hold": 0.1,
        "lowest_hz": 1.0,
        "highest_hz": 4.0,
    }
    robot = Excited(stack, **parameters)
    robot.begin()
    robot.end()
    inputs = robot.inputs()
    assert len(inputs) >= 80
    assert -0.1 <= inputs.min() < 0.0
    assert 0.2 < inputs.max() <= 0.4
    assert np.abs(np.diff(inputs, prepend=0.0)).max() <= 2.0 * 0.02 * (1 + 1e-9)
    assert inputs[-1] == 0.0


def test_asked_to_stop_it_returns_to_rest_no_faster_than_allowed(stack: ExitStack) -> None:
    robot = Excited(stack, kind="steps", period=0.02, pause=0.0, hold=1.0, slew=0.2)
    robot.begin(above=0.2)
    assert robot.call("/excitation/stop").success
    assert "on its way to rest" in robot.call("/excitation/start").message
    robot.end()
    assert json.loads(robot.did[-1])["ended"] == "stopped when asked to"
    assert json.loads(robot.did[-1])["repeat_group"] == "", "half a repeat is none"
    assert np.abs(np.diff(robot.inputs())).max() <= 0.2 * 0.02 * (1 + 1e-9)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ended_by_a_signal_it_leaves_the_robot_at_rest(
    how: signal.Signals, stack: ExitStack
) -> None:
    robot = Excited(stack, kind="steps", period=0.02, pause=0.0, lowest=0.3, rest=0.3)
    robot.begin(above=0.35)
    robot.running.send_signal(how)
    robot.spin_until(lambda: robot.running.poll() is not None and robot.sent[-1][1] == 0.3)
    assert robot.running.returncode == 0
    assert np.abs(np.diff(robot.inputs())).max() <= 2.0 * 0.02 * (1 + 1e-9)


def test_held_up_for_a_while_it_ends_and_does_not_set_the_robot_in_motion_again(
    stack: ExitStack,
) -> None:
    """What is late is not played on; a base that stops when no command comes rests by then."""
    robot = Excited(stack, kind="steps", period=0.02, pause=0.0)
    robot.begin(above=0.2)
    robot.running.send_signal(signal.SIGSTOP)
    robot.waits(1.5)
    before = len(robot.sent)
    robot.running.send_signal(signal.SIGCONT)
    robot.hears("before this node's clock; 0.1 s are allowed", "excitation")
    robot.spin_until(lambda: len(robot.sent) > before)
    assert set(robot.inputs()[before:]) == {0.0}
    assert robot.levels["excitation"] == DiagnosticStatus.ERROR


def test_what_is_not_the_signal_is_passed_through_from_a_topic_or_nothing_moves(
    stack: ExitStack,
) -> None:
    """Steps of speed while another node steers; when that one stops, the robot goes to rest."""
    robot, turned = Excited(stack, kind="steps", period=0.02, pause=0.0, others="/teleop"), set()
    robot.listen(TwistStamped, "/cmd_vel", lambda message: turned.add(message.twist.angular.z))
    steering = robot.node.create_publisher(TwistStamped, "/teleop", qos.STREAM)
    robot.spin_until(lambda: robot.node.count_subscribers("/teleop") == 1)
    refused = robot.call("/excitation/start")
    assert refused.message == "nothing on /teleop for 1 s, which has the other fields"
    message = TwistStamped()
    message.twist.linear.x, message.twist.angular.z = 9.0, 0.7
    timer = robot.node.create_timer(0.1, lambda: steering.publish(message))
    robot.begin(above=0.2)
    timer.cancel()
    robot.end()
    assert turned == {0.7}
    assert robot.inputs().max() <= 0.4
    assert json.loads(robot.did[-1])["ended"].startswith("nothing on /teleop for 1 s")


COMMAND, RESPONSE = "/joint_commands:effort[0]", "/joint_states:position[0]"
JOINTS: dict[str, object] = {"lowest": -0.3, "highest": 0.3, "slew": 5.0, "fade": 0.2}
SIGNAL: dict[str, object] = {"period": 0.01, "duration": 2.0, "pause": 0.8, "highest_hz": 4.0}
SIGNAL |= {"command": COMMAND, "command_type": "sensor_msgs/msg/JointState"}


def test_each_repeat_has_a_bag_of_its_own_and_identification_knows_them_as_repeats(
    bench: Bench, tmp_path: Path
) -> None:
    """The robot's position is the integral of the effort."""
    bags, field = tmp_path / "trials", tmp_path / VECTOR_FIELD
    bags.mkdir()
    files.write_document(field, stage()[0].document())
    topics = "[/joint_states, /joint_commands]"
    kind, types = "sensor_msgs/msg/JointState", ("response_type", "command_type")
    wiring = {"response": RESPONSE, "command": COMMAND} | dict.fromkeys(types, kind)
    bench.start("plant", model=field, state="'0.0'", **wiring)
    recorder = bench.start("trajectory_recorder", topics=topics, bag=bags / "trial", at_once=False)
    bench.start("excitation", **(JOINTS | SIGNAL), repeats=3, recorder="trajectory_recorder")
    wanted = {"/joint_states": 1, "/joint_commands": 2}
    bench.spin_until(lambda: {t: bench.node.count_subscribers(t) for t in wanted} == wanted)
    bench.hears("idle", "excitation")
    bench.spin_until(lambda: bench.call("/excitation/start").success)
    bench.hears("done", "excitation")
    stop(recorder)

    trials = [bags / name for name in ("trial", "trial_2", "trial_3")]
    assert sorted(bags.iterdir()) == trials
    for number, trial in enumerate(trials, start=1):
        custom = bag_origin(trial)["custom"]
        assert json.loads(custom["experiment"])["repeat"] == number
        assert int(custom["/joint_commands received"]) >= 230
        assert custom["/joint_commands lost"] == "0"
    data = read_bags(
        trials,
        responses=[RESPONSE],
        excitations=[COMMAND],
        grid=Grid(0.01, max_gap=0.5, resample="linear"),
    )
    [(group, members)] = data.repeats().items()
    assert group.startswith("/joint_commands:effort[0], multisine, sha256:")
    assert len(members) == 3
    assert all(np.ptp(member.u) > 0.3 and np.ptp(member.y) > 0.01 for member in members)
    first = members[0].u[:, 0]
    for member in members[1:]:
        common = min(len(first), len(member))
        assert abs(len(first) - len(member)) <= 3
        assert np.corrcoef(first[:common], member.u[:common, 0])[0, 1] > 0.98


@pytest.mark.parametrize("recorder", ["none", "busy", "does not answer"])
def test_a_recorder_that_gives_no_bag_stops_the_experiment_before_it_moves(
    bench: Bench, recorder: str, tmp_path: Path
) -> None:
    name, at_once = "trajectory_recorder", recorder == "busy"
    if recorder != "none":
        process = bench.start(name, topics="[/joints]", bag=tmp_path / "own", at_once=at_once)
        bench.hears("", name)
    bench.start("excitation", **(JOINTS | SIGNAL), recorder=name)
    bench.hears("idle", "excitation")
    start = service(bench.node, bench.spin_until, "/excitation/start")
    if recorder == "none":
        answer = bench.call("/excitation/start")
        assert "there is no recorder trajectory_recorder" in answer.message
        return
    bench.spin_until(lambda: bench.said["excitation"][-1][1]["recorder"] == "ready")
    if recorder == "does not answer":
        process.send_signal(signal.SIGSTOP)
    bench.spin_until(lambda: bench.call("/excitation/start").success)
    says = "no bag from the recorder: recording" if at_once else "has not answered for 10 s"
    bench.hears(says, "excitation")
    assert bench.levels["excitation"] == DiagnosticStatus.ERROR
    process.send_signal(signal.SIGCONT)
    assert start.service_is_ready(), "it goes on"
