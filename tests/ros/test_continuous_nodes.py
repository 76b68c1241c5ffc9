"""A continuous funnel driven and watched over DDS; this test is the robot, in step with them."""

import math
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from bags.designs.documents import load
from bags.designs.wiring import wiring_of
from nlsid_core.designs import COMPOSITION, FUNNEL
from nlsid_core.running.comparison import Centre
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.continuous_stage import composed
from tests.ros.processes import call, node_here, process, ros_test

pytestmark = ros_test
PERIOD_NS = 50_000_000
RESPONSE, COMMAND = "/joints:position[0]", "/effort:effort[0]"
WIRING = {"response": RESPONSE, "command": COMMAND, "period": 0.05}


@pytest.mark.parametrize("stages", [1, 2])
def test_a_continuous_funnel_is_driven_and_every_margin_is_that_of_the_core(
    stages: int, tmp_path: Path
) -> None:
    """Two stages: a composition, of which controller and monitor say which stage is on."""
    path, samples = composed(tmp_path) / COMPOSITION, 20 * stages
    if stages == 1:
        path = tmp_path / "from 0" / FUNNEL
    commands: dict[int, float] = {}
    margins: dict[int, float] = {}
    said: dict[str, list[str]] = {}
    assuming: list[str] = []

    def hear_command(message: JointState) -> None:
        commands[stamp_ns_of(message)] = message.effort[0]

    def hear_margin(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[list(message.name).index("margin")]

    def hear_status(message: DiagnosticArray) -> None:
        for entry in message.status:
            said.setdefault(entry.name, []).append(entry.message)
            assuming.extend(v.value for v in entry.values if v.key == "assuming" and v.value)

    def has_said(name: str, text: str) -> bool:
        return any(text in line for line in said.get(name, []))

    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))
        stack.enter_context(process("nlsid_ros.funnel_publisher", funnel=str(path)))
        states = node.create_publisher(JointState, "/joints", qos.STREAM)
        node.create_subscription(JointState, "/effort", hear_command, qos.STREAM)
        node.create_subscription(JointState, "/funnel_monitor/margin", hear_margin, qos.STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", hear_status, qos.EVENTS)
        patience = {"stale_after": 20.0}
        joints = "sensor_msgs/msg/JointState"
        types = {"response_type": joints, "command_type": joints}
        limits = {"lowest": -20.0, "highest": 20.0, "stop_rate": 100.0}
        watching = {"controller": "tracking_controller", "command_wait": 1.0}
        stack.enter_context(
            process("nlsid_ros.tracking_controller", **WIRING, **patience, **types, **limits)
        )
        stack.enter_context(process("nlsid_ros.funnel_monitor", **WIRING, **patience, **watching))
        spin_until(lambda: has_said("tracking_controller", "idle"))
        spin_until(lambda: node.count_subscribers("/joints") >= 2)
        spin_until(lambda: node.count_subscribers("/effort") >= 2)
        assert call(node, spin_until, "/tracking_controller/start").success
        first_ns, x, run = time.time_ns(), 0.1, []
        for k in range(-1, samples + 1):  # the run starts with the second state that is heard
            stamp_ns = first_ns + (k + 1) * PERIOD_NS
            message = JointState(name=["cart"], position=[x])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            states.publish(message)
            if k == samples:
                break
            spin_until(lambda s=stamp_ns: s in commands)  # type: ignore[misc]
            if k >= 0:
                run.append((x, commands[stamp_ns]))
                x = x + PERIOD_NS * 1e-9 * commands[stamp_ns]
        spin_until(lambda: has_said("tracking_controller", "idle; stopped: the proof is over"))
        judged = [first_ns + (k + 1) * PERIOD_NS for k in range(samples)]
        spin_until(lambda: set(judged) <= margins.keys())
    wiring = wiring_of([RESPONSE], [COMMAND], 0.05)
    monitor = load(path, wiring=wiring).monitor(Centre.PROFILE)
    readings = [
        monitor.update(k * PERIOD_NS / 1e9, np.array([x]), np.array([u]))
        for k, (x, u) in enumerate(run)
    ]
    assert [margins[stamp] for stamp in judged] == [r.margin for r in readings], "bit for bit"
    assert all(margin > 0.3 for margin in (margins[stamp] for stamp in judged))
    assert not any(math.isnan(margins[stamp]) for stamp in judged)
    held = "the policy is applied continuously; here each input is held for 0.05 s"
    if stages == 1:
        assert set(assuming) == {held}
    else:
        assert set(assuming) == {f"stage {i} of 2: {held}" for i in (1, 2)}
        assert [has_said("tracking_controller", f"tracking, stage {i} of 2") for i in (1, 2)]
