"""Every node goes through its lifecycle again and again, by itself and by a manager."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.shipped import config_file
from bags.designs.documents import MODEL
from bags.recordings.bag import Bag
from bags.samples import f1tenth
from nlsid_ros import qos
from tests.ros.processes import Bench, ros_test, service, stop

pytestmark = ros_test
CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
DEACTIVATE, CLEANUP = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP
UNCONFIGURED = State.PRIMARY_STATE_UNCONFIGURED
INACTIVE, ACTIVE = State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE
DOWN = [  # in nav2's order: transitions, and the states after them
    (DEACTIVATE, INACTIVE),
    (CLEANUP, UNCONFIGURED),
    (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, State.PRIMARY_STATE_FINALIZED),
]
SAYS = {  # once it is active
    "excitation": "idle",
    "trajectory_recorder": "nothing on /joints yet",
    "model_identifier": "idle",
    "funnel_publisher": "PROVED",
    "tracking_controller": "idle",
    "funnel_monitor": "no speed yet",
    "plant": "",
    "viewer": "",
}


def asked(bench: Bench, name: str, transition: int) -> tuple[bool, int]:
    """Whether the node says that the transition was made, and its state after it."""
    wanted = Transition(id=transition)
    done = bench.call(f"/{name}/change_state", ChangeState, transition=wanted)
    return done.success, bench.call(f"/{name}/get_state", GetState).current_state.id


def settings_of(name: str, funnel: Path, folder: Path) -> dict[str, object]:
    """What it needs to start."""
    own: dict[str, dict[str, object]] = {
        "excitation": {"highest": 0.4, "slew": 1.0},
        "trajectory_recorder": {"topics": "[/joints]", "bag": folder / "run"},
        "model_identifier": {
            "bags": f"['{f1tenth()[0]}']",
            "config": config_file("f1tenth.yaml"),
            "out": folder / "out",
        },
        "funnel_publisher": {"funnel": funnel},
        "tracking_controller": {"highest": 0.4, "source": "source"},
        "funnel_monitor": {"source": "source"},
        "plant": {"model": funnel.with_name(MODEL)},
        "viewer": {"port": 0},
    }
    return own[name]


@pytest.mark.parametrize("name", SAYS)
def test_a_node_that_started_itself_is_taken_over_by_a_manager_which_wrong_requests_do_no_harm(
    name: str, bench: Bench, funnel: Path, tmp_path: Path
) -> None:
    bench.start("funnel_publisher", funnel=funnel, __node="source")
    running = bench.start(name, **settings_of(name, funnel, tmp_path))
    assert asked(bench, name, ACTIVATE) == (False, ACTIVE), "it is active already"
    assert asked(bench, name, CONFIGURE) == (True, INACTIVE), "as a manager does"
    for transition, answer in (
        (CONFIGURE, (False, INACTIVE)),
        (ACTIVATE, (True, ACTIVE)),
        (ACTIVATE, (False, ACTIVE)),
        (CONFIGURE, (False, ACTIVE)),
    ):
        assert asked(bench, name, transition) == answer
    assert asked(bench, name, 99) == (False, ACTIVE), "there is no such transition"
    said = SAYS[name]
    for _ in range(2):
        assert asked(bench, name, DEACTIVATE) == (True, INACTIVE)
        assert asked(bench, name, CLEANUP) == (True, UNCONFIGURED)
        assert asked(bench, name, CONFIGURE) == (True, INACTIVE)
        bench.said.clear()
        assert asked(bench, name, ACTIVATE) == (True, ACTIVE)
        if said:
            bench.hears(said, name)
    assert "Traceback" not in stop(running)
    for bag in sorted(tmp_path.glob("run*")):
        with Bag(bag) as source:
            assert source.ending is None


def test_nav2s_manager_brings_nodes_up_in_order_and_down_in_reverse(
    bench: Bench, funnel: Path
) -> None:
    """Its transitions, by the names of the services that it calls."""
    names = ["robot/funnel_publisher", "robot/funnel_monitor"]
    bench.start("funnel_publisher", funnel=funnel, autostart=False, __ns="/robot")
    bench.start("funnel_monitor", autostart=False, __ns="/robot")
    for transition, state in ((CONFIGURE, INACTIVE), (ACTIVATE, ACTIVE)):
        assert [asked(bench, name, transition) for name in names] == [(True, state)] * 2
    bench.hears("no speed yet; listening on /robot/cmd_vel, /robot/odom", "robot/funnel_monitor")
    assert "\n" not in bench.said["robot/funnel_publisher"][-1][0]
    for transition, state in DOWN:
        assert [asked(bench, name, transition) for name in names[::-1]] == [(True, state)] * 2


def test_what_is_still_on_its_way_when_a_node_is_deactivated_does_not_end_it(bench: Bench) -> None:
    """Messages and requests that are queued for what the transition destroys."""
    name = "funnel_monitor"
    running = bench.start(name)
    design = bench.node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
    restart = service(bench.node, bench.spin_until, f"/{name}/restart")
    manager = service(bench.node, bench.spin_until, f"/{name}/change_state", ChangeState)
    for _ in range(10):
        for transition in (DEACTIVATE, ACTIVATE):
            answer = manager.call_async(ChangeState.Request(transition=Transition(id=transition)))
            for _ in range(20):
                design.publish(String(data="no design"))
                restart.call_async(Trigger.Request())
            bench.spin_until(answer.done)
            assert answer.result().success
        bench.waits(0.2)
    assert asked(bench, name, DEACTIVATE)[0]
    assert "Traceback" not in stop(running)


def test_parameters_are_read_when_the_node_is_configured(bench: Bench) -> None:
    """It starts though they make no sense yet; what is set before it is configured counts."""
    name = "tracking_controller"
    running = bench.start(name, autostart=False)
    assert asked(bench, name, CONFIGURE) == (False, UNCONFIGURED)
    assert bench.set(name, "highest", 0.4) == ""
    assert bench.set(name, "response_type", "sensor_msgs/msg/Imu") == ""
    assert asked(bench, name, CONFIGURE) == (True, INACTIVE)
    refused = bench.set(name, "response_type", "nav_msgs/msg/Odometry")
    assert refused == "response_type: read when the node is configured"
    assert "no room between" in bench.set(name, "highest", 0.0)
    assert asked(bench, name, CLEANUP) == (True, UNCONFIGURED)
    assert bench.set(name, "highest", 0.0) == ""
    assert asked(bench, name, CONFIGURE) == (False, UNCONFIGURED)
    assert "no room between lowest and highest" in stop(running)
