"""A tube of every class over DDS: what the monitor says live is what a replay says, bit for bit."""

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from sensor_msgs.msg import JointState

from bags.chain.config import load_config
from bags.chain.joint_bags import COMMANDS, STATES
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.designs.bundle import Bundle
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.identified_bags import ONE, TWO, write_config, write_coupled_bags, write_saturating_bags
from tests.ros.processes import node_here, process, ros_test, stop
from tests.ros.robot import MONITOR, Robot

pytestmark = ros_test


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


def test_live_is_replay_for_every_class(tmp_path: Path) -> None:
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

    options = {"stale_after": 30.0, "command_wait": 1.0, "allow_old_stamps": True}
    with node_here("test_robot") as (node, spin_until):
        robot = Robot(node, spin_until, folders["linear"][0])
        node.create_subscription(JointState, "/funnel_monitor/margin", hear, qos.STREAM)
        sent = {t: node.create_publisher(JointState, t, qos.STREAM) for t in (COMMANDS, STATES)}
        for name, (folder, bag) in folders.items():
            robot.publish(Bundle.load(folder / documents.FUNNEL))
            with Bag(bag) as source:
                messages = [(m.log_time_ns, m.topic, m.data) for m in source.messages()]
            with process(MONITOR, **options) as monitor:
                spin_until(lambda: all(p.get_subscription_count() for p in sent.values()))
                heard.clear()
                while not heard:  # the monitor's new subscriptions are not there at once
                    for _, topic, data in messages[:2]:
                        sent[topic].publish(data)
                    until = time.monotonic() + 0.1
                    spin_until(lambda until=until: time.monotonic() > until)  # type: ignore[misc]
                robot.begin()
                for k, stamp in enumerate(sorted({at for at, *_ in messages})):
                    heard.pop(stamp, None)
                    both = sorted((topic, data) for at, topic, data in messages if at == stamp)
                    for topic, data in both[:: 1 if k % 2 else -1]:
                        sent[topic].publish(data)
                    spin_until(lambda stamp=stamp: stamp in heard)  # type: ignore[misc]
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
