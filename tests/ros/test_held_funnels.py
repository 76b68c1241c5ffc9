"""The shipped cart-pole, proved for an input that is held, published, driven and watched over DDS.

This test is the robot: the true dynamics, in step with the controller.
"""

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from examples.cart_pole import designed, truth
from nlsid_core.arrays import FloatArray
from nlsid_core.running.held import slowest
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.ros.processes import call, node_here, process, ros_test

pytestmark = ros_test
HOLD = 0.002  # s
PERIOD = slowest(HOLD)
PERIOD_NS = round(PERIOD * 1e9)
STEPS = 4  # of Runge-Kutta in a sample
JOINTS = "sensor_msgs/msg/JointState"
FIELDS = [f"/joints:{field}[{i}]" for field in ("position", "velocity") for i in (0, 1)]
WIRING = {"response": ", ".join(FIELDS), "command": "/force:effort[0]"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The design's files."""
    path = tmp_path_factory.mktemp("cart_pole")
    designed(HOLD).save(path)
    return path


def moved(x: FloatArray, u: float) -> FloatArray:
    """The state a period later under a held force."""
    h, force = PERIOD / STEPS, np.array([[u]])
    for _ in range(STEPS):
        a = truth(x[None], force)[0]
        b = truth((x + h / 2 * a)[None], force)[0]
        c = truth((x + h / 2 * b)[None], force)[0]
        d = truth((x + h * c)[None], force)[0]
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


def test_the_cart_pole_swings_up_inside_its_funnel_over_dds(folder: Path) -> None:
    commands: dict[int, float] = {}
    margins: dict[int, float] = {}
    said: dict[str, list[str]] = {}
    assuming: set[str] = set()

    def hear_command(message: JointState) -> None:
        commands[stamp_ns_of(message)] = message.effort[0]

    def hear_margin(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[list(message.name).index("margin")]

    def hear_status(message: DiagnosticArray) -> None:
        for entry in message.status:
            said.setdefault(entry.name, []).append(entry.message)
            assuming.update(v.value for v in entry.values if v.key == "assuming" and v.value)

    def has_said(name: str, text: str) -> bool:
        return any(text in line for line in said.get(name, []))

    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))
        states = node.create_publisher(JointState, "/joints", qos.STREAM)
        node.create_subscription(JointState, "/force", hear_command, qos.STREAM)
        node.create_subscription(JointState, "/funnel_monitor/margin", hear_margin, qos.STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", hear_status, qos.EVENTS)
        patience = {"stale_after": 60.0, "period": PERIOD}
        types = {"response_type": JOINTS, "command_type": JOINTS}
        limits = {"lowest": -40.0, "highest": 40.0, "stop_rate": 1000.0}
        watching = {"controller": "tracking_controller", "command_wait": 1.0}
        stack.enter_context(
            process("nlsid_ros.funnel_publisher", funnel=str(folder / "funnel.json"))
        )
        spin_until(lambda: has_said("funnel_publisher", "PROVED"))  # each decides, in turn
        stack.enter_context(
            process("nlsid_ros.tracking_controller", **WIRING, **patience, **types, **limits)
        )
        spin_until(lambda: has_said("tracking_controller", "idle"))
        stack.enter_context(process("nlsid_ros.funnel_monitor", **WIRING, **patience, **watching))
        spin_until(lambda: node.count_subscribers("/joints") >= 2)
        spin_until(lambda: node.count_subscribers("/force") >= 2)
        assert call(node, spin_until, "/tracking_controller/start").success
        first_ns, x, k = time.time_ns(), np.array([0.01, 0.01, 0.0, 0.0]), 0
        while not has_said("tracking_controller", "idle; stopped"):
            stamp_ns = first_ns + k * PERIOD_NS
            message = JointState(
                name=["cart", "pole"], position=x[:2].tolist(), velocity=x[2:].tolist()
            )
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            states.publish(message)
            spin_until(
                lambda s=stamp_ns: s in commands or has_said("tracking_controller", "stopp")  # type: ignore[misc]
            )
            if stamp_ns not in commands:
                break
            x, k = moved(x, commands[stamp_ns]) if k else x, k + 1
        spin_until(lambda: has_said("tracking_controller", "idle; stopped: the proof is over"))
        judged = [first_ns + (i + 1) * PERIOD_NS for i in range(k - 1)]
        spin_until(lambda: set(judged) <= margins.keys())
    assert k - 1 == pytest.approx(2.0 / PERIOD, abs=2)
    assert abs(x[1] - np.pi) < 0.13, "the pole stands"
    assert min(margins[stamp] for stamp in judged) > 0.0
    assert assuming == {f"each input is at most {HOLD:g} s old, and w stays in its box"}


def test_samples_that_come_too_slowly_for_the_proof_are_refused_by_name(folder: Path) -> None:
    said: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        said.extend(entry.message for entry in message.status)

    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_reader"))
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        types = {"response_type": JOINTS, "command_type": JOINTS}
        stack.enter_context(
            process("nlsid_ros.funnel_publisher", funnel=str(folder / "funnel.json"))
        )
        spin_until(lambda: any("PROVED" in line for line in said))
        stack.enter_context(
            process(
                "nlsid_ros.tracking_controller",
                **WIRING,
                **types,
                period=0.01,
                lowest=-40.0,
                highest=40.0,
            )
        )
        refused = (
            "samples come every 0.01 s, and the funnel is proved for inputs of at most 0.002 s"
        )
        spin_until(lambda: any(refused in line for line in said))
