"""Recorder and player as processes over DDS: what is recorded is what was sent."""

import signal
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from bags.recordings.bag import Bag
from bags.recordings.message_types import header_stamp_ns
from bags.samples import f1tenth
from nlsid_ros import qos
from tests.ros.processes import STARTED, call, node_here, process, refusal, ros_test, stop

pytestmark = ros_test

RECORDER = "nlsid_ros.trajectory_recorder"
PLAYER = "nlsid_ros.bag_player"
TOPICS = ["/odom", "/cmd_vel", "/steering_command"]
TRIAL_05 = f1tenth()[4]


def messages_on(bag: Path, topic: str) -> list[bytes]:
    with Bag(bag) as source:
        return [message.data for message in source.messages([topic])]


def test_a_trial_played_in_real_time_is_recorded_byte_for_byte(tmp_path: Path) -> None:
    bag = tmp_path / "recorded"
    reports: list[dict[str, str]] = []
    texts: list[str] = []

    def report(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "trajectory_recorder":
                texts.append(status.message)
                reports.append({pair.key: pair.value for pair in status.values})

    def all_received() -> bool:
        return bool(reports) and reports[-1].get("/odom received") == "121"

    with (
        node_here("test_observer") as (node, spin_until),
        process(RECORDER, topics=TOPICS, bag=bag) as recorder,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", report, qos.EVENTS)
        spin_until(lambda: bool(reports))
        assert texts[0] == "; ".join(f"nothing on {topic} yet" for topic in TOPICS)
        started = time.monotonic()
        with process(PLAYER, bag=TRIAL_05) as player:
            spin_until(all_received)
            output = player.communicate()[0]
            assert player.returncode == 0, output
        assert time.monotonic() - started > 3.0, "a trial lasts 3 s"
        stop(recorder, signal.SIGINT)

    assert texts[-1] == "recording"
    expected = {
        "bag": str(bag),
        "/odom received": "121",
        "/odom lost": "0",
        "/cmd_vel received": "120",
        "/cmd_vel lost": "0",
        "/steering_command received": "120",
        "/steering_command lost": "0",
    }
    assert expected.items() <= reports[-1].items()
    assert float(reports[-1]["/odom rate [Hz]"]) == pytest.approx(40.0, rel=0.01)
    with Bag(bag) as source:
        assert source.custom["/odom received"] == "121"
    for topic in TOPICS:
        assert messages_on(bag, topic) == messages_on(TRIAL_05, topic)
    with (bag / "recorded.mcap").open("rb") as stream:
        recorded = [message for *_, message in make_reader(stream).iter_messages()]
    assert len(recorded) == 361
    assert [m.publish_time for m in recorded] == [header_stamp_ns(m.data) for m in recorded]
    arrivals = [m.log_time for m in recorded]
    assert 2.9 < (arrivals[-1] - arrivals[0]) / 1e9 < 3.5
    assert abs(time.time_ns() - arrivals[-1]) < 60 * 10**9, "log time is the time of arrival"


def test_a_killed_recorder_loses_at_most_the_last_second(tmp_path: Path) -> None:
    bag = tmp_path / "killed"
    sent: list[int] = []
    with (
        node_here("test_robot") as (node, spin_until),
        process(RECORDER, topics=["/joints"], bag=bag) as recorder,
    ):
        publisher = node.create_publisher(JointState, "/joints", qos.STREAM)
        spin_until(lambda: publisher.get_subscription_count() == 1)

        def publish() -> None:
            sent.append(time.time_ns())
            message = JointState(name=["wheel"], position=[float(len(sent))])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(sent[-1], 10**9)
            publisher.publish(message)

        node.create_timer(0.002, publish)
        spin_until(lambda: len(sent) >= 1250)
        recorder.kill()
        recorder.wait()
        killed_ns = time.time_ns()

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
    lost = sent[len(kept) :]
    assert all((killed_ns - stamp_ns) / 1e9 <= 1.0 for stamp_ns in lost)

    with process(RECORDER, topics=["/joints"], bag=tmp_path / "next") as recorder:
        while not (tmp_path / "next").exists():
            time.sleep(0.05)
        assert recorder.poll() is None
        output = stop(recorder)
    assert f"{bag} was not closed; repaired, {len(kept)} messages kept" in output
    with AnyReader([bag]) as reader:
        assert [header_stamp_ns(bytes(data)) for *_, data in reader.messages()] == kept
    with (bag / "killed.mcap").open("rb") as stream:
        finished = [m.data for *_, m in make_reader(stream, validate_crcs=True).iter_messages()]
    assert list(map(header_stamp_ns, finished)) == kept


def test_sigterm_closes_the_bag(tmp_path: Path) -> None:
    bag = tmp_path / "terminated"
    typed = "['odom:=nav_msgs/msg/Odometry', '/never:=std_msgs/msg/String']"
    with process(RECORDER, topics=typed, bag=bag) as recorder:
        with process(PLAYER, bag=TRIAL_05, topics=["/odom"], rate=50.0) as player:
            assert player.wait(timeout=STARTED) == 0
        time.sleep(0.2)
        stop(recorder, signal.SIGTERM)
    assert messages_on(bag, "/odom") == messages_on(TRIAL_05, "/odom")


def test_best_effort_topics_and_documents_latched_before_the_start_are_recorded(
    tmp_path: Path,
) -> None:
    bag = tmp_path / "mixed"
    with node_here("test_robot") as (node, spin_until):
        latched = node.create_publisher(String, "/document", qos.DOCUMENT)
        latched.publish(String(data="published before the recording"))
        best_effort = QoSProfile(
            depth=10,
            reliability=ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE,
        )
        sensor = node.create_publisher(String, "/sensor", best_effort)
        with process(RECORDER, topics=["/document", "/sensor"], bag=bag) as recorder:
            spin_until(lambda: sensor.get_subscription_count() == 1)
            spin_until(lambda: latched.get_subscription_count() == 1)
            for _ in range(5):
                sensor.publish(String(data="reading"))
                time.sleep(0.05)
            time.sleep(0.3)
            stop(recorder)
    assert len(messages_on(bag, "/document")) == 1
    assert b"published before the recording" in messages_on(bag, "/document")[0]
    assert len(messages_on(bag, "/sensor")) >= 4
    with Bag(bag) as recorded:
        assert [profile.latched for profile in recorded.offered("/document")] == [True]
        [sensed] = recorded.offered("/sensor")
        assert (sensed.reliability, sensed.durability) == ("best_effort", "volatile")
        assert qos.playing_of(recorded.offered("/document")).durability == qos.DOCUMENT.durability


@pytest.mark.parametrize(
    ("module", "parameters", "message"),
    [
        (RECORDER, {}, "no topics to record; set the parameter topics"),
        (RECORDER, {"topics": "['/x:=os/system']"}, "'os/system' is not a message type"),
        (RECORDER, {"topics": "['/x:=no_such_msgs/msg/Y']"}, "no_such_msgs/msg/Y"),
        (RECORDER, {"topics": "[/x]", "bag": TRIAL_05}, "trial_05 exists already"),
        (RECORDER, {"topics": "['/x*:=std_msgs/msg/String']"}, "a pattern cannot have a type"),
        (RECORDER, {"topics": "[/x]", "compression": "zip"}, "it should be one of zstd, lz4, none"),
        (RECORDER, {"topics": "[/x]", "definitions": "[/nowhere]"}, "no message definitions; give"),
        (RECORDER, {"topics": "[/x]", "chunk_period": 5.0}, "Min: 0.05, Max: 0.9, value: 5.0"),
        (PLAYER, {}, "no bag to play; set the parameter bag"),
        (PLAYER, {"rate": "fast"}, "parameter rate (speed, 1: as recorded): "),
        (PLAYER, {"rate": 200.0}, "Min: 0.01, Max: 100.0, value: 200.0"),
        (PLAYER, {"wait_for": -1}, "parameter wait_for (subscribers each topic must have first)"),
        (PLAYER, {"bag": "nowhere"}, "there is no bag nowhere"),
        (PLAYER, {"bag": TRIAL_05, "topics": "[/imu]"}, "has no topic /imu; it has: /cmd_vel"),
        (
            PLAYER,
            {"bag": TRIAL_05, "topics": "[/odom]", "wait_timeout": 0.2},
            "fewer than 1 subscribers on /odom after 0.2 s",
        ),
    ],
)
def test_what_a_node_cannot_do_it_says_and_exits_with_status_1(
    module: str, parameters: dict[str, object], message: str
) -> None:
    assert message in refusal(module, **parameters)


def test_patterns_and_snapshots(tmp_path: Path) -> None:
    bag = tmp_path / "patterned"
    settings: dict[str, object] = {"topics": "['/robot/*']", "bag": bag, "snapshot": 60.0}
    with (
        node_here("test_robot") as (node, spin_until),
        process(RECORDER, **settings) as recorder,
    ):
        names = ("/robot/a", "/robot/b", "/other")
        a, b, other = (node.create_publisher(String, name, qos.STREAM) for name in names)
        spin_until(lambda: min(a.get_subscription_count(), b.get_subscription_count()) == 1)
        assert other.get_subscription_count() == 0

        def ask(what: str) -> str:
            answer = call(node, spin_until, f"/trajectory_recorder/{what}")
            assert answer.success, answer.message
            return str(answer.message)

        for publisher in (a, b):
            publisher.publish(String(data="before"))
        time.sleep(0.3)
        assert ask("stop") == f"{bag} is closed"
        a.publish(String(data="after"))
        time.sleep(0.3)
        assert ask("snapshot").startswith("3 messages in ")
        stop(recorder)
    assert [m[8:].rstrip(b"\0") for m in messages_on(bag, "/robot/a")] == [b"before"]
    assert len(messages_on(bag, "/robot/b")) == 1
    snapshot = tmp_path / "patterned_snapshot_1"
    texts = [m[8:].rstrip(b"\0") for m in messages_on(snapshot, "/robot/a")]
    assert texts == [b"before", b"after"]


def test_in_simulated_time_log_times_are_the_simulations(tmp_path: Path) -> None:
    """The simulation runs at a tenth of real time and starts at 100 s."""
    bag, sent = tmp_path / "run", 0
    with (
        node_here("test_simulator") as (node, spin_until),
        process(RECORDER, bag=bag, topics="[/joints]", use_sim_time=True) as recorder,
    ):
        clock = node.create_publisher(Clock, "/clock", qos.STREAM)
        joints = node.create_publisher(JointState, "/joints", qos.STREAM)
        spin_until(lambda: clock.get_subscription_count() == 1)
        spin_until(lambda: joints.get_subscription_count() == 1)
        began = time.monotonic()
        while (t := time.monotonic() - began) < 3.0:
            now_ns = 100 * 10**9 + round(t * 1e8)
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
            clock.publish(message)
            if t > 1.0:
                state = JointState()
                state.header.stamp = message.clock
                joints.publish(state)
                sent += 1
            due = time.monotonic() + 0.01
            spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
        stop(recorder)
    with Bag(bag) as source:
        heard = [(m.log_time_ns, header_stamp_ns(m.data)) for m in source.messages(["/joints"])]
    assert len(heard) == sent
    assert all(100.05 < log_ns / 1e9 < 100.5 for log_ns, _ in heard)
    late = sorted(abs(log_ns - stamp_ns) for log_ns, stamp_ns in heard)
    assert late[len(late) // 2] < 20e6, "half of them within 0.2 s of real time"
    assert len({log_ns for log_ns, _ in heard}) > sent // 2, "not one time for each look"
