"""Every shipped example of a continuous funnel, published, driven and watched over DDS.

This test is the robot: the example's true dynamics, in step with the controller. The cart-pole is
in test_held_funnels.py. Only the 12-state quadrotor is not driven: its design takes minutes.
"""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from examples import pendulum, planar_quadrotor, satellite_funnel, torque_limited_pendulum
from examples import satellite as tumbler
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, FunnelDesign, design
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.ros.processes import node_here, process, ros_test

pytestmark = ros_test
STEPS = 4  # of Runge-Kutta in a sample
OUT = 0.3  # of V on the boundary, where the run starts
JOINTS = "sensor_msgs/msg/JointState"


@dataclass(frozen=True)
class Shipped:
    """An example's funnel, the true dynamics ẋ (N, n) of x and u, and samples in it."""

    designed: Callable[[], FunnelDesign]
    truth: Callable[[FloatArray, FloatArray], FloatArray]
    samples: int


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
}


def moved(shipped: Shipped, x: FloatArray, u: FloatArray, seconds: float) -> FloatArray:
    """The state so much later under held inputs."""
    h, U = seconds / STEPS, u[None]
    for _ in range(STEPS):
        a = shipped.truth(x[None], U)[0]
        b = shipped.truth((x + h / 2 * a)[None], U)[0]
        c = shipped.truth((x + h / 2 * b)[None], U)[0]
        d = shipped.truth((x + h * c)[None], U)[0]
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_funnel_is_driven_to_its_goal_over_dds(name: str, tmp_path: Path) -> None:
    shipped = SHIPPED[name]
    found = shipped.designed()
    found.save(tmp_path)
    n, m, funnel = found.model.n, found.model.m, found.funnel
    seconds = float(funnel.tf - funnel.t0)
    period_ns = round(seconds / shipped.samples * 1e9)
    commands: dict[int, list[float]] = {}
    margins: dict[int, float] = {}
    said: dict[str, list[str]] = {}

    def hear_command(message: JointState) -> None:
        commands[stamp_ns_of(message)] = list(message.effort)

    def hear_margin(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[list(message.name).index("margin")]

    def hear_status(message: DiagnosticArray) -> None:
        for entry in message.status:
            said.setdefault(entry.name, []).append(entry.message)

    def has_said(node: str, text: str) -> bool:
        return any(text in line for line in said.get(node, []))

    wiring: dict[str, Any] = {
        "response": ", ".join(f"/joints:position[{i}]" for i in range(n)),
        "command": ", ".join(f"/effort:effort[{i}]" for i in range(m)),
        "period": period_ns / 1e9,
        "stale_after": 60.0,
    }
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))
        states = node.create_publisher(JointState, "/joints", qos.STREAM)
        node.create_subscription(JointState, "/effort", hear_command, qos.STREAM)
        node.create_subscription(JointState, "/funnel_monitor/margin", hear_margin, qos.STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", hear_status, qos.EVENTS)
        start = node.create_client(Trigger, "/tracking_controller/start")
        types = {"response_type": JOINTS, "command_type": JOINTS}
        limits = {"lowest": -1000.0, "highest": 1000.0, "stop_rate": 10000.0}
        watching = {"controller": "tracking_controller", "command_wait": 1.0}
        path = tmp_path / "funnel.json"
        stack.enter_context(process("nlsid_ros.funnel_publisher", funnel=str(path)))
        spin_until(lambda: has_said("funnel_publisher", "PROVED"))
        stack.enter_context(process("nlsid_ros.tracking_controller", **wiring, **types, **limits))
        spin_until(lambda: has_said("tracking_controller", "idle") and start.service_is_ready())
        stack.enter_context(process("nlsid_ros.funnel_monitor", **wiring, **watching))
        spin_until(lambda: node.count_subscribers("/joints") >= 2)
        spin_until(lambda: node.count_subscribers("/effort") >= 2)
        answer = start.call_async(Trigger.Request())
        spin_until(answer.done)
        assert answer.result().success
        edge = np.linalg.cholesky(np.linalg.inv(funnel.shape(funnel.t0)))
        out = np.random.default_rng(3).standard_normal(n)
        x = funnel.x(funnel.t0) + OUT**0.5 * edge @ out / np.linalg.norm(out)
        first_ns, k = time.time_ns(), 0
        while not has_said("tracking_controller", "idle; stopped"):
            stamp_ns = first_ns + k * period_ns
            message = JointState(name=[f"x{i}" for i in range(n)], position=x.tolist())
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            states.publish(message)
            spin_until(
                lambda s=stamp_ns: s in commands or has_said("tracking_controller", "stopp")  # type: ignore[misc]
            )
            if stamp_ns not in commands:
                break
            u = np.array(commands[stamp_ns])
            x, k = moved(shipped, x, u, period_ns / 1e9) if k else x, k + 1
        spin_until(lambda: has_said("tracking_controller", "idle; stopped: the proof is over"))
        judged = [first_ns + (i + 1) * period_ns for i in range(k - 1)]
        spin_until(lambda: set(judged) <= margins.keys())
    assert k - 1 == pytest.approx(shipped.samples, abs=2)
    assert min(margins[stamp] for stamp in judged) > 0.0
    gap = x - funnel.x(funnel.tf)
    assert gap @ funnel.shape(funnel.tf) @ gap < 1.0, "in the goal's part that the funnel ends in"
