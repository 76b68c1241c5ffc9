"""The simulated robots over DDS: real time, noise, pushes, and commands that are not renewed."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.designs import VECTOR_FIELD
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of, stamp_of
from tests.continuous_stage import stage
from tests.ros.processes import ROOT, STARTED, Bench, ros_test

pytestmark = ros_test
MUJOCO = pytest.mark.skipif(
    subprocess.run([sys.executable, "-c", "import mujoco"], check=False).returncode != 0,
    reason="needs the extra `sim`",
)
JOINTS = "sensor_msgs/msg/JointState"


@pytest.fixture
def cart(tmp_path: Path) -> dict[str, object]:
    """A plant whose position is the integral of its effort."""
    files.write_document(tmp_path / VECTOR_FIELD, stage()[0].document())
    paths = {"response": "/joint_states:position[0]", "command": "/joint_commands:effort[0]"}
    types = {"response_type": JOINTS, "command_type": JOINTS}
    field = {"model": tmp_path / VECTOR_FIELD, "state": "'0.0'"}
    return {**field, **paths, **types}


class Heard:
    """Joint states of a plant by stamp (s), and the commands for it."""

    def __init__(self, bench: Bench, **parameters: object) -> None:
        self.bench = bench
        self.t: list[float] = []
        self.states: list[FloatArray] = []
        bench.listen(JointState, "/joint_states", self._hear)
        self.commands = bench.node.create_publisher(JointState, "/joint_commands", qos.STREAM)
        bench.start("plant", **parameters)

    def _hear(self, message: JointState) -> None:
        self.t.append(stamp_ns_of(message) / 1e9)
        self.states.append(np.array([*message.position, *message.velocity]))

    def more(self, samples: int) -> None:
        """Hear so many more, of a plant that hears commands."""
        self.bench.spin_until(lambda: self.commands.get_subscription_count() == 1)
        before = len(self.t)
        self.bench.spin_until(lambda: len(self.t) >= before + samples)

    def command(self, effort: float) -> None:
        """Send one command of now."""
        message = JointState(effort=[effort])
        message.header.stamp = self.bench.node.get_clock().now().to_msg()
        self.commands.publish(message)


def test_in_simulated_time_it_begins_when_the_clock_does_and_again_when_it_jumps(
    bench: Bench, cart: dict[str, object]
) -> None:
    heard = Heard(bench, **cart, use_sim_time=True)
    clock = bench.node.create_publisher(Clock, "/clock", qos.STREAM)
    bench.spin_until(lambda: clock.get_subscription_count() == 1)
    bench.spin_until(lambda: bench.node.count_publishers("/joint_states") == 1)
    for start in (10**9, 2 * 10**9, 10**9):
        sent, count = 0, len(heard.t)
        while len(heard.t) <= count + 20:
            clock.publish(Clock(clock=stamp_of(start * 10**9 + sent * 10**7)))
            bench.waits(0.001)
            sent += 1
        assert start <= heard.t[-1] < start + 1000
    assert len(heard.t) < 1000, "nothing was made up for in between"


def test_it_runs_on_an_exact_grid_with_noise_and_a_command_that_is_not_renewed_ends(
    bench: Bench, cart: dict[str, object]
) -> None:
    heard = Heard(bench, **cart, noise=0.001, command_timeout=0.1)
    heard.more(20)
    heard.command(1.0)
    heard.more(100)
    np.testing.assert_allclose(np.diff(heard.t), 0.01, atol=1e-6)
    positions = np.array(heard.states)[:, 0]
    assert 5e-4 < positions[:20].std() < 2e-3
    assert 0.0 < positions[-1] < 0.12, "0.1 s of 1 m/s, less what it came late"
    assert positions[-20:].mean() == pytest.approx(positions[-40:-20].mean(), abs=0.005)


def test_a_push_is_seen(bench: Bench, cart: dict[str, object]) -> None:
    heard = Heard(bench, **cart, push=5.0, push_duration=0.05)
    for _ in range(5):  # a plant that the machine held up begins anew, and forgets it
        assert bench.call("/plant/push").success
        heard.more(50)
        if heard.states[-1][0]:
            break
    assert heard.states[-1][0] == pytest.approx(5.0 * 0.05)


@MUJOCO
@pytest.mark.parametrize(("robot", "joints"), [("pendulum", 1), ("arm", 2)])
def test_a_mujoco_robot_publishes_noisy_angles_and_rates_at_100_hz(
    robot: str, joints: int, bench: Bench
) -> None:
    heard = Heard(bench, kind=f"mujoco_{robot}")
    heard.more(200)
    np.testing.assert_allclose(np.diff(heard.t), 0.01, atol=1e-6)
    spread = np.array(heard.states).std(axis=0)
    expected = np.repeat([1e-3, 1e-2], joints)  # rad, rad/s; it hangs at rest
    assert spread.shape == (2 * joints,)
    assert (0.7 * expected < spread).all()
    assert (spread < 1.4 * expected).all()


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
