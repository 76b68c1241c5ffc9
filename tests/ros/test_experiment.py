"""Excitation, plant and recorder together: a bag per repeat, and repeats known as such."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from bags.signals.grid import read_dataset
from bags.signals.reader import bag_origin
from bags.signals.sampling import Grid
from nlsid_ros import qos
from tests.ros.processes import call, node_here, process, ros_test, service, stop

pytestmark = ros_test

COMMAND, RESPONSE = "/joint_commands:effort[0]", "/joint_states:position[0]"
LIMITS: dict[str, object] = {"lowest": -0.3, "highest": 0.3, "slew": 5.0, "fade": 0.2}
SIGNAL: dict[str, object] = {"period": 0.01, "duration": 2.0, "pause": 0.8, "highest_hz": 4.0}
SIGNAL |= {"command": COMMAND, "command_type": "sensor_msgs/msg/JointState"}


def test_each_repeat_has_a_bag_of_its_own_and_identification_knows_them_as_repeats(
    tmp_path: Path,
) -> None:
    bags = tmp_path / "trials"
    bags.mkdir()
    said: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        said.extend(s.message for s in message.status if s.name == "excitation")

    recorded: dict[str, object] = {
        "topics": "[/joint_states, /joint_commands]",
        "bag": bags / "trial",
        "at_once": False,
    }
    excitation = LIMITS | SIGNAL | {"repeats": 3, "recorder": "trajectory_recorder"}
    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.plant", kind="pendulum") as plant,
        process("nlsid_ros.trajectory_recorder", **recorded) as recorder,
        process("nlsid_ros.excitation", **excitation) as exciting,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        service(node, spin_until, "/trajectory_recorder/start")  # it is known
        spin_until(lambda: node.count_subscribers("/joint_states") == 1)
        spin_until(lambda: node.count_subscribers("/joint_commands") == 2)
        spin_until(lambda: "idle" in said)
        answer = call(node, spin_until, "/excitation/start")
        assert answer.success, answer.message
        spin_until(lambda: "done" in said)
        for process_ in (exciting, recorder, plant):
            stop(process_)

    trials = [bags / name for name in ("trial", "trial_2", "trial_3")]
    assert sorted(bags.iterdir()) == trials
    for number, trial in enumerate(trials, start=1):
        custom = bag_origin(trial)["custom"]
        assert json.loads(custom["experiment"])["repeat"] == number
        assert int(custom["/joint_commands received"]) >= 230
        assert custom["/joint_commands lost"] == "0"
    data = read_dataset(
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


def test_without_the_recorder_it_was_told_of_nothing_moves() -> None:
    excitation = LIMITS | SIGNAL | {"recorder": "trajectory_recorder"}
    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.excitation", **excitation) as exciting,
    ):
        answer = call(node, spin_until, "/excitation/start")
        assert not answer.success
        assert "there is no recorder trajectory_recorder" in answer.message
        stop(exciting)


def test_a_recorder_that_is_busy_stops_the_experiment_before_it_moves(tmp_path: Path) -> None:
    said: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        said.extend(s.message for s in message.status if s.name == "excitation")

    excitation = LIMITS | SIGNAL | {"recorder": "trajectory_recorder"}
    with (
        node_here("test_operator") as (node, spin_until),
        process(
            "nlsid_ros.trajectory_recorder", topics="[/joint_states]", bag=tmp_path / "own"
        ) as recorder,
        process("nlsid_ros.excitation", **excitation) as exciting,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        service(node, spin_until, "/trajectory_recorder/start")  # it is known
        spin_until(lambda: "idle" in said)
        service(node, spin_until, "/excitation/start").call_async(Trigger.Request())
        spin_until(lambda: any("no bag from the recorder: recording" in text for text in said))
        for process_ in (exciting, recorder):
            stop(process_)
