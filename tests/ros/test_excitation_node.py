"""The excitation node over DDS: within its limits, repeated exactly, stopped when asked."""

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import NamedTuple

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from rclpy.client import Client
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.samples import f1tenth
from nlsid_ros import qos
from tests.ros.processes import (
    SpinUntil,
    call,
    node_here,
    process,
    refusal,
    ros_test,
    service,
    stop,
)

pytestmark = ros_test

EXCITATION = "nlsid_ros.excitation"
LIMITS: dict[str, object] = {"lowest": -0.1, "highest": 0.4, "slew": 2.0, "fade": 0.2}


class Excited(NamedTuple):
    """A node that hears (sent: stamp in ns, command) the excitation that runs in a process."""

    node: Node
    spin_until: SpinUntil
    running: Popen[str]
    start: Client
    sent: list[tuple[int, float]]


@contextmanager
def heard(parameters: dict[str, object]) -> Iterator[Excited]:
    """The node at work and waiting for ~/start, heard on its topic."""
    sent: list[tuple[int, float]] = []

    def hear(message: TwistStamped) -> None:
        stamp = message.header.stamp
        sent.append((stamp.sec * 10**9 + stamp.nanosec, message.twist.linear.x))

    with (
        node_here("test_robot") as (node, spin_until),
        process(EXCITATION, **(LIMITS | parameters)) as running,
    ):
        node.create_subscription(TwistStamped, "/cmd_vel", hear, qos.STREAM)
        start = service(node, spin_until, "/excitation/start")
        spin_until(lambda: node.count_publishers("/cmd_vel") == 1)
        yield Excited(node, spin_until, running, start, sent)


def excite(
    parameters: dict[str, object], *, stop_after: float | None = None
) -> tuple[list[tuple[int, float]], list[str]]:
    """(stamp, command) of everything sent after ~/start, and what was said to have been done."""
    did: list[str] = []

    def hear_experiment(message: String) -> None:
        did.append(message.data)

    with heard(parameters) as (node, spin_until, running, start, sent):
        node.create_subscription(String, "/excitation/experiment", hear_experiment, qos.DOCUMENT)
        halt = service(node, spin_until, "/excitation/stop")
        settled = time.monotonic() + 0.5
        spin_until(lambda: time.monotonic() > settled)
        assert not sent, "nothing moves before it is asked to"
        start.call_async(Trigger.Request())
        spin_until(lambda: bool(sent))
        if stop_after is not None:
            asked = time.monotonic() + stop_after
            spin_until(lambda: time.monotonic() > asked)
            halt.call_async(Trigger.Request())
        quiet = [0, time.monotonic()]

        def ended() -> bool:
            if len(sent) != quiet[0]:
                quiet[:] = [len(sent), time.monotonic()]
            return time.monotonic() - quiet[1] > 1.0

        spin_until(ended)
        stop(running)
    return sent, did


def test_repeats_are_the_same_signal_within_the_limits() -> None:
    parameters: dict[str, object] = {
        "period": 0.02,
        "duration": 2.0,
        "pause": 0.5,
        "repeats": 2,
        "lowest_hz": 0.5,
        "highest_hz": 3.0,
    }
    sent, did = excite(parameters)
    stamps, inputs = np.array([s for s, _ in sent]), np.array([u for _, u in sent])
    assert (np.diff(stamps) == 20_000_000).all(), "on an exact grid"
    half = len(inputs) // 2
    assert half >= 125
    np.testing.assert_array_equal(inputs[:half], inputs[half:])
    assert inputs.min() >= -0.1
    assert inputs.max() <= 0.4
    assert np.ptp(inputs) > 0.3
    assert np.abs(np.diff(inputs)).max() <= 2.0 * 0.02 * (1 + 1e-9)
    assert inputs[-1] == 0.0
    said = [json.loads(text) for text in did]
    assert [(each["repeat"], each.get("ended", "")) for each in said] == [
        (1, ""),
        (2, ""),
        (2, "done"),
    ]
    assert {each["repeat_group"] for each in said} == {said[0]["repeat_group"]}
    assert said[0]["repeat_group"].startswith("/cmd_vel:twist.linear.x, multisine, sha256:")
    assert (said[0]["kind"], said[0]["repeats"]) == ("multisine", 2)
    assert said[0]["limits"]["highest"] == 0.4


@pytest.mark.parametrize("kind", ["chirp", "prbs", "steps"])
def test_every_kind_stays_within_the_limits(kind: str) -> None:
    parameters: dict[str, object] = {
        "kind": kind,
        "period": 0.02,
        "duration": 2.0,
        "pause": 0.1,
        "hold": 0.1,
        "lowest_hz": 1.0,
        "highest_hz": 4.0,
    }
    sent, _ = excite(parameters)
    inputs = np.array([u for _, u in sent])
    assert len(inputs) >= 80
    assert -0.1 <= inputs.min() < 0.0
    assert 0.2 < inputs.max() <= 0.4
    assert np.abs(np.diff(inputs, prepend=0.0)).max() <= 2.0 * 0.02 * (1 + 1e-9)
    assert inputs[-1] == 0.0


def test_asked_to_stop_it_returns_to_rest_no_faster_than_allowed() -> None:
    sent, did = excite({"kind": "steps", "period": 0.02, "pause": 0.0}, stop_after=1.5)
    assert json.loads(did[-1])["ended"] == "stopped when asked to"
    assert json.loads(did[-1])["repeat_group"] == "", "half a repeat is none"
    inputs = [u for _, u in sent]
    assert inputs[-1] == 0.0
    assert len(inputs) < 200
    assert np.abs(np.diff(inputs)).max() <= 2.0 * 0.02 * (1 + 1e-9)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ended_by_a_signal_it_leaves_the_robot_at_rest(how: signal.Signals) -> None:
    steps: dict[str, object] = {"kind": "steps", "period": 0.02, "pause": 0.0}
    with heard(steps | {"lowest": 0.3, "rest": 0.3}) as (_, spin_until, running, start, sent):
        start.call_async(Trigger.Request())
        spin_until(lambda: bool(sent) and sent[-1][1] > 0.35)
        running.send_signal(how)
        spin_until(lambda: running.poll() is not None and sent[-1][1] == 0.3)
        assert running.returncode == 0
    assert np.abs(np.diff([u for _, u in sent])).max() <= 2.0 * 0.02 * (1 + 1e-9)


def test_held_up_for_a_while_it_ends_and_does_not_set_the_robot_in_motion_again() -> None:
    """What is late is not played on; a base that stops when no command comes rests by then."""
    said: dict[str, bytes] = {}

    def hear_status(message: DiagnosticArray) -> None:
        said[message.status[0].message] = message.status[0].level

    steps: dict[str, object] = {"kind": "steps", "period": 0.02, "pause": 0.0}
    with heard(steps) as (node, spin_until, running, start, sent):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear_status, qos.EVENTS)
        start.call_async(Trigger.Request())
        spin_until(lambda: bool(sent) and sent[-1][1] > 0.2)
        running.send_signal(signal.SIGSTOP)
        later = time.monotonic() + 1.5
        spin_until(lambda: time.monotonic() > later)
        before = len(sent)
        running.send_signal(signal.SIGCONT)
        spin_until(lambda: any("before this node's clock; 0.1 s are allowed" in s for s in said))
        spin_until(lambda: len(sent) > before)
        assert {u for _, u in sent[before:]} == {0.0}
        assert said[next(s for s in said if "s are allowed" in s)] == DiagnosticStatus.ERROR
        stop(running)


def test_a_recorder_that_does_not_answer_is_said(tmp_path: Path) -> None:
    said: dict[str, bytes] = {}

    def hear(message: DiagnosticArray) -> None:
        said[message.status[0].message] = message.status[0].level

    with (
        node_here("test_robot") as (node, spin_until),
        process(
            "nlsid_ros.trajectory_recorder",
            topics="[/cmd_vel]",
            bag=tmp_path / "bag",
            at_once=False,
        ) as recorder,
        process(EXCITATION, **LIMITS, recorder="trajectory_recorder") as running,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        spin_until(lambda: "waiting for ~/start" in said)

        def started() -> bool:
            return bool(call(node, spin_until, "/excitation/start").success)

        spin_until(lambda: node.count_clients("/trajectory_recorder/start") == 1)
        recorder.send_signal(signal.SIGSTOP)
        spin_until(started)
        spin_until(lambda: any("has not answered for 10 s" in text for text in said))
        assert said[next(s for s in said if "has not" in s)] == DiagnosticStatus.ERROR
        recorder.send_signal(signal.SIGCONT)
        stop(running)


def test_a_recorded_command_is_replayed_within_the_limits() -> None:
    trial: Path = f1tenth()[4]
    sent, _ = excite({"kind": "replay", "bag": trial, "pause": 0.0, "slew": 100.0, "fade": 0.0})
    inputs = [u for _, u in sent]
    assert max(inputs) == pytest.approx(0.4)
    assert len(inputs) > 100


@pytest.mark.parametrize(
    "missing", [{"lowest": 0.0, "highest": 0.0, "slew": 1.0}, {"highest": 1.0, "slew": 0.0}]
)
def test_without_limits_it_does_not_run(missing: dict[str, object]) -> None:
    assert "to what the robot may do" in refusal(EXCITATION, **missing)
