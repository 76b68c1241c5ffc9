"""The simulated robots over DDS: real time, noise, delay, pushes, and what they refuse."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from nlsid_core.arrays import FloatArray
from nlsid_ros import qos
from tests.ros.processes import ROOT, STARTED, call, node_here, process, refusal, ros_test, stop

pytestmark = ros_test
MUJOCO = pytest.mark.skipif(
    subprocess.run([sys.executable, "-c", "import mujoco"], check=False).returncode != 0,
    reason="needs the extra `sim`",
)


class Ear:
    """Joint states by stamp (s since the first), and how old they were on arrival."""

    def __init__(self) -> None:
        self.t: list[float] = []
        self.states: list[FloatArray] = []
        self.ages: list[float] = []

    def hear(self, message: JointState, now_ns: int) -> None:
        """One sample."""
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        self.t.append(stamp_ns / 1e9)
        self.states.append(np.array([*message.position, *message.velocity]))
        self.ages.append((now_ns - stamp_ns) / 1e9)


def heard(
    samples: int, *, torque: list[float] | None = None, pushed: bool = False, **parameters: object
) -> Ear:
    """The first `samples` of a plant after it was given a torque or a push."""
    ear = Ear()
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_ear"))
        clock = node.get_clock()
        node.create_subscription(
            JointState, "/joint_states", lambda m: ear.hear(m, clock.now().nanoseconds), qos.STREAM
        )
        commands = node.create_publisher(JointState, "/joint_commands", qos.STREAM)
        stack.enter_context(process("nlsid_ros.plant", **parameters))
        spin_until(lambda: len(ear.t) > 10 and commands.get_subscription_count() == 1)
        if torque is not None:
            message = JointState(effort=torque)
            message.header.stamp = clock.now().to_msg()
            commands.publish(message)
        if pushed:
            call(node, spin_until, "/plant/push")
        before = len(ear.t)
        spin_until(lambda: len(ear.t) >= before + samples)
    return ear


def test_in_simulated_time_it_begins_when_the_clock_does_and_again_when_it_jumps() -> None:
    ear = Ear()
    with (
        node_here("test_clock") as (node, spin_until),
        process("nlsid_ros.plant", kind="pendulum", use_sim_time=True) as running,
    ):
        clock = node.create_publisher(Clock, "/clock", qos.STREAM)
        node.create_subscription(JointState, "/joint_states", lambda m: ear.hear(m, 0), qos.STREAM)
        spin_until(lambda: clock.get_subscription_count() == 1)
        spin_until(lambda: node.count_publishers("/joint_states") == 1)
        for start in (10**9, 2 * 10**9, 10**9):
            sent, count = iter(range(10**6)), len(ear.t)

            def ticks(start: int = start, sent: Iterator[int] = sent, count: int = count) -> bool:
                sec, centis = divmod(next(sent), 100)
                clock.publish(Clock(clock=Time(sec=start + sec, nanosec=centis * 10**7)))
                return len(ear.t) > count + 20

            spin_until(ticks)
            assert start <= ear.t[-1] < start + 1000
        stop(running)
    assert len(ear.t) < 1000, "nothing was made up for in between"


def test_a_pendulum_runs_on_an_exact_grid_in_real_time_and_answers_a_torque() -> None:
    ear = heard(
        80, torque=[0.5], kind="pendulum", command_timeout=60.0, noise=0.001, rate_noise=0.01
    )
    np.testing.assert_allclose(np.diff(ear.t), 0.01, atol=1e-6)
    states = np.array(ear.states)
    assert 5e-4 < states[:10, 0].std() < 2e-3
    assert float(np.max(states[:, 0])) > 0.08  # towards 0.5 / (9.81 * 0.5) rad
    assert sorted(ear.ages)[len(ear.ages) // 2] < 0.1  # a busy machine may be late, but it keeps up


def test_a_command_that_is_not_renewed_ends() -> None:
    ear = heard(80, torque=[0.5, 0.0, 0.0], kind="satellite", period=0.01, command_timeout=0.1)
    rates = np.array(ear.states)[:, 3]
    assert 0.0 < rates[-1] < 0.5 * 0.15 / 5.0, "0.1 s of 0.5 N m on 5 kg m²"
    assert rates[-1] == rates[-30]


@MUJOCO
@pytest.mark.parametrize(("robot", "joints"), [("pendulum", 1), ("arm", 2)])
def test_a_mujoco_robot_publishes_noisy_angles_and_rates_at_100_hz(robot: str, joints: int) -> None:
    ear = heard(200, kind=f"mujoco_{robot}")
    np.testing.assert_allclose(np.diff(ear.t), 0.01, atol=1e-6)
    spread = np.array(ear.states).std(axis=0)
    expected = np.repeat([1e-3, 1e-2], joints)  # rad, rad/s; it hangs at rest
    assert spread.shape == (2 * joints,)
    assert (0.7 * expected < spread).all()
    assert (spread < 1.4 * expected).all()


def test_a_delay_is_seen_between_stamp_and_arrival() -> None:
    ear = heard(30, kind="pendulum", delay=0.2)
    assert min(ear.ages) >= 0.2
    np.testing.assert_allclose(np.diff(ear.t), 0.01, atol=1e-6)


def test_a_push_is_seen_and_only_where_it_acts() -> None:
    ear = heard(20, pushed=True, kind="satellite", push=5.0, push_duration=0.05, push_input=1)
    rates = np.array(ear.states)[:, 3:]
    assert rates[-1, 1] == pytest.approx(5.0 * 0.05 / 3.0, rel=1e-6)  # H = diag(5, 3, 2)
    assert (rates[:, [0, 2]] == 0).all()


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (
            {"kind": "unicycle"},
            "it should be one of model, vector_field, pendulum, satellite, mujoco_pendulum",
        ),
        ({"kind": "model"}, "set the parameter model"),
        ({"kind": "pendulum", "push_input": 1}, "pendulum has 1 inputs"),
    ],
)
def test_a_plant_that_cannot_be_made_says_why(parameters: dict[str, object], said: str) -> None:
    assert said in refusal("nlsid_ros.plant", **parameters)


def test_without_mujoco_its_robots_are_an_error_that_names_the_extra(tmp_path: Path) -> None:
    """MuJoCo is hidden from a fresh process, as if it had not been installed."""
    hidden = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from nlsid_ros.plant import main\n"
        "main(['--ros-args', '-p', 'kind:=mujoco_arm'])\n"
    )
    script = tmp_path / "without_mujoco.py"
    script.write_text(f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{hidden}")
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=STARTED, check=False
    )
    assert done.returncode == 1
    assert "pip install 'nlsid[sim]'" in done.stderr
