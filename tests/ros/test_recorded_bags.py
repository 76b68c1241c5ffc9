"""The recorder's bags: split, compressed, of custom types, one after another, on full disks."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Goals
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from bags.recordings.bag import Bag
from bags.recordings.definitions import standard_definition
from bags.recordings.message_types import decode
from nlsid_core.errors import BagError
from nlsid_ros import qos
from tests.ros.processes import SpinUntil, call, node_here, process, ros_test, stop

pytestmark = ros_test

RECORDER = "nlsid_ros.trajectory_recorder"
GOALS = "nav_msgs/msg/Goals"  # installed, but younger than the definitions that rosbags ships
SHARE = Path(sys.prefix) / "share"


class Robot:
    """Publishes stamped joint positions, hears diagnostics, calls the recorder's services."""

    def __init__(self, node: Node, spin_until: SpinUntil) -> None:
        self.node, self.spin_until = node, spin_until
        self.sent: list[bytes] = []
        self.joints = node.create_publisher(JointState, "/joints", qos.STREAM)
        self.said: list[tuple[bytes, str, dict[str, str]]] = []
        node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, qos.EVENTS)

    def _hear(self, message: DiagnosticArray) -> None:
        for each in message.status:
            values = {pair.key: pair.value for pair in each.values}
            self.said.append((each.level, each.message, values))

    def has_said(self, text: str) -> bool:
        return any(text in message for _, message, _ in self.said)

    def received(self, topic: str, count: int) -> bool:
        """Whether the last report says that so many messages came on the topic."""
        return bool(self.said) and self.said[-1][2].get(f"{topic} received") == str(count)

    def ready(self, publisher: Publisher | None = None) -> None:
        self.spin_until(lambda: (publisher or self.joints).get_subscription_count() == 1)

    def publish(self, count: int, *, every: float = 0.002, stamp_ns: int | None = None) -> None:
        for _ in range(count):
            k = len(self.sent)
            message = JointState(name=["wheel"], position=[float(k)])
            now_ns = time.time_ns() if stamp_ns is None else stamp_ns
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
            self.sent.append(serialize_message(message))
            self.joints.publish(self.sent[-1])  # serialised: padding is as it happens to be
            time.sleep(every)

    def ask(self, what: str) -> tuple[bool, str]:
        answer = call(self.node, self.spin_until, f"/trajectory_recorder/{what}")
        return answer.success, answer.message


@pytest.fixture
def robot() -> Iterator[Robot]:
    with node_here("test_robot") as (node, spin_until):
        yield Robot(node, spin_until)


def data_by_three_readers(bag: Path, topic: str) -> list[list[bytes]]:
    """The messages on a topic as we, rosbags and mcap read them."""
    with Bag(bag) as source:
        files, ours = source.files, [m.data for m in source.messages([topic])]
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        rosbags = [bytes(data) for _, _, data in reader.messages(wanted)]
    mcap: list[bytes] = []
    for file in files:
        with file.open("rb") as stream:
            reading = make_reader(stream, validate_crcs=True).iter_messages([topic])
            mcap += [message.data for *_, message in reading]
    return [ours, rosbags, mcap]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("split", [{"split_time": 0.5}, {"split_size": 0.05}], ids=str)
def test_a_split_bag_is_read_back_bit_equal_by_three_readers(
    robot: Robot, tmp_path: Path, compression: str, split: dict[str, object]
) -> None:
    bag = tmp_path / "run"
    settings = {"topics": "[/joints]", "bag": bag, "compression": compression, **split}
    with process(RECORDER, **settings, chunk_period=0.05) as recorder:
        robot.ready()
        robot.publish(700 if "split_time" in split else 1600, every=0.0015)
        robot.spin_until(lambda: robot.received("/joints", len(robot.sent)))
        stop(recorder)
    with Bag(bag) as source:
        names = [file.name for file in source.files]
    assert len(names) >= 2
    assert names == [f"run_{k}.mcap" for k in range(len(names))]
    assert data_by_three_readers(bag, "/joints") == [robot.sent] * 3


@pytest.mark.parametrize("given", [True, False], ids=["msg file", "type description"])
def test_a_type_that_is_not_standard_is_recorded_with_its_definition(
    robot: Robot, tmp_path: Path, given: bool
) -> None:
    bag = tmp_path / "run"
    settings: dict[str, object] = {"topics": "[/goals]", "bag": bag, "snapshot": 10.0}
    if given:
        definition = SHARE / "nav_msgs" / "msg" / "Goals.msg"
        if not definition.is_file():
            pytest.skip("this ROS is installed elsewhere")
        settings |= {"definitions": f"[{definition}]", "start_type_description_service": False}
    with pytest.raises(BagError, match="not known"):
        standard_definition(GOALS)
    goals = robot.node.create_publisher(Goals, "/goals", qos.STREAM)
    message = Goals()
    message.header.frame_id = "map"
    serialised = serialize_message(message)
    with process(RECORDER, **settings) as recorder:
        robot.ready(goals)
        goals.publish(serialised)
        robot.spin_until(lambda: robot.received("/goals", 1))
        assert robot.ask("snapshot")[0]
        stop(recorder)
    for recorded in (bag, tmp_path / "run_snapshot_1"):
        assert data_by_three_readers(recorded, "/goals") == [[serialised]] * 3
    with Bag(bag) as source:
        [raw] = source.messages()
        msgtype, types = source.types_on("/goals")
    assert decode(raw.data, msgtype, types).header.frame_id == "map"  # type: ignore[attr-defined]
    with AnyReader([bag]) as reader:
        [connection] = reader.connections
        assert reader.deserialize(raw.data, connection.msgtype).header.frame_id == "map"  # type: ignore[attr-defined]


def test_a_type_nobody_describes_is_refused_by_name_and_the_others_go_on(
    robot: Robot, tmp_path: Path
) -> None:
    bag = tmp_path / "partly"
    robot.node.create_publisher(Goals, "/goals", qos.STREAM)
    settings = {"topics": ["/joints", "/goals"], "start_type_description_service": False}
    with process(RECORDER, bag=bag, **settings) as recorder:
        robot.ready()
        robot.spin_until(lambda: robot.has_said(f"'{GOALS}' is not known; give its Goals.msg"))
        assert robot.said[-1][0] == DiagnosticStatus.ERROR
        robot.publish(3)
        time.sleep(0.3)
        output = stop(recorder)
    assert "in the parameter definitions" in output
    assert data_by_three_readers(bag, "/joints") == [robot.sent] * 3


@pytest.mark.parametrize("described", [True, False])
def test_a_definition_that_is_not_the_publishers_is_not_used(
    robot: Robot, tmp_path: Path, described: bool
) -> None:
    other = tmp_path / "nav_msgs" / "msg" / "Goals.msg"
    other.parent.mkdir(parents=True)
    other.write_text("float64 x\n")
    settings = {
        "topics": "[/goals]",
        "bag": tmp_path / "run",
        "definitions": f"[{other}]",
        "start_type_description_service": described,
    }
    goals = robot.node.create_publisher(Goals, "/goals", qos.STREAM)
    with process(RECORDER, **settings) as recorder:
        robot.ready(goals)
        goals.publish(Goals())
        if described:
            robot.spin_until(lambda: robot.received("/goals", 1))
        else:
            robot.spin_until(lambda: robot.has_said(f"'{GOALS}' is published with hash RIHS01_"))
        stop(recorder)
    with Bag(tmp_path / "run") as source:
        assert source.count("/goals") == int(described)
        if described:
            _, types = source.types_on("/goals")
            assert [name for name, _ in types.fielddefs[GOALS][1]] == ["header", "goals"]


def test_bags_begin_and_end_when_asked_and_nothing_between_them_is_lost(
    robot: Robot, tmp_path: Path
) -> None:
    bag = tmp_path / "run"
    with process(RECORDER, topics="[/joints]", bag=bag, at_once=False) as recorder:
        robot.ready()
        robot.spin_until(lambda: robot.has_said("waiting for ~/start"))
        robot.publish(3)
        assert robot.ask("stop") == (False, "nothing is being recorded")
        assert robot.ask("start") == (True, str(bag))
        assert robot.ask("start") == (False, f"recording {bag} already")
        robot.publish(5)
        time.sleep(0.2)
        assert robot.ask("stop") == (True, f"{bag} is closed")
        assert (bag / "metadata.yaml").is_file(), "closed while the node runs on"
        assert robot.ask("start") == (True, f"{bag}_2")
        robot.publish(4)
        time.sleep(0.2)
        stop(recorder)
    assert data_by_three_readers(bag, "/joints") == [robot.sent[3:8]] * 3
    assert data_by_three_readers(Path(f"{bag}_2"), "/joints") == [robot.sent[8:]] * 3


def test_gaps_in_the_stamps_rate_and_jitter_are_in_the_diagnostics_and_the_bag(
    robot: Robot, tmp_path: Path
) -> None:
    bag = tmp_path / "run"
    base, period = 10**18, 10_000_000
    with process(RECORDER, topics="[/joints]", bag=bag) as recorder:
        robot.ready()
        for k in [*range(50), *range(53, 80), *range(82, 100)]:
            robot.publish(1, stamp_ns=base + k * period + (100_000 if k % 2 else 0))
        robot.spin_until(lambda: robot.received("/joints", 95))
        said = robot.said[-1][2]
        stop(recorder)
    with Bag(bag) as source:
        kept = source.custom
    for values in (said, kept):
        assert values["/joints received"] == "95"
        assert values["/joints lost"] == "0"
        assert values["/joints gaps"] == "2"
        assert float(values["/joints rate [Hz]"]) == pytest.approx(100.0, rel=0.02)
        assert float(values["/joints jitter [ms]"]) == pytest.approx(0.1, rel=0.1)


def test_messages_that_dds_lost_are_counted(robot: Robot, tmp_path: Path) -> None:
    bag = tmp_path / "run"
    hasty = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    sensor = robot.node.create_publisher(String, "/sensor", hasty)
    big, sent = String(data="x" * 20_000), 6000
    with process(RECORDER, topics="[/sensor]", bag=bag) as recorder:
        robot.ready(sensor)
        sensor.publish(String(data="first"))
        time.sleep(0.5)
        recorder.send_signal(signal.SIGSTOP)
        for _ in range(sent):
            sensor.publish(big)
        recorder.send_signal(signal.SIGCONT)
        for _ in range(20):
            sensor.publish(String(data="last"))
            time.sleep(0.05)
        robot.spin_until(lambda: robot.has_said("messages lost on /sensor"))
        output = stop(recorder)
    assert "messages lost" in output
    with Bag(bag) as source:
        lost, received = int(source.custom["/sensor lost"]), source.count("/sensor")
    assert lost > 0
    assert lost + received == sent + 21


def test_what_overflowed_while_the_recorder_could_not_take_it_is_counted(
    robot: Robot, tmp_path: Path
) -> None:
    bag = tmp_path / "run"
    with process(RECORDER, topics="[/joints]", bag=bag) as recorder:
        robot.ready()
        robot.publish(10)
        time.sleep(0.5)
        recorder.send_signal(signal.SIGSTOP)
        robot.publish(12_000, every=0.0)
        recorder.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        robot.publish(10, every=0.05)
        robot.spin_until(lambda: robot.has_said("messages lost on /joints"))
        stop(recorder)
    with Bag(bag) as source:
        lost, received = int(source.custom["/joints lost"]), source.count("/joints")
    assert lost > 1000
    assert lost + received == len(robot.sent)


def test_a_later_publisher_that_offers_less_is_named(robot: Robot, tmp_path: Path) -> None:
    with process(RECORDER, topics="[/joints]", bag=tmp_path / "run") as recorder:
        robot.ready()
        robot.publish(3)
        hasty = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        robot.node.create_publisher(JointState, "/joints", hasty)
        robot.spin_until(lambda: robot.has_said("came later and offers less (Best effort"))
        stop(recorder)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 12 MB in memory."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(folder)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small tmpfs needs root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_on_a_full_disk_all_that_came_before_is_in_a_closed_bag_and_the_node_lives(
    robot: Robot, small_disk: Path
) -> None:
    bag = small_disk / "run"
    settings = {"topics": "[/noise]", "bag": bag, "least_free": 0.0, "compression": "none"}
    noise = robot.node.create_publisher(String, "/noise", qos.STREAM)
    with process(RECORDER, **settings) as recorder:
        robot.ready(noise)
        for k in range(120):
            noise.publish(String(data=f"{k:08}" + "x" * 50_000))
            time.sleep(0.02)
        robot.spin_until(lambda: robot.has_said("No space left on device"))
        assert robot.said[-1][0] == DiagnosticStatus.ERROR
        assert robot.ask("stop")[1].startswith("recording stopped: [Errno 28]")
        assert recorder.poll() is None
        output = stop(recorder)
    assert "recording stopped: [Errno 28] No space left on device" in output
    assert "Traceback" not in output
    ours, rosbags, mcap = data_by_three_readers(bag, "/noise")
    assert ours == rosbags == mcap
    assert [int(data[8:16]) for data in ours] == list(range(len(ours)))
    assert 4e6 < len(ours) * 50_000 < 12e6
    with Bag(bag) as source:
        assert source.custom["ended"].startswith("recording stopped: [Errno 28]")
