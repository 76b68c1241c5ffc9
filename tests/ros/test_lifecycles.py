"""Recorder, excitation and identifier: their lifecycles, and parameters that are refused."""

import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.shipped import config_file
from bags.recordings.bag import Bag
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
    set_parameter,
    stop,
)

pytestmark = ros_test

NODES: dict[str, dict[str, object]] = {
    "trajectory_recorder": {"topics": "[/joints]"},
    "excitation": {"highest": 0.4, "slew": 1.0},
    "model_identifier": {"bags": f"['{f1tenth()[0]}']", "config": config_file("f1tenth.yaml")},
}
CYCLE = (
    (Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE),
    (Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE),
    (Transition.TRANSITION_DEACTIVATE, State.PRIMARY_STATE_INACTIVE),
    (Transition.TRANSITION_CLEANUP, State.PRIMARY_STATE_UNCONFIGURED),
)
OWN = {"use_sim_time", "start_type_description_service"}  # rclpy's


@pytest.mark.parametrize("name", NODES)
def test_a_node_goes_through_its_lifecycle_twice(name: str, tmp_path: Path) -> None:
    settings = NODES[name] | {"autostart": False}
    if name == "trajectory_recorder":
        settings["bag"] = tmp_path / "run"
    if name == "model_identifier":
        settings["out"] = tmp_path / "out"
    with (
        node_here("test_manager") as (node, spin_until),
        process(f"nlsid_ros.{name}", **settings) as running,
    ):
        for transition, state in CYCLE * 2:
            assert asked(name, transition, node, spin_until) == (True, state)
        stop(running)
    if name == "trajectory_recorder":
        for bag in (tmp_path / "run", tmp_path / "run_2"):
            with Bag(bag) as source:
                assert source.ending is None


ALL: dict[str, dict[str, object]] = {
    **NODES,
    "funnel_monitor": {},
    "tracking_controller": {"highest": 0.4},
}
ALL["plant"] = {"kind": "pendulum"}


def asked(name: str, transition: int, node: Node, spin_until: SpinUntil) -> tuple[bool, int]:
    """Whether the node says that the transition was made, and its state after it."""
    wanted = Transition(id=transition)
    done = call(node, spin_until, f"/{name}/change_state", ChangeState, transition=wanted)
    now = call(node, spin_until, f"/{name}/get_state", GetState)
    return done.success, now.current_state.id


def settings_of(name: str, folder: Path) -> dict[str, object]:
    """What it needs to start."""
    own: dict[str, dict[str, object]] = {
        "trajectory_recorder": {"bag": folder / "run"},
        "model_identifier": {"out": folder},
    }
    return {**ALL[name], **own.get(name, {})}


@pytest.mark.parametrize("name", ALL)
def test_a_manager_takes_over_a_node_that_started_itself_and_wrong_requests_do_no_harm(
    name: str, tmp_path: Path
) -> None:
    configure, activate = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
    inactive, active = State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE
    with (
        node_here("test_manager") as (node, spin_until),
        process(f"nlsid_ros.{name}", **settings_of(name, tmp_path)) as running,
    ):
        assert asked(name, activate, node, spin_until) == (False, active), "it is active already"
        assert asked(name, configure, node, spin_until) == (True, inactive), "as a manager does"
        assert asked(name, configure, node, spin_until) == (False, inactive)
        assert asked(name, activate, node, spin_until) == (True, active)
        assert asked(name, activate, node, spin_until) == (False, active)
        assert asked(name, configure, node, spin_until) == (False, active)
        assert asked(name, 99, node, spin_until) == (False, active), "there is no such transition"
        assert "Traceback" not in stop(running)


@pytest.mark.parametrize("name", ALL)
def test_a_node_that_started_itself_is_taken_down_and_brought_up_again(
    name: str, tmp_path: Path
) -> None:
    """As `ros2 lifecycle set` does it, without a manager that configures first."""
    with (
        node_here("test_manager") as (node, spin_until),
        process(f"nlsid_ros.{name}", **settings_of(name, tmp_path)) as running,
    ):
        for transition, state in (*CYCLE[2:], *CYCLE):
            assert asked(name, transition, node, spin_until) == (True, state)
        assert "Traceback" not in stop(running)


def test_what_is_still_on_its_way_when_a_node_is_deactivated_does_not_end_it() -> None:
    """Messages and requests that are queued for what the transition destroys."""
    name = "funnel_monitor"
    with (
        node_here("test_manager") as (node, spin_until),
        process(f"nlsid_ros.{name}") as running,
    ):
        design = node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
        restart = service(node, spin_until, f"/{name}/restart")
        manager = service(node, spin_until, f"/{name}/change_state", ChangeState)
        for _ in range(10):
            for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
                request = ChangeState.Request(transition=Transition(id=transition))
                answer = manager.call_async(request)
                for _ in range(20):
                    design.publish(String(data="no design"))
                    restart.call_async(Trigger.Request())
                spin_until(answer.done)
                assert answer.result().success
            settled = time.monotonic() + 0.2
            spin_until(lambda settled=settled: time.monotonic() > settled)  # type: ignore[misc]
        assert asked(name, Transition.TRANSITION_DEACTIVATE, node, spin_until)[0]
        assert "Traceback" not in stop(running)


@pytest.mark.parametrize("name", NODES)
def test_every_parameter_is_described_bounded_and_cannot_be_changed_while_it_runs(
    name: str, tmp_path: Path
) -> None:
    settings = settings_of(name, tmp_path) | {"autostart": False}
    with (
        node_here("test_manager") as (node, spin_until),
        process(f"nlsid_ros.{name}", **settings, __ns="/robot") as running,
    ):
        full = f"/robot/{name}"
        configure = Transition.TRANSITION_CONFIGURE
        assert asked(f"robot/{name}", configure, node, spin_until)[0]
        listed = call(node, spin_until, f"{full}/list_parameters", ListParameters)
        names = [
            each
            for each in listed.result.names
            if each not in OWN and not each.startswith("qos_overrides")
        ]
        assert len(names) >= 4
        described, now = (
            call(node, spin_until, f"{full}/{what}_parameters", kind, names=names)
            for what, kind in (("describe", DescribeParameters), ("get", GetParameters))
        )
        for each, value in zip(described.descriptors, now.values, strict=True):
            assert each.description, each.name
            if each.type == ParameterType.PARAMETER_DOUBLE:
                assert len(each.floating_point_range) == 1, each.name
            if each.type == ParameterType.PARAMETER_INTEGER:
                assert len(each.integer_range) == 1, each.name
            change = [Parameter(name=each.name, value=value)]
            answer = call(
                node, spin_until, f"{full}/set_parameters", SetParameters, parameters=change
            )
            [result] = answer.results
            assert not result.successful
            assert result.reason == f"{each.name}: read when the node is configured"
        stop(running)
    assert not list(tmp_path.iterdir())


def test_parameters_are_read_when_the_node_is_configured() -> None:
    """It starts though they make no sense yet; what is set before it is configured counts."""
    name = "tracking_controller"
    configure, cleanup = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
    with (
        node_here("test_manager") as (node, spin_until),
        process(f"nlsid_ros.{name}", autostart=False) as running,
    ):
        unconfigured = State.PRIMARY_STATE_UNCONFIGURED
        assert asked(name, configure, node, spin_until) == (False, unconfigured)
        assert set_parameter(node, spin_until, name, "highest", 0.4) == ""
        assert set_parameter(node, spin_until, name, "response_type", "sensor_msgs/msg/Imu") == ""
        assert asked(name, configure, node, spin_until) == (True, State.PRIMARY_STATE_INACTIVE)
        refused = set_parameter(node, spin_until, name, "response_type", "nav_msgs/msg/Odometry")
        assert refused == "response_type: read when the node is configured"
        assert "no room between" in set_parameter(node, spin_until, name, "highest", 0.0)
        assert asked(name, cleanup, node, spin_until) == (True, unconfigured)
        assert set_parameter(node, spin_until, name, "highest", 0.0) == ""
        assert asked(name, configure, node, spin_until) == (False, unconfigured)
        assert "no room between lowest and highest" in stop(running)


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("trajectory_recorder", {"split_time": -1.0}, "Min: 0.0, Max: 1000000.0, value: -1.0"),
        ("trajectory_recorder", {"snapshot": "long"}, "parameter snapshot (s kept in memory"),
        ("excitation", {"period": 0.0}, "parameter period (s between commands)"),
        ("excitation", {"repeats": 0}, "parameter repeats (how often it is played)"),
        ("excitation", {"kind": "noise"}, "kind is 'noise'; it should be one of multisine"),
        ("excitation", {"highest_hz": 1000.0}, "half the sample rate"),
        ("excitation", {"command": "/cmd_vel:twist.speed"}, "speed"),
        ("model_identifier", {"last": -1}, "parameter last (only the last so many of the bags"),
        ("model_identifier", {"bags": "['']"}, "set the parameters bags and out"),
        ("model_identifier", {"config": "nowhere.yaml", "out": "out"}, "nowhere.yaml"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_refused_at_the_start(
    name: str, wrong: dict[str, object], message: str
) -> None:
    assert message in refusal(f"nlsid_ros.{name}", **(NODES[name] | wrong))
