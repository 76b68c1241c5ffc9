"""Continuous funnels published, driven and watched over DDS; the test is the robot, in step.

The cart-pole's is proved for an input that is held, and is driven at stamps off the grid; one that
is proved for a policy that acts continuously, alone or composed, is not driven.
"""

import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from bags.designs.wiring import wiring_of
from examples import cart_pole
from nlsid import Status, load
from nlsid_core.arrays import FloatArray
from nlsid_core.designs import COMPOSITION, FUNNEL
from nlsid_core.running.comparison import Centre
from nlsid_core.running.plants import advanced
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of, stamp_of
from tests.continuous_stage import composed
from tests.ros.processes import Bench, ros_test

pytestmark = ros_test
CONTROLLER, START = "tracking_controller", "/tracking_controller/start"
JOINTS = "sensor_msgs/msg/JointState"
STEPS = 4  # of Runge-Kutta in a sample
OUT = 0.3  # of V on the boundary, where a run starts
HOLD = 0.002  # s, of the cart-pole
PERIOD = HOLD / 1.85  # s: twice as far off the grid as JITTER is less than the hold
JITTER = 0.4  # of a period, how far a stamp is off the grid
Sample = tuple[int, FloatArray, FloatArray]  # stamp in ns, state, and the input answered to it


def moved(x: FloatArray, u: FloatArray, seconds: float) -> FloatArray:
    """The cart-pole's state so much later under a held input."""
    for _ in range(STEPS):
        x = advanced(lambda x: cart_pole.truth(x[None], u[None])[0], x, seconds / STEPS)
    return x


class Joints(Bench):
    """A robot whose states (n,) are positions and whose inputs are efforts, in simulated time."""

    def __init__(self, stack: ExitStack, n: int, period: float) -> None:
        super().__init__(stack)
        self.commands: dict[int, FloatArray] = {}
        self.margins: dict[int, float] = {}
        self.states = self.node.create_publisher(JointState, "/joints", qos.STREAM)
        self.clock = self.node.create_publisher(Clock, "/clock", qos.STREAM)
        self.listen(JointState, "/effort", self._hear_command)
        self.listen(JointState, "/funnel_monitor/margin", self._hear_margin)
        self.response = [f"/joints:position[{i}]" for i in range(n)]
        self.wiring: dict[str, object] = {
            "response": ", ".join(self.response),
            "command": "/effort:effort[0]",
            "period": period,
            "stale_after": 60.0,
            "use_sim_time": True,
        }

    def _hear_command(self, message: JointState) -> None:
        self.commands[stamp_ns_of(message)] = np.array(message.effort)

    def _hear_margin(self, message: JointState) -> None:
        index = list(message.name).index("margin")
        self.margins[stamp_ns_of(message)] = message.position[index]

    def controlled(self, funnel: Path) -> None:
        """Start publisher and controller; each decides the proof, in turn."""
        types = {"response_type": JOINTS, "command_type": JOINTS}
        limits = {"lowest": -1000.0, "highest": 1000.0, "stop_rate": 10000.0}
        self.start("funnel_publisher", funnel=funnel)
        self.hears("PROVED", "funnel_publisher")
        self.start(CONTROLLER, **self.wiring, **types, **limits)

    def sends(self, stamp_ns: int, x: FloatArray) -> None:
        """Publish the time and a state of it."""
        self.clock.publish(Clock(clock=stamp_of(stamp_ns)))
        message = JointState(name=[f"x{i}" for i in range(len(x))], position=x.tolist())
        message.header.stamp = stamp_of(stamp_ns)
        self.states.publish(message)

    def run(self, x: FloatArray, stamps: list[int]) -> list[Sample]:
        """Begin a run and track to its end, at these stamps (ns): the samples that were judged."""
        self.hears("idle", CONTROLLER)
        watching = {"controller": CONTROLLER, "command_wait": 1.0}
        self.start("funnel_monitor", **self.wiring, **watching)
        topics = "/joints", "/effort", "/clock"
        self.spin_until(lambda: min(map(self.node.count_subscribers, topics)) >= 2)
        assert self.call(START).success
        samples = list[Sample]()
        for stamp_ns, after_ns in pairwise(stamps):
            self.sends(stamp_ns, x)
            self.spin_until(
                lambda s=stamp_ns: s in self.commands or self.has_said("stopp", CONTROLLER)  # type: ignore[misc]
            )
            if stamp_ns not in self.commands or self.has_said("stopp", CONTROLLER):
                break
            u = self.commands[stamp_ns]
            samples.append((stamp_ns, x, u))
            if len(samples) > 1:  # the run starts with the second state that is heard
                x = moved(x, u, (after_ns - stamp_ns) * 1e-9)
        judged = samples[1:]
        self.spin_until(lambda: {stamp for stamp, *_ in judged} <= self.margins.keys())
        return judged


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The cart-pole's design, held."""
    cart_pole.designed(HOLD).save(tmp_path)
    return tmp_path


def off_the_grid(seconds: float) -> list[int]:
    """Stamps (ns) of now, PERIOD apart, each off by up to JITTER of it."""
    k = np.arange(round(seconds / PERIOD))
    off = np.random.default_rng(4).uniform(-JITTER, JITTER, len(k))
    start_ns = time.time_ns()
    return [start_ns + round(place) for place in (k + off) * PERIOD * 1e9]


def edge(folder: Path) -> FloatArray:
    """A state at which the cart-pole's run may start, OUT of the way to the boundary."""
    funnel = load(folder / FUNNEL, wiring=None).funnel
    out = np.random.default_rng(3).standard_normal(funnel.n)
    towards = np.linalg.cholesky(np.linalg.inv(funnel.shape(funnel.t0))) @ out
    return np.asarray(funnel.x(funnel.t0) + OUT**0.5 * towards / np.linalg.norm(out))


def test_a_held_funnel_is_driven_to_its_goal_at_stamps_off_the_grid(
    stack: ExitStack, folder: Path
) -> None:
    robot = Joints(stack, 4, PERIOD)
    robot.controlled(folder / FUNNEL)
    judged = robot.run(edge(folder), off_the_grid(2.2))
    robot.hears("idle; stopped: the proof is over", CONTROLLER)
    wiring = wiring_of(robot.response, ["/effort:effort[0]"], PERIOD)
    monitor = load(folder / FUNNEL, wiring=wiring).monitor(Centre.PROFILE)
    start_ns = judged[0][0]
    readings = [monitor.update((stamp - start_ns) / 1e9, x, u) for stamp, x, u in judged]
    assert {reading.status for reading in readings} == {Status.INSIDE}
    assert [robot.margins[stamp] for stamp, *_ in judged] == [r.margin for r in readings]
    assert judged[-1][0] - start_ns == pytest.approx(2e9, abs=3 * HOLD * 1e9)
    assumed = f"each input is at most {HOLD:g} s old, and w stays in its box"
    assert {each["assuming"] for _, each in robot.said["funnel_monitor"]} == {"", assumed}


@pytest.mark.parametrize(
    ("later", "why"),
    [(1.5 * HOLD, f"s old; proved for {HOLD:g} s"), (-5.0, "this node's clock went back by")],
)
def test_a_run_ends_when_its_input_answers_an_older_state_than_is_proved_or_nobody_knows(
    later: float, why: str, stack: ExitStack, folder: Path
) -> None:
    robot = Joints(stack, 4, PERIOD)
    robot.controlled(folder / FUNNEL)
    judged = robot.run(edge(folder), off_the_grid(0.05))
    assert not robot.has_said("stopp", CONTROLLER)
    robot.clock.publish(Clock(clock=stamp_of(judged[-1][0] + round(later * 1e9))))
    robot.hears(why, CONTROLLER)


@pytest.mark.parametrize("file", [COMPOSITION, FUNNEL])
def test_what_is_proved_for_a_policy_that_acts_continuously_is_not_driven(
    file: str, stack: ExitStack, tmp_path: Path
) -> None:
    whole = composed(tmp_path)
    robot = Joints(stack, 1, 0.05)
    robot.controlled((whole if file == COMPOSITION else tmp_path / "from 0") / file)
    robot.hears("idle", CONTROLLER)
    assert "design it with a hold" in robot.call(START).message
    assert robot.commands == {}


def test_samples_that_come_too_slowly_for_the_proof_are_refused_by_name(
    stack: ExitStack, folder: Path
) -> None:
    robot = Joints(stack, 4, 0.01)
    robot.controlled(folder / FUNNEL)
    robot.hears("every 0.01 s, and the funnel is proved for inputs of at most 0.002 s", CONTROLLER)
