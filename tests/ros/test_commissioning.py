"""A policy of which nothing is proved, run over DDS in a mode that says so."""

import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from nlsid_core import files
from nlsid_core.designs import POLICY, VECTOR_FIELD
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.continuous_stage import stage
from tests.ros.processes import STARTED, call, node_here, process, ros_test

pytestmark = ros_test
CONTROLLER, PERIOD_NS = "nlsid_ros.tracking_controller", 50_000_000
JOINTS = "sensor_msgs/msg/JointState"


def test_an_unproved_policy_runs_in_its_mode_only_and_with_what_stops_the_robot(
    tmp_path: Path,
) -> None:
    field, policy, _ = stage()
    files.write_document(tmp_path / VECTOR_FIELD, field.document())
    files.write_document(tmp_path / POLICY, policy.document())
    settings = {
        "commissioning": str(tmp_path),
        "lowest": -20.0,
        "highest": 20.0,
        "stop_rate": 100.0,
        "response": "/joints:position[0]",
        "command": "/effort:effort[0]",
        "period": 0.05,
        "response_type": JOINTS,
        "command_type": JOINTS,
        "stale_after": 20.0,
    }
    commands: dict[int, float] = {}
    said: list[tuple[bytes, str]] = []
    stopped: list[bool] = []

    def hear_command(message: JointState) -> None:
        commands[stamp_ns_of(message)] = message.effort[0]

    def hear(message: DiagnosticArray) -> None:
        said.extend((s.level, s.message) for s in message.status if s.name == "tracking_controller")

    def stop(_: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        stopped.append(True)
        answer.success = True
        return answer

    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))
        states = node.create_publisher(JointState, "/joints", qos.STREAM)
        node.create_subscription(JointState, "/effort", hear_command, qos.STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        with process(CONTROLLER, **settings) as refused:
            assert refused.wait(STARTED) != 0
            assert refused.stdout is not None
            assert "runs what is not proved: set stop_service" in refused.stdout.read()
        stack.enter_context(process(CONTROLLER, **settings, stop_service="/robot/stop"))

        start = partial(call, node, spin_until, "/tracking_controller/start")
        answer = start()
        assert not answer.success
        assert "/robot/stop is not there" in answer.message
        node.create_service(Trigger, "/robot/stop", stop)
        spin_until(lambda: node.count_subscribers("/joints") >= 1 and bool(start().success))
        first_ns, x = time.time_ns(), 0.9  # far outside of where any funnel of it would be
        for k in range(-1, 10):
            stamp_ns = first_ns + (k + 1) * PERIOD_NS
            message = JointState(name=["cart"], position=[x])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            states.publish(message)
            spin_until(lambda s=stamp_ns: s in commands)  # type: ignore[misc]
            if k >= 0:
                t = k * PERIOD_NS / 1e9
                assert commands[stamp_ns] == pytest.approx(float(policy(t, [x])[0]))
                x += PERIOD_NS * 1e-9 * commands[stamp_ns]
        assert not stopped
        assert call(node, spin_until, "/tracking_controller/stop").success
        spin_until(lambda: bool(stopped))
    assert said
    assert all(text.startswith("COMMISSIONING, not proved: ") for _, text in said)
    assert all(level >= DiagnosticStatus.WARN for level, _ in said)
    assert any("tracking" in text for _, text in said)
