"""The recorder: messages lost and CPU used at 20 topics x 1 kHz; what kills leave behind.

python -m benchmarks.recorder [--seconds 90] [--topics 20] [--kills 50] [--json]

Every wait has an end: on a slow machine `rate` is what was sent, and `hung` says that the recorder
did not end when it was asked to.
"""

import argparse
import json
import random
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import rclpy
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState

from bags.recordings.bag import Bag
from bags.recordings.message_types import header_stamp_ns
from bags.tools.recover import repair
from benchmarks.machine import parser, peers, tell
from benchmarks.processes import cpu_seconds, isolate, node, python
from nlsid_core.errors import DataError
from nlsid_ros import qos

RATE = 1000  # Hz
STARTED, PATIENCE = 60.0, 30.0  # s for a process to come up on a busy machine, and to end
ASKED = {"rate": 20_000.0, "hung": 0.0, "lost": 0.0, "silent": 0.0, "worst_loss_s": 1.1}


def topics(count: int) -> list[str]:
    """Names of the topics that are sent."""
    return [f"/joints_{i}" for i in range(count)]


def send(seconds: float, count: int) -> int:
    """Publish six joints on each of the first `count` topics at 1 kHz, stamped with the time.

    Ends after `seconds` of the wall's time, whatever was sent by then; how many messages were.
    """
    rclpy.init()
    sender = Node("sender")
    publishers = [sender.create_publisher(JointState, topic, qos.STREAM) for topic in topics(count)]
    given_up = time.monotonic() + STARTED
    while min(p.get_subscription_count() for p in publishers) < 1:
        if time.monotonic() > given_up:
            raise DataError(f"nobody subscribed within {STARTED:g} s")
        time.sleep(0.01)
    time.sleep(0.5)
    names = [f"joint_{i}" for i in range(6)]
    values = [0.0] * 6
    data = bytearray(serialize_message(JointState(name=names, position=values, velocity=values)))
    start, k = time.perf_counter(), 0
    while time.perf_counter() < start + seconds:
        while (ahead := start + k / RATE - time.perf_counter()) > 0:
            time.sleep(ahead)
        seconds_part, nanoseconds = divmod(time.time_ns(), 10**9)
        data[4:8] = seconds_part.to_bytes(4, "little")
        data[8:12] = nanoseconds.to_bytes(4, "little")
        message = bytes(data)
        for publisher in publishers:
            publisher.publish(message)
        k += 1
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(seconds=PATIENCE))
    sender.destroy_node()
    rclpy.shutdown()
    return k * count


def sending(seconds: float, count: int, said: Path) -> list[str]:
    """Arguments that start the sender, which writes into `said` how many messages it sent."""
    given = ["--send", str(seconds), "--topics", str(count), "--said", str(said)]
    return ["benchmarks.recorder", *given]


def throughput(folder: Path, seconds: float, count: int) -> dict[str, float | bool]:
    """Messages sent, lost and counted as lost by the recorder, and the processor's time it took.

    hung: whether it did not end when it was asked to. lost: of all that were sent; the recorder
    counts by the publishers' numbers, so what is lost after the last that came is not in its count.
    """
    bag, said = folder / "fast", folder / "sent"
    parameters = {"topics": json.dumps(topics(count)), "bag": bag, "least_free": 0.0}
    with python(*node("trajectory_recorder", **parameters)) as recorder:
        until(bag.exists, STARTED)
        before = cpu_seconds(recorder.pid)
        with python(*sending(seconds, count, said)) as sender:
            sender.wait(seconds + STARTED + PATIENCE)
        used = cpu_seconds(recorder.pid) - before
        recorder.send_signal(signal.SIGINT)
        hung = not until(lambda: recorder.poll() is not None, PATIENCE)
    if hung:
        repair(bag)
    with Bag(bag) as source:
        kept = sum(source.count(topic) for topic in topics(count))
        counted = sum(int(source.custom.get(f"{topic} lost", 0)) for topic in topics(count))
    sent = int(said.read_text())
    return {
        "rate": sent / seconds,
        "seconds": seconds,
        "hung": hung,
        "status": recorder.returncode,
        "sent": sent,
        "lost": sent - kept,
        "lost_by_the_recorders_count": counted,
        "cpu_percent_of_a_core": 100.0 * used / seconds,
    }


def until(condition: Callable[[], bool], patience: float) -> bool:
    """Whether it held within so many s."""
    given_up = time.monotonic() + patience
    while not condition():
        if time.monotonic() > given_up:
            return False
        time.sleep(0.02)
    return True


def kills(folder: Path, count: int) -> dict[str, float]:
    """Kill the recorder at random times: the worst time lost before repair, and how many of the
    bags rosbags and mcap read to their ends after it, every message of them.

    silent: recorders that heard nothing of what was sent.
    """
    rng, losses = random.Random(1), []
    by_rosbags = by_mcap = silent = 0
    with python(*sending(1e6, 1, folder / "endless")) as sender:
        for index in range(count):
            bag = folder / f"killed_{index}"
            parameters = {"topics": f"[{topics(1)[0]}]", "bag": bag, "repair": False}
            with python(*node("trajectory_recorder", **parameters)) as recorder:
                file = bag / f"{bag.name}.mcap"
                heard = until(lambda: file.exists() and file.stat().st_size > 10_000, STARTED)  # noqa: B023
                time.sleep(rng.uniform(0.0, 1.5))
                recorder.kill()
                killed_ns = time.time_ns()
                recorder.wait()
            if not heard:
                silent += 1
                continue
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
        "silent": silent,
        "bags_read_by_rosbags": by_rosbags,
        "bags_read_by_mcap": by_mcap,
        "worst_loss_s": max(losses, default=0.0),
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
    taken = parser(__doc__)
    taken.add_argument("--seconds", type=float, default=90.0)
    taken.add_argument("--kills", type=int, default=50)
    taken.add_argument("--send", type=float, help=argparse.SUPPRESS)
    taken.add_argument("--said", type=Path, help=argparse.SUPPRESS)
    taken.add_argument("--topics", type=int, default=20, help="each at 1 kHz")
    options = taken.parse_args()
    if options.send:
        options.said.write_text(str(send(options.send, options.topics)))
        return
    isolate()
    with tempfile.TemporaryDirectory() as scratch:
        result = throughput(Path(scratch), options.seconds, options.topics)
        if options.kills:
            result |= kills(Path(scratch), options.kills)
    tell(result | peers("ros-jazzy-rclpy", "rosbags"), ASKED, as_json=options.json, what="asked")


if __name__ == "__main__":
    main()
