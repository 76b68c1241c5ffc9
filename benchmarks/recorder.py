"""The recorder: messages lost and CPU used at 10 topics x 1 kHz; what kills leave behind.

python -m benchmarks.recorder [--seconds 60] [--topics 10] [--kills 50] [--json]

Beside ours, in the same run: a node of the same subscriptions that writes with rosbags' Writer.
"""

import argparse
import json
import random
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import rclpy
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer
from sensor_msgs.msg import JointState

from bags.recordings.bag import Bag
from bags.recordings.message_types import header_stamp_ns, standard_types
from bags.recordings.repair import repair
from benchmarks.machine import describe, peers
from benchmarks.processes import cpu_seconds, isolate, node, python
from nlsid_ros import qos

TYPE = "sensor_msgs/msg/JointState"
RATE = 1000  # Hz
ASKED = {"lost": 0.0, "cpu_percent_of_a_core": 60.0, "worst_loss_s": 1.1}


def topics(count: int) -> list[str]:
    """Names of the topics that are sent."""
    return [f"/joints_{i}" for i in range(count)]


class RosbagsRecorder(Node):
    """The least a recorder with rosbags' Writer can do."""

    def __init__(self, path: Path, count: int) -> None:
        super().__init__("rosbags_recorder")
        self._writer = Writer(path, version=9)
        self._writer.open()
        for topic in topics(count):
            connection = self._writer.add_connection(topic, TYPE, typestore=standard_types())

            def record(data: bytes, info: dict[str, int], to: object = connection) -> None:
                self._writer.write(to, info["received_timestamp"], data)  # type: ignore[arg-type]

            self.create_subscription(JointState, topic, record, qos.STREAM, raw=True)  # type: ignore[arg-type]

    def close(self) -> None:
        """Write what was buffered."""
        self._writer.close()


def send(seconds: float, count: int) -> None:
    """Publish six joints on each of the first `count` topics at 1 kHz, stamped with the time."""
    rclpy.init()
    sender = Node("sender")
    publishers = [sender.create_publisher(JointState, topic, qos.STREAM) for topic in topics(count)]
    while min(p.get_subscription_count() for p in publishers) < 1:
        time.sleep(0.01)
    time.sleep(0.5)
    names = [f"joint_{i}" for i in range(6)]
    values = [0.0] * 6
    data = bytearray(serialize_message(JointState(name=names, position=values, velocity=values)))
    start, ticks = time.perf_counter(), round(seconds * RATE)
    for k in range(ticks):
        while (ahead := start + k / RATE - time.perf_counter()) > 0:
            time.sleep(ahead)
        seconds_part, nanoseconds = divmod(time.time_ns(), 10**9)
        data[4:8] = seconds_part.to_bytes(4, "little")
        data[8:12] = nanoseconds.to_bytes(4, "little")
        message = bytes(data)
        for publisher in publishers:
            publisher.publish(message)
    time.sleep(1.0)
    sender.destroy_node()
    rclpy.shutdown()


def sending(seconds: float, count: int) -> list[str]:
    """Arguments that start the sender."""
    return ["benchmarks.recorder", "--send", str(seconds), "--topics", str(count)]


def throughput(recorder: list[str], bag: Path, seconds: float, count: int) -> dict[str, float]:
    """Messages lost, and CPU used while they came."""
    with python(*recorder) as recording:
        time.sleep(3.0)
        before = cpu_seconds(recording.pid)
        with python(*sending(seconds, count)) as sender:
            sender.wait()
        used = cpu_seconds(recording.pid) - before
    with Bag(bag) as source:
        kept = sum(source.count(topic) for topic in topics(count))
    sent = round(seconds * RATE) * count
    return {"sent": sent, "lost": sent - kept, "cpu_percent_of_a_core": 100.0 * used / seconds}


def kills(folder: Path, count: int) -> dict[str, float]:
    """Kill the recorder at random times: the worst time lost before repair, and how many of the
    bags rosbags and mcap read to their ends after it, every message of them.
    """
    rng, losses = random.Random(1), []
    by_rosbags = by_mcap = 0
    with python(*sending(1e6, 1)) as sender:
        for index in range(count):
            bag = folder / f"killed_{index}"
            parameters = {"topics": f"[{topics(1)[0]}]", "bag": bag, "repair": False}
            with python(*node("trajectory_recorder", **parameters)) as recorder:
                file = bag / f"{bag.name}.mcap"
                while not file.exists() or file.stat().st_size < 10_000:
                    time.sleep(0.02)
                time.sleep(rng.uniform(0.0, 1.5))
                recorder.kill()
                killed_ns = time.time_ns()
                recorder.wait()
            left = read_what_is_left(file)
            losses.append((killed_ns - header_stamp_ns(left[-1])) / 1e9)
            repair(bag)
            with AnyReader([bag]) as reader:
                by_rosbags += [bytes(data) for *_, data in reader.messages()] == left
            with file.open("rb") as stream:
                read = make_reader(stream, validate_crcs=True).iter_messages()
                by_mcap += [message.data for *_, message in read] == left
        sender.kill()
    return {
        "kills": count,
        "bags_read_by_rosbags": by_rosbags,
        "bags_read_by_mcap": by_mcap,
        "worst_loss_s": max(losses),
    }


def read_what_is_left(file: Path) -> list[bytes]:
    """The messages in a file that a kill left, as mcap reads it record by record."""
    left: list[bytes] = []
    with file.open("rb") as stream, suppress(EndOfFile, RecordLengthLimitExceeded):
        records = StreamReader(stream, validate_crcs=True).records
        left.extend(record.data for record in records if isinstance(record, Message))
    return left


def main() -> None:
    """Print the table; with --json the last line is one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--send", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--topics", type=int, default=10, help="each at 1 kHz")
    parser.add_argument("--rosbags", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.send:
        send(options.send, options.topics)
        return
    if options.rosbags:
        rclpy.init()
        recorder = RosbagsRecorder(options.rosbags, options.topics)
        with suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(recorder)
        recorder.close()
        return
    isolate()
    with tempfile.TemporaryDirectory() as scratch:
        ours, theirs = Path(scratch) / "ours", Path(scratch) / "theirs"
        count = options.topics
        listed = json.dumps(topics(count))
        result = throughput(
            node("trajectory_recorder", topics=listed, bag=ours), ours, options.seconds, count
        )
        other = throughput(
            ["benchmarks.recorder", "--rosbags", str(theirs), "--topics", str(count)],
            theirs,
            options.seconds,
            count,
        )
        result |= {f"rosbags_{key}": value for key, value in other.items() if key != "sent"}
        if options.kills:
            result |= kills(Path(scratch), options.kills)
    print(f"{describe()}\n{'':30} {'reached':>10} {'asked':>10}")
    for key, value in result.items():
        asked = f"{ASKED[key]:10.4g}" if key in ASKED else ""
        print(f"{key:30} {value:10.6g} {asked}")
    if options.json:
        print(json.dumps(result | peers("ros-jazzy-rclpy", "rosbags")))


if __name__ == "__main__":
    main()
