"""A tube around the model's own simulation over DDS: what ends a run, and what begins the next.

Of every class of models, what the monitor says live is what a replay says, bit for bit.
"""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from visualization_msgs.msg import Marker, MarkerArray

from bags.chain.config import FunnelConfig, load_config
from bags.chain.joint_bags import COMMANDS, STATES
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.designs.bundle import Bundle
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from nlsid import OutputTube, Status, design, f1tenth
from nlsid_core.arrays import FloatArray
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.models import Signal
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre
from nlsid_core.running.plants import ModelPlant
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of, stamp_of
from tests import implicit_models
from tests.core.kernel.tube_claims import MODELS, dataset
from tests.identified_bags import ONE, TWO, write_config, write_coupled_bags, write_saturating_bags
from tests.ros.processes import ros_test, stop
from tests.ros.robot import PERIOD_NS, Robot

pytestmark = ros_test


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The car's tube without a plan: `funnel: {}`."""
    out = tmp_path_factory.mktemp("tube")
    config = load_config(config_file("f1tenth.yaml"))
    config = config.model_copy(update={"funnel": FunnelConfig()})
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    return out


def at_rest(_k: int) -> float:
    """No speed at any sample."""
    return 0.0


class Car(Robot):
    """A car that is watched by a tube, and hears its margins and forecasts by stamp (ns)."""

    def __init__(self, stack: ExitStack, folder: Path, **settings: object) -> None:
        super().__init__(stack, folder)
        self.margins: dict[int, float] = {}
        self.forecasts: dict[int, dict[str, float]] = {}
        self.listen(JointState, "/funnel_monitor/margin", self._hear_margin)
        self.listen(JointState, "/funnel_monitor/forecast", self._hear_forecast)
        self.start("funnel_monitor", stale_after=5.0, allow_old_stamps=True, **settings)
        self.ready()
        self.k = -1  # of the newest sample

    def _hear_margin(self, message: JointState) -> None:
        self.margins[stamp_ns_of(message)] = message.position[message.name.index("margin")]

    def _hear_forecast(self, message: JointState) -> None:
        numbers = zip(message.name, message.position, strict=True)
        self.forecasts[stamp_ns_of(message)] = dict(numbers)

    def drive_until(
        self, done: Callable[[], bool], speed: Callable[[int], float] = at_rest
    ) -> None:
        """Sample by sample; the speed of each."""
        while not done():
            self.k += 1
            self.drive([self.k], speed=speed(self.k))
            assert self.k < 400, self.said


def test_an_unknown_command_ends_the_run_and_a_new_one_begins_by_itself(
    stack: ExitStack, tube: Path
) -> None:
    def stamp_ns(k: int) -> int:
        return 10**18 + k * PERIOD_NS

    robot = Car(stack, tube)
    robot.drive_until(lambda: any(margin >= 0.0 for margin in robot.margins.values()))
    bad = robot.k + 1
    unknown = TwistStamped()
    unknown.header.stamp = stamp_of(stamp_ns(bad))
    unknown.twist.linear.x = math.nan
    robot.command.publish(unknown)
    robot.drive_until(  # a command comes again at that stamp: the first one counts
        lambda: any(m >= 0.0 for at, m in robot.margins.items() if at > stamp_ns(bad))
    )
    assert math.isnan(robot.margins[stamp_ns(bad)])
    assert math.isnan(robot.margins[stamp_ns(bad + 1)]), "a new run takes samples to begin"


def test_forecasts_are_published_for_later_stamps_and_hold_what_then_comes(
    stack: ExitStack, tube: Path
) -> None:
    robot = Car(stack, tube, forecast=0.25)
    robot.drive_until(lambda: len(robot.forecasts) >= 5)
    for stamp_ns, numbers in robot.forecasts.items():
        assert (stamp_ns - 10**18) % PERIOD_NS == 0
        assert stamp_ns - 10**18 <= (robot.k + 10) * PERIOD_NS
        assert numbers["ahead"] == pytest.approx(0.25)
        assert numbers["low"] < 0.0 < numbers["high"], "the car stands still, as it is told"


class Sprung(Car):
    """A robot on a cubic spring, watched by a tube that is proved for commands up to 1.5 N."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        model = replace(
            implicit_models.cubic_spring(),
            y=(Signal("speed", "m/s", "/odom:twist.twist.linear.x"),),
            u=(Signal("force", "N", "/cmd_vel:twist.linear.x"),),
            window=((0, 0),),
        )
        box = ((-1.5, 1.5), (-1.0, 1.5))
        made = design(OutputTube(model, dataset(model, 0), dataset(model, 100), box=box))
        made.save(folder)
        self.period = model.period
        super().__init__(stack, folder)

    def send(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """Send outputs (N,) and commands (N,) sample by sample; the margins (N,)."""
        stamps = [10**18 + round(k * self.period * 1e9) for k in range(len(y))]
        for k, stamp in enumerate(stamps):
            command, state = TwistStamped(), Odometry()
            for message in (command, state):
                message.header.stamp = stamp_of(stamp)
            command.twist.linear.x, state.twist.twist.linear.x = float(u[k]), float(y[k])
            self.command.publish(command)
            self.odom.publish(state)
            self.spin_until(lambda stamp=stamp: stamp in self.margins)  # type: ignore[misc]
        return np.array([self.margins[stamp] for stamp in stamps])


def test_a_named_part_that_no_longer_comes_is_missed_though_others_go_on(
    stack: ExitStack, tmp_path: Path
) -> None:
    """As of transforms that share a topic."""
    model = MODELS["linear"]()
    place = "/markers:markers[ns=base].pose.position.x|clock(log)|linear(0.5 s)"
    y = replace(model.y, path=place)
    u = replace(model.u, path="/cmd_vel:twist.linear.x|clock(log)")
    model = replace(model, y=y, u=u)
    design(OutputTube(model, dataset(model, 0), dataset(model, 100))).save(tmp_path)
    robot, parts = Robot(stack, tmp_path), [Marker(ns="other"), Marker(ns="base")]
    parts[1].pose.position.x = float(ModelPlant(model).measure(np.zeros(1))[0])
    markers = robot.node.create_publisher(MarkerArray, "/markers", qos.STREAM)
    robot.node.create_timer(model.period, lambda: markers.publish(MarkerArray(markers=parts)))
    robot.node.create_timer(model.period, lambda: robot.command.publish(TwistStamped()))
    robot.watched(stale_after=1.0)
    robot.spin_until(lambda: robot.said["funnel_monitor"][-1][1]["now"] == "inside")
    parts.pop()
    robot.spin_until(lambda: robot.has_said("no speed for 1 s"))


def test_a_box_that_is_left_is_named_and_nothing_is_judged_there(
    stack: ExitStack, tmp_path: Path
) -> None:
    far = 50
    trial = dataset(MODELS["implicit_box"](), 300, 1, 100).trajectories[0]
    u = trial.u[:, 0].copy()
    u[far] = 1.6
    robot = Sprung(stack, tmp_path)
    margins = robot.send(trial.y[:, 0], u)
    robot.hears("outside the box in which the tube is proved")
    assert (margins[20:far] >= 0.0).all()
    assert not (margins[far : far + 2] >= 0.0).any()
    assert np.isnan(margins[far])
    assert (margins[far + 10 :] >= 0.0).all(), "a new run begins inside the box"


def test_innovations_that_add_up_on_one_side_warn_while_the_tube_is_kept(
    stack: ExitStack, tmp_path: Path
) -> None:
    trial = dataset(MODELS["implicit_box"](), 300, 1, 100).trajectories[0]
    y = trial.y[:, 0].copy()
    y[40:] += 0.1  # m/s: within what is assumed
    robot = Sprung(stack, tmp_path)
    margins = robot.send(y, trial.u[:, 0])
    robot.hears("cusum alarm")
    assert (margins[20:] >= 0.0).all(), "it changes no verdict"
    assert not robot.has_said("above the level")


def made(name: str, bags: Path, folder: Path) -> Path:
    """The class's tube, whose level follows the commands."""
    counts = {} if name in ONE else {"outputs": 2, "inputs": 2}
    funnel = {"safety_factor": 1.5, "level": "commands"}
    config = load_config(
        write_config(folder / "config.yaml", (ONE | TWO)[name], **counts, funnel=funnel)
    )
    identify_bags(sorted(bags.glob("run_*")), config, folder, progress=silent)
    design_funnel_files(folder / documents.MODEL, config, folder)
    return folder


def test_live_is_replay_for_every_class(stack: ExitStack, tmp_path: Path) -> None:
    """Every second command comes after its response."""
    folders = {}
    for name in (*ONE, *TWO):
        (tmp_path / name).mkdir()
        bags = tmp_path / ("one" if name in ONE else "two")
        if not bags.exists():
            bags.mkdir()
            (write_saturating_bags if name in ONE else write_coupled_bags)(bags)
        folders[name] = made(name, bags, tmp_path / name), bags / "run_5"
    heard: dict[int, list[float]] = {}

    def hear(message: JointState) -> None:
        heard[stamp_ns_of(message)] = list(message.position)

    robot = Robot(stack, folders["linear"][0])
    robot.listen(JointState, "/funnel_monitor/margin", hear)
    topics = (COMMANDS, STATES)
    sent = {t: robot.node.create_publisher(JointState, t, qos.STREAM) for t in topics}
    options = {"stale_after": 30.0, "command_wait": 1.0, "allow_old_stamps": True}
    for name, (folder, bag) in folders.items():
        robot.publish(Bundle.load(folder / documents.FUNNEL))
        with Bag(bag) as source:
            messages = [(m.log_time_ns, m.topic, m.data) for m in source.messages()]
        monitor = robot.start("funnel_monitor", **options)
        robot.spin_until(lambda: all(p.get_subscription_count() for p in sent.values()))
        heard.clear()
        while not heard:  # the monitor's new subscriptions are not there at once
            for _, topic, data in messages[:2]:
                sent[topic].publish(data)
            robot.waits(0.1)
        robot.begin()
        for k, stamp in enumerate(sorted({at for at, *_ in messages})):
            heard.pop(stamp, None)
            both = sorted((topic, data) for at, topic, data in messages if at == stamp)
            for topic, data in both[:: 1 if k % 2 else -1]:
                sent[topic].publish(data)
            robot.spin_until(lambda stamp=stamp: stamp in heard)  # type: ignore[misc]
        stop(monitor)
        proved = documents.load(folder / documents.FUNNEL)
        funnel = proved.funnel
        assert isinstance(funnel, TubeFunnel)
        assert funnel.tubes[0].follows is not None
        replayed = replay_bag(proved, bag, centre=Centre.COMMAND)
        assert sum(r.status is not Status.UNKNOWN for r in replayed.readings) > 150
        assert sorted(heard) == list(replayed.stamps_ns)
        for stamp, reading in zip(replayed.stamps_ns, replayed.readings, strict=True):
            said = list(reading.numbers.values())
            assert np.array_equal(heard[stamp][: len(said)], said, equal_nan=True), name
