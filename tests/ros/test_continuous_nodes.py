"""Continuous funnels published, driven and watched over DDS; the test is the robot, in step.

Those made by hand, alone and composed; the cart-pole's, proved for an input that is held; and the
other shipped examples. Only the 12-state quadrotor is not driven: its design takes minutes.
"""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from sensor_msgs.msg import JointState

from bags.designs.documents import load
from bags.designs.wiring import wiring_of
from examples import (
    cart_pole,
    pendulum,
    planar_quadrotor,
    satellite_funnel,
    torque_limited_pendulum,
)
from examples import satellite as tumbler
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, FunnelDesign, design
from nlsid_core.designs import COMPOSITION, FUNNEL
from nlsid_core.running.comparison import Centre
from nlsid_core.running.held import slowest
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of, stamp_of
from tests.continuous_stage import composed
from tests.ros.processes import Bench, ros_test

pytestmark = ros_test
CONTROLLER = "tracking_controller"
JOINTS = "sensor_msgs/msg/JointState"
STEPS = 4  # of Runge-Kutta in a sample
OUT = 0.3  # of V on the boundary, where a run starts
HOLD = 0.002  # s, of the cart-pole
Dynamics = Callable[[FloatArray, FloatArray], FloatArray]  # ẋ (N, n) of x and u
Sample = tuple[int, FloatArray, FloatArray]  # stamp in ns, state, and the input answered to it


@dataclass(frozen=True)
class Shipped:
    """An example's funnel, the true dynamics, and the samples in it.

    hold: s that an input is held for at most; 0: the proof does not say.
    """

    designed: Callable[[], FunnelDesign]
    truth: Dynamics
    samples: int
    hold: float = 0.0


def satellite() -> FunnelDesign:
    """The satellite's funnel, at fewer knots than the thesis has."""
    field, nominal, weights = satellite_funnel.problem(26)
    goal = satellite_funnel.goal_matrix()
    return design(ContinuousTracking(field, nominal, goal=goal, **weights))


def tumbling(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (N, 6) of the satellite."""
    rates = [tumbler.dynamics(a, b) for a, b in zip(x, u, strict=True)]
    return np.array(rates, dtype=np.float64)


SHIPPED = {
    "pendulum": Shipped(pendulum.designed, pendulum.truth, 100),
    "torque_limited_pendulum": Shipped(
        torque_limited_pendulum.designed, torque_limited_pendulum.truth, 200
    ),
    "planar_quadrotor": Shipped(planar_quadrotor.designed, planar_quadrotor.truth, 200),
    "satellite": Shipped(satellite, tumbling, 200),
    "cart_pole": Shipped(
        lambda: cart_pole.designed(HOLD), cart_pole.truth, round(2.0 / slowest(HOLD)), HOLD
    ),
}


def moved(truth: Dynamics, x: FloatArray, u: FloatArray, seconds: float) -> FloatArray:
    """The state so much later under held inputs."""
    h, U = seconds / STEPS, u[None]
    for _ in range(STEPS):
        a = truth(x[None], U)[0]
        b = truth((x + h / 2 * a)[None], U)[0]
        c = truth((x + h / 2 * b)[None], U)[0]
        d = truth((x + h * c)[None], U)[0]
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


class Joints(Bench):
    """A robot whose states (n,) are positions and whose inputs (m,) are efforts."""

    def __init__(self, stack: ExitStack, n: int, m: int, period: float) -> None:
        super().__init__(stack)
        self.period_ns = round(period * 1e9)
        self.period = self.period_ns / 1e9
        self.x: FloatArray = np.zeros(n)  # the newest state
        self.commands: dict[int, FloatArray] = {}
        self.margins: dict[int, float] = {}
        self.states = self.node.create_publisher(JointState, "/joints", qos.STREAM)
        self.listen(JointState, "/effort", self._hear_command)
        self.listen(JointState, "/funnel_monitor/margin", self._hear_margin)
        self.wiring: dict[str, object] = {
            "response": ", ".join(f"/joints:position[{i}]" for i in range(n)),
            "command": ", ".join(f"/effort:effort[{i}]" for i in range(m)),
            "period": self.period,
            "stale_after": 60.0,
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

    def run(self, x: FloatArray, truth: Dynamics) -> list[Sample]:
        """Track to the end of the proof: the samples that were judged."""
        self.hears("idle", CONTROLLER)
        watching = {"controller": CONTROLLER, "command_wait": 1.0}
        self.start("funnel_monitor", **self.wiring, **watching)
        self.spin_until(lambda: self.node.count_subscribers("/joints") >= 2)
        self.spin_until(lambda: self.node.count_subscribers("/effort") >= 2)
        assert self.call(f"/{CONTROLLER}/start").success
        stamp_ns, samples = time.time_ns(), list[Sample]()
        while True:
            self.x = x
            message = JointState(name=[f"x{i}" for i in range(len(x))], position=x.tolist())
            message.header.stamp = stamp_of(stamp_ns)
            self.states.publish(message)
            self.spin_until(
                lambda s=stamp_ns: s in self.commands or self.has_said("stopp", CONTROLLER)  # type: ignore[misc]
            )
            if stamp_ns not in self.commands:
                break
            u = self.commands[stamp_ns]
            samples.append((stamp_ns, x, u))
            if len(samples) > 1:  # the run starts with the second state that is heard
                x = moved(truth, x, u, self.period)
            stamp_ns += self.period_ns
        self.hears("idle; stopped: the proof is over", CONTROLLER)
        judged = samples[1:]
        self.spin_until(lambda: {stamp for stamp, *_ in judged} <= self.margins.keys())
        return judged

    def assumed(self) -> set[str]:
        """What the monitor said that its verdicts assume."""
        return {values["assuming"] for _, values in self.said["funnel_monitor"]} - {""}


@pytest.mark.parametrize("stages", [1, 2])
def test_a_continuous_funnel_is_driven_and_every_margin_is_that_of_the_core(
    stages: int, stack: ExitStack, tmp_path: Path
) -> None:
    """Two stages: a composition, of which controller and monitor say which stage is on."""
    path = composed(tmp_path) / COMPOSITION
    if stages == 1:
        path = tmp_path / "from 0" / FUNNEL
    robot = Joints(stack, 1, 1, 0.05)
    robot.controlled(path)
    judged = robot.run(np.array([0.1]), lambda _x, u: u)
    assert len(judged) == pytest.approx(20 * stages, abs=1)
    wiring = wiring_of(["/joints:position[0]"], ["/effort:effort[0]"], 0.05)
    monitor = load(path, wiring=wiring).monitor(Centre.PROFILE)
    margins = [monitor.update(k * 5 / 100, x, u).margin for k, (_, x, u) in enumerate(judged)]
    assert [robot.margins[stamp] for stamp, *_ in judged] == margins, "bit for bit"
    assert min(margins) > 0.3
    assert not any(map(math.isnan, margins))
    held = "the policy is applied continuously; here each input is held for 0.05 s"
    if stages == 1:
        assert robot.assumed() == {held}
    else:
        assert robot.assumed() == {f"stage {i} of 2: {held}" for i in (1, 2)}
        assert [robot.has_said(f"tracking, stage {i} of 2", CONTROLLER) for i in (1, 2)]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_funnel_is_driven_to_its_goal_over_dds(
    name: str, stack: ExitStack, tmp_path: Path
) -> None:
    shipped = SHIPPED[name]
    found = shipped.designed()
    found.save(tmp_path)
    n, m, funnel = found.model.n, found.model.m, found.funnel
    robot = Joints(stack, n, m, float(funnel.tf - funnel.t0) / shipped.samples)
    robot.controlled(tmp_path / FUNNEL)
    edge = np.linalg.cholesky(np.linalg.inv(funnel.shape(funnel.t0)))
    out = np.random.default_rng(3).standard_normal(n)
    start = funnel.x(funnel.t0) + OUT**0.5 * edge @ out / np.linalg.norm(out)
    judged = robot.run(start, shipped.truth)
    assert len(judged) == pytest.approx(shipped.samples, abs=2)
    assert min(robot.margins[stamp] for stamp, *_ in judged) > 0.0
    gap = robot.x - funnel.x(funnel.tf)
    assert gap @ funnel.shape(funnel.tf) @ gap < 1.0, "in the goal's part that the funnel ends in"
    if shipped.hold:
        old = f"each input is at most {shipped.hold:g} s old"
        assert robot.assumed() == {f"{old}, and w stays in its box"}


def test_samples_that_come_too_slowly_for_the_proof_are_refused_by_name(
    stack: ExitStack, tmp_path: Path
) -> None:
    cart_pole.designed(HOLD).save(tmp_path)
    robot = Joints(stack, 4, 1, 0.01)
    robot.controlled(tmp_path / FUNNEL)
    slow = "samples come every 0.01 s, and the funnel is proved for inputs of at most 0.002 s"
    robot.hears(slow, CONTROLLER)
