"""The recorder over DDS: what is recorded is what was sent, whatever happens meanwhile."""

import os
import random
import signal
import subprocess
import sys
import time
from base64 import b85encode
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from nav_msgs.msg import Goals
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from bags.recordings.bag import Bag
from bags.recordings.definitions import standard_definition
from bags.recordings.message_types import decode, header_stamp_ns
from bags.samples import f1tenth
from nlsid_core.errors import BagError
from nlsid_ros import qos
from nlsid_ros.messages import stamp_of
from tests.mcap_files import three_readers
from tests.ros.processes import STARTED, Bench, ros_test, stop

pytestmark = ros_test

RECORDER = "trajectory_recorder"
TOPICS = ["/odom", "/cmd_vel", "/steering_command"]
TRIAL_05 = f1tenth()[4]
GOALS = "nav_msgs/msg/Goals"  # installed, but younger than the definitions that rosbags ships
SHARE = Path(sys.prefix) / "share"
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class Joints(Bench):
    """Publishes stamped joint positions, and calls the recorder's services."""

    def __init__(self, stack: ExitStack) -> None:
        super().__init__(stack)
        self.sent: list[bytes] = []
        self.joints = self.node.create_publisher(JointState, "/joints", qos.STREAM)

    def records(
        self, publisher: Publisher | None = None, /, **settings: object
    ) -> "subprocess.Popen[str]":
        """Start a recorder, and wait until it hears the publisher."""
        recorder = self.start(RECORDER, **settings)
        heard = publisher or self.joints
        self.spin_until(lambda: heard.get_subscription_count() == 1)
        return recorder

    def received(self, topic: str, count: int) -> None:
        """Wait until the recorder says that so many messages came on the topic."""

        def said() -> bool:
            heard = self.said.get(RECORDER, [])
            return bool(heard) and heard[-1][1].get(topic, "").startswith(f"received {count}, ")

        self.spin_until(said)

    def publish(self, count: int, *, every: float = 0.002, stamp_ns: int | None = None) -> None:
        """Publish so many joint states."""
        for _ in range(count):
            message = JointState(name=["wheel"], position=[float(len(self.sent))])
            message.header.stamp = stamp_of(time.time_ns() if stamp_ns is None else stamp_ns)
            self.sent.append(serialize_message(message))
            self.joints.publish(self.sent[-1])  # serialised: padding is as it happens to be
            time.sleep(every)

    def ask(self, what: str) -> tuple[bool, str]:
        """The recorder's answer."""
        answer = self.call(f"/{RECORDER}/{what}")
        return answer.success, answer.message


@pytest.fixture
def robot(stack: ExitStack) -> Joints:
    return Joints(stack)


def messages_on(bag: Path, topic: str) -> list[bytes]:
    with Bag(bag) as source:
        return [message.data for message in source.messages([topic])]


def test_a_bag_is_read_back_bit_equal_by_three_readers(robot: Joints, tmp_path: Path) -> None:
    bag = tmp_path / "run"
    recorder = robot.records(topics="[/joints]", bag=bag, chunk_period=0.05)
    robot.publish(700, every=0.0015)
    robot.received("/joints", len(robot.sent))
    stop(recorder)
    assert three_readers(bag, "/joints") == [robot.sent] * 3


@pytest.mark.parametrize("given", [True, False], ids=["msg file", "installed"])
def test_a_type_that_is_not_standard_is_recorded_with_its_definition(
    robot: Joints, tmp_path: Path, given: bool
) -> None:
    bag = tmp_path / "run"
    settings: dict[str, object] = {"topics": "[/goals]", "bag": bag, "snapshot": 10.0}
    if given:
        definition = SHARE / "nav_msgs" / "msg" / "Goals.msg"
        if not definition.is_file():
            pytest.skip("this ROS is installed elsewhere")
        settings |= {"definitions": f"[{definition}]"}
    with pytest.raises(BagError, match="not known"):
        standard_definition(GOALS)
    goals = robot.node.create_publisher(Goals, "/goals", qos.STREAM)
    message = Goals()
    message.header.frame_id = "map"
    serialised = serialize_message(message)
    recorder = robot.records(goals, **settings)
    goals.publish(serialised)
    robot.received("/goals", 1)
    assert robot.ask("snapshot")[0]
    stop(recorder)
    for recorded in (bag, tmp_path / "run_snapshot_1"):
        assert three_readers(recorded, "/goals") == [[serialised]] * 3
    with Bag(bag) as source:
        [raw] = source.messages()
        msgtype, types = source.types_on("/goals")
    assert decode(raw.data, msgtype, types).header.frame_id == "map"  # type: ignore[attr-defined]
    with AnyReader([bag]) as reader:
        [connection] = reader.connections
        assert reader.deserialize(raw.data, connection.msgtype).header.frame_id == "map"  # type: ignore[attr-defined]


def test_a_type_that_is_not_the_publishers_is_refused_by_name_and_the_others_go_on(
    robot: Joints, tmp_path: Path
) -> None:
    bag = tmp_path / "partly"
    robot.node.create_publisher(Goals, "/goals", qos.STREAM)
    recorder = robot.records(bag=bag, topics=["/joints", "/goals:=std_msgs/msg/String"])
    robot.hears("'std_msgs/msg/String' is published with hash RIHS01_", RECORDER)
    assert robot.levels[RECORDER] == DiagnosticStatus.ERROR
    robot.publish(3)
    time.sleep(0.3)
    assert "in the parameter definitions" in stop(recorder)
    assert three_readers(bag, "/joints") == [robot.sent] * 3


def test_a_definition_that_is_not_the_publishers_is_not_used(robot: Joints, tmp_path: Path) -> None:
    other = tmp_path / "nav_msgs" / "msg" / "Goals.msg"
    other.parent.mkdir(parents=True)
    other.write_text("float64 x\n")
    bag = tmp_path / "run"
    goals = robot.node.create_publisher(Goals, "/goals", qos.STREAM)
    recorder = robot.records(goals, topics="[/goals]", bag=bag, definitions=f"[{other}]")
    goals.publish(Goals())
    robot.received("/goals", 1)
    stop(recorder)
    with Bag(bag) as source:
        assert source.count("/goals") == 1
        _, types = source.types_on("/goals")
    assert [name for name, _ in types.fielddefs[GOALS][1]] == ["header", "goals"]


def test_bags_begin_and_end_when_asked_and_nothing_between_them_is_lost(
    robot: Joints, tmp_path: Path
) -> None:
    bag = tmp_path / "run"
    recorder = robot.records(topics="[/joints]", bag=bag, at_once=False)
    robot.hears("waiting for ~/start", RECORDER)
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
    assert three_readers(bag, "/joints") == [robot.sent[3:8]] * 3
    assert three_readers(Path(f"{bag}_2"), "/joints") == [robot.sent[8:]] * 3


def test_counts_are_in_the_diagnostics_and_the_bag(robot: Joints, tmp_path: Path) -> None:
    bag = tmp_path / "run"
    recorder = robot.records(topics="[/joints]", bag=bag)
    robot.publish(95)
    robot.received("/joints", 95)
    said = robot.said[RECORDER][-1][1]
    assert (said["topics"], said["messages"], said["lost"]) == ("1", "95", "0")
    assert said["/joints"] == "received 95, lost 0"
    stop(recorder)
    with Bag(bag) as source:
        kept = source.custom
    assert [kept[f"/joints {what}"] for what in ("received", "lost")] == ["95", "0"]


def test_messages_that_dds_lost_are_counted(robot: Joints, tmp_path: Path) -> None:
    bag = tmp_path / "run"
    sensor = robot.node.create_publisher(String, "/sensor", BEST_EFFORT)
    big, sent = String(data="x" * 20_000), 6000
    recorder = robot.records(sensor, topics="[/sensor]", bag=bag)
    sensor.publish(String(data="first"))
    time.sleep(0.5)
    recorder.send_signal(signal.SIGSTOP)
    for _ in range(sent):
        sensor.publish(big)
    recorder.send_signal(signal.SIGCONT)
    for _ in range(20):
        sensor.publish(String(data="last"))
        time.sleep(0.05)
    robot.hears("messages lost on /sensor", RECORDER)
    assert "messages lost" in stop(recorder)
    with Bag(bag) as source:
        lost, received = int(source.custom["/sensor lost"]), source.count("/sensor")
    assert lost > 0
    assert lost + received == sent + 21


def test_what_overflowed_while_the_recorder_could_not_take_it_is_counted(
    robot: Joints, tmp_path: Path
) -> None:
    bag = tmp_path / "run"
    recorder = robot.records(topics="[/joints]", bag=bag)
    robot.publish(10)
    time.sleep(0.5)
    recorder.send_signal(signal.SIGSTOP)
    robot.publish(12_000, every=0.0)
    recorder.send_signal(signal.SIGCONT)
    time.sleep(0.5)
    robot.publish(10, every=0.05)
    robot.hears("messages lost on /joints", RECORDER)
    stop(recorder)
    with Bag(bag) as source:
        lost, received = int(source.custom["/joints lost"]), source.count("/joints")
    assert lost > 1000
    assert lost + received == len(robot.sent)


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


def test_on_a_full_disk_all_that_came_before_is_kept_and_the_node_lives(
    robot: Joints, small_disk: Path
) -> None:
    bag = small_disk / "run"
    settings = {"topics": "[/noise]", "bag": bag, "least_free": 0.0}
    noise = robot.node.create_publisher(String, "/noise", qos.STREAM)
    recorder = robot.records(noise, **settings)
    for k in range(320):
        noise.publish(String(data=f"{k:08}" + b85encode(random.randbytes(40_000)).decode()))
        time.sleep(0.02)
    robot.hears("No space left on device", RECORDER)
    assert robot.levels[RECORDER] == DiagnosticStatus.ERROR
    assert robot.ask("stop")[1].startswith("recording stopped: [Errno 28]")
    assert recorder.poll() is None
    output = stop(recorder)
    assert "recording stopped: [Errno 28] No space left on device" in output
    assert "the bag is unfinished and will be repaired" in output
    assert "Traceback" not in output
    with Bag(bag, unfinished=True) as source:
        kept = [message.data for message in source.messages(["/noise"])]
    assert [int(data[8:16]) for data in kept] == list(range(len(kept)))
    assert 10e6 < len(kept) * 40_000 < 12 * 2**20  # random bytes in base 85, compressed


def test_a_trial_played_in_real_time_is_recorded_byte_for_byte(
    robot: Joints, tmp_path: Path
) -> None:
    bag = tmp_path / "recorded"
    recorder = robot.start(RECORDER, topics=TOPICS, bag=bag)
    robot.spin_until(lambda: RECORDER in robot.said)
    nothing = "; ".join(f"nothing on {topic} yet" for topic in TOPICS)
    assert robot.said[RECORDER][0][0] == nothing
    started = time.monotonic()
    player = robot.start("bag_player", bag=TRIAL_05)
    robot.received("/odom", 121)
    robot.received("/cmd_vel", 120)
    robot.spin_until(lambda: player.poll() is not None)
    assert player.returncode == 0
    assert time.monotonic() - started > 3.0, "a trial lasts 3 s"
    stop(recorder, signal.SIGINT)

    text, values = robot.said[RECORDER][-1]
    assert text == "recording"
    assert values["bag"] == str(bag)
    assert (values["messages"], values["lost"]) == ("361", "0")
    with Bag(bag) as source:
        assert source.custom["/odom received"] == "121"
    for topic in TOPICS:
        assert messages_on(bag, topic) == messages_on(TRIAL_05, topic)
    with (bag / "recorded.mcap").open("rb") as stream:
        recorded = [message for *_, message in make_reader(stream).iter_messages()]
    assert len(recorded) == 361
    assert [m.publish_time for m in recorded] == [header_stamp_ns(m.data) for m in recorded]
    arrivals = [m.log_time for m in recorded]
    assert (arrivals[-1] - arrivals[0]) / 1e9 > 2.9
    assert abs(time.time_ns() - arrivals[-1]) < 3600 * 10**9, "log time is the time of arrival"


def test_a_killed_recorder_loses_at_most_the_last_second(robot: Joints, tmp_path: Path) -> None:
    bag = tmp_path / "killed"
    recorder = robot.records(topics=["/joints"], bag=bag)
    robot.publish(1250)
    recorder.kill()
    killed_ns = time.time_ns()
    recorder.wait()
    sent = list(map(header_stamp_ns, robot.sent))

    kept: list[int] = []
    with (bag / "killed.mcap").open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, McapMessage):
                    kept += [header_stamp_ns(record.data)]
        except EndOfFile:
            pass
    assert kept == sent[: len(kept)]
    assert len(kept) > 500
    assert all((killed_ns - stamp_ns) / 1e9 <= 1.0 for stamp_ns in sent[len(kept) :])

    recorder = robot.start(RECORDER, topics=["/joints"], bag=tmp_path / "next")
    robot.spin_until((tmp_path / "next").exists)
    assert f"{bag} was not closed; repaired, {len(kept)} messages kept" in stop(recorder)
    assert three_readers(bag, "/joints") == [robot.sent[: len(kept)]] * 3


def test_sigterm_closes_the_bag(robot: Joints, tmp_path: Path) -> None:
    bag = tmp_path / "terminated"
    typed = "['odom:=nav_msgs/msg/Odometry', '/never:=std_msgs/msg/String']"
    recorder = robot.start(RECORDER, topics=typed, bag=bag)
    assert robot.start("bag_player", bag=TRIAL_05, topics=["/odom"]).wait(timeout=STARTED) == 0
    robot.received("/odom", 121)
    stop(recorder, signal.SIGTERM)
    assert messages_on(bag, "/odom") == messages_on(TRIAL_05, "/odom")


def test_best_effort_topics_and_documents_latched_before_the_start_are_recorded(
    robot: Joints, tmp_path: Path
) -> None:
    bag = tmp_path / "mixed"
    latched = robot.node.create_publisher(String, "/document", qos.DOCUMENT)
    latched.publish(String(data="published before the recording"))
    sensor = robot.node.create_publisher(String, "/sensor", BEST_EFFORT)
    recorder = robot.records(sensor, topics=["/document", "/sensor"], bag=bag)
    robot.received("/document", 1)
    for _ in range(5):
        sensor.publish(String(data="reading"))
        time.sleep(0.05)
    time.sleep(0.3)
    stop(recorder)
    assert b"published before the recording" in messages_on(bag, "/document")[0]
    assert len(messages_on(bag, "/sensor")) >= 4
    with Bag(bag) as recorded:
        assert [profile.latched for profile in recorded.offered("/document")] == [True]
        [sensed] = recorded.offered("/sensor")
        assert (sensed.reliability, sensed.durability) == ("best_effort", "volatile")
        assert qos.playing_of(recorded.offered("/document")).durability == qos.DOCUMENT.durability


def test_patterns_and_snapshots(robot: Joints, tmp_path: Path) -> None:
    bag = tmp_path / "patterned"
    names = ("/robot/a", "/robot/b", "/other")
    a, b, other = (robot.node.create_publisher(String, name, qos.STREAM) for name in names)
    recorder = robot.records(a, topics="['/robot/*']", bag=bag, snapshot=60.0)
    robot.spin_until(lambda: b.get_subscription_count() == 1)
    assert other.get_subscription_count() == 0
    for publisher in (a, b):
        publisher.publish(String(data="before"))
    robot.received("/robot/b", 1)
    robot.received("/robot/a", 1)
    assert robot.ask("stop") == (True, f"{bag} is closed")
    a.publish(String(data="after"))
    time.sleep(0.3)
    assert robot.ask("snapshot")[1].startswith("3 messages in ")
    stop(recorder)
    assert [m[8:].rstrip(b"\0") for m in messages_on(bag, "/robot/a")] == [b"before"]
    assert len(messages_on(bag, "/robot/b")) == 1
    snapshot = tmp_path / "patterned_snapshot_1"
    texts = [m[8:].rstrip(b"\0") for m in messages_on(snapshot, "/robot/a")]
    assert texts == [b"before", b"after"]


def test_in_simulated_time_log_times_are_the_simulations(robot: Joints, tmp_path: Path) -> None:
    """The simulation runs at a tenth of real time and starts at 100 s."""
    bag = tmp_path / "run"
    clock = robot.node.create_publisher(Clock, "/clock", qos.STREAM)
    recorder = robot.records(bag=bag, topics="[/joints]", use_sim_time=True)
    robot.spin_until(lambda: clock.get_subscription_count() == 1)
    began = time.monotonic()
    while (t := time.monotonic() - began) < 3.0:
        now_ns = 100 * 10**9 + round(t * 1e8)
        clock.publish(Clock(clock=stamp_of(now_ns)))
        if t > 1.0:
            robot.publish(1, stamp_ns=now_ns)
        robot.waits(0.01)
    stop(recorder)
    with Bag(bag) as source:
        heard = [(m.log_time_ns, header_stamp_ns(m.data)) for m in source.messages(["/joints"])]
    assert len(heard) == len(robot.sent)
    assert all(100.05 < log_ns / 1e9 < 100.5 for log_ns, _ in heard)
    late = sorted(abs(log_ns - stamp_ns) for log_ns, stamp_ns in heard)
    assert late[len(late) // 2] < 20e6, "half of them within 0.2 s of real time"
    assert len({log_ns for log_ns, _ in heard}) > len(heard) // 2, "not one time for each look"
