"""Reading a large bag: messages per second and memory, beside peers.

python -m benchmarks.bag_reading [--json] [--messages 2000000] [--large]

The bag holds JointState (six joints), Odometry and Imu in equal parts, in zstd chunks; it is
generated once and kept in a cache folder, which is printed. Beside ours run, on the first messages
of the same bag and selecting the same numbers, mcap-ros2-support's decoder and rosbags'
deserialiser. One core; each reader in a process of its own, timed in CPU seconds so that a busy
machine does not count; the memory is that process's. Likewise `nlsid bag info` of the whole bag;
and of one of FRAMED messages a DataFrame, as rosbags-dataframe makes it, a copy, as rosbags makes
it, and a minute of it, as mcap makes it: each the second time in its process, without imports.
With --large `nlsid bag info` of 5 GB with IMAGES pictures, written to a temporary folder, too.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing
import re
import resource
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from io import StringIO
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from bags.signals.reader import read_signals
from bags.tools.convert import convert
from bags.tools.copies import What
from bags.tools.tables import frame
from benchmarks.cache import cache_folder
from benchmarks.machine import parser, peers, tell

MESSAGES: Final = 2_000_000
SAMPLE: Final = 60_000  # messages that the decoders, which take minutes for all, are timed on
FRAMED: Final = 300_000  # messages of the bag that is put into frames
IMAGES: Final = 2_500  # of 2 MB
MINUTE_NS: Final = 60 * 10**9
REPEATS: Final = 3
JOINTS, ODOM, IMU = "/joint_states", "/odom", "/imu"
TYPES: Final = {
    JOINTS: "sensor_msgs/msg/JointState",
    ODOM: "nav_msgs/msg/Odometry",
    IMU: "sensor_msgs/msg/Imu",
}
SIGNALS: Final = (
    *(f"{JOINTS}:position[{k}]" for k in range(6)),
    *(f"{JOINTS}:velocity[{k}]" for k in range(6)),
    f"{ODOM}:pose.pose.position.x",
    f"{ODOM}:pose.pose.position.y",
    f"{ODOM}:twist.twist.linear.x",
    f"{ODOM}:twist.twist.angular.z",
    f"{IMU}:angular_velocity.z",
    f"{IMU}:linear_acceleration.x",
    f"{IMU}:linear_acceleration.y",
)
TAKEN: Final[dict[str, Callable[[Any], list[float]]]] = {
    JOINTS: lambda m: [*m.position, *m.velocity],
    ODOM: lambda m: [
        m.pose.pose.position.x,
        m.pose.pose.position.y,
        m.twist.twist.linear.x,
        m.twist.twist.angular.z,
    ],
    IMU: lambda m: [m.angular_velocity.z, m.linear_acceleration.x, m.linear_acceleration.y],
}
IMAGE: Final = "sensor_msgs/msg/Image"
START_NS: Final = 1_700_000_000 * 10**9
PERIOD_NS: Final = 1_000_000
USERS: Final = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)


def generated_bag(messages: int) -> Path:
    """The bag of that many messages, in the cache."""
    bag = cache_folder() / f"nlsid_bag_reading_{messages}"
    if not bag.is_dir():
        _write(bag, messages)
    return bag


def _write(bag: Path, messages: int, images: int = 0) -> None:
    """Write a bag; with `images` one of these before each of the first messages."""
    image = np.random.default_rng(0).bytes(2 * 10**6)
    with BagWriter(bag) as writer:
        for k, (topic, content) in enumerate(islice(_messages(), messages)):
            at = START_NS + k * PERIOD_NS
            if k < images:
                writer.write("/image", IMAGE, image, log_time_ns=at, publish_time_ns=at)
            writer.write(topic, TYPES[topic], content, log_time_ns=at, publish_time_ns=at)


def _messages() -> Iterator[tuple[str, bytes]]:
    """The three topics in turn, with fresh noise and stamps in otherwise equal messages."""
    rng = np.random.default_rng(0)
    templates = _templates()
    one = re.escape(np.ones(1).tobytes())  # what a sensor would have measured
    places = {
        topic: [found.start() for found in re.finditer(one, data)]
        for topic, data in templates.items()
    }
    for k, topic in enumerate(cycle(TYPES)):
        data = templates[topic]
        data[4:12] = np.array(divmod(START_NS + k * PERIOD_NS, 10**9), "<u4").tobytes()
        noise = rng.standard_normal(len(places[topic])).round(4)
        for place, number in zip(places[topic], noise, strict=True):
            data[place : place + 8] = number.tobytes()
        yield topic, bytes(data)


def _templates() -> dict[str, bytearray]:
    """A message of each topic, ones where a sensor would have measured."""
    types = standard_types().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "base_link")
    vector = types["geometry_msgs/msg/Vector3"](1.0, 1.0, 1.0)
    point = types["geometry_msgs/msg/Point"](1.0, 1.0, 1.0)
    quaternion = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = types["geometry_msgs/msg/Pose"](point, quaternion)
    twist = types["geometry_msgs/msg/Twist"](vector, vector)
    small, large = np.zeros(9), np.zeros(36)
    names = [f"arm_joint_{k}" for k in range(1, 7)]
    parts: dict[str, tuple[Any, ...]] = {
        JOINTS: (names, *(np.ones(6) for _ in range(3))),
        ODOM: (
            "base_footprint",
            types["geometry_msgs/msg/PoseWithCovariance"](pose, large),
            types["geometry_msgs/msg/TwistWithCovariance"](twist, large),
        ),
        IMU: (quaternion, small, vector, small, vector, small),
    }
    return {
        topic: bytearray(standard_types().serialize_cdr(types[kind](header, *parts[topic]), kind))
        for topic, kind in TYPES.items()
    }


def read_ours(bag: Path, _messages: int) -> int:
    """All of the bag, through the public reader."""
    read = read_signals(bag, SIGNALS)
    return sum(len(read[signal]) for signal in (SIGNALS[0], SIGNALS[12], SIGNALS[16]))


def read_mcap_ros2(bag: Path, messages: int) -> int:
    """The first messages with mcap-ros2-support: decode every message, take the numbers."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with next(bag.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = (
            (channel.topic, message)
            for _, channel, _, message in reader.iter_decoded_messages(topics=list(TYPES))
        )
        return _take(decoded, messages)


def read_rosbags(bag: Path, messages: int) -> int:
    """The first messages with rosbags: deserialise every message, take the numbers."""
    from rosbags.rosbag2 import Reader

    types = standard_types()
    with Reader(bag) as reader:
        decoded = (
            (connection.topic, types.deserialize_cdr(data, connection.msgtype))
            for connection, _, data in reader.messages()
        )
        return _take(decoded, messages)


def _take(decoded: Iterator[tuple[str, Any]], messages: int) -> int:
    columns: dict[str, list[list[float]]] = {topic: [] for topic in TYPES}
    for topic, m in islice(decoded, messages):
        columns[topic].append([m.header.stamp.sec, m.header.stamp.nanosec, *TAKEN[topic](m)])
    for rows in columns.values():
        np.array(rows)
    return messages


def info(bag: Path, messages: int) -> int:
    """The whole command line, as a person runs it."""
    command = [sys.executable, "-m", "bags.commands.main", "bag", "info", "--json", str(bag)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return messages


def framed(bag: Path, _messages: int) -> int:
    """Every field of a topic."""
    return len(frame(bag, [ODOM]))


def framed_by_rosbags(bag: Path, _messages: int) -> int:
    """Some numbers of the topic with rosbags-dataframe."""
    from rosbags.dataframe import get_dataframe
    from rosbags.highlevel import AnyReader

    fields = [signal.partition(":")[2] for signal in SIGNALS if signal.startswith(ODOM)]
    with AnyReader([bag]) as reader:
        return len(get_dataframe(reader, ODOM, fields))


def converted(bag: Path, _messages: int) -> int:
    """A copy of the bag."""
    with TemporaryDirectory() as folder, Bag(bag) as source:
        return convert([source], Path(folder) / "copy").messages


def converted_by_rosbags(bag: Path, messages: int) -> int:
    """The same by rosbags, without compressing it."""
    import rosbags.convert.converter as peer

    with TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        copy = Path(folder) / "copy"
        peer.convert([bag], copy, "mcap", 9, None, "none", None, None, (), (), (), ())
    return messages


def cut(bag: Path, messages: int) -> int:
    """A minute of the bag."""
    with TemporaryDirectory() as folder, Bag(bag) as source:
        convert([source], Path(folder) / "cut", What(start="60", end="120"))
    return messages


def cut_by_mcap(bag: Path, messages: int) -> int:
    """The same with mcap's reader, by its index, and mcap's writer."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    start_ns = START_NS + MINUTE_NS
    with TemporaryFile() as made, next(bag.glob("*.mcap")).open("rb") as stream:
        writer = Writer(made)
        writer.start()
        known: dict[str, int] = {}
        found = make_reader(stream).iter_messages(None, start_ns, start_ns + MINUTE_NS)
        for schema, channel, m in found:
            if channel.topic not in known:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(known[channel.topic], m.log_time, m.data, m.publish_time, m.sequence)
        writer.finish()
    return messages


def _timed(read: Callable[[Path, int], int], bag: Path, messages: int) -> tuple[float, float]:
    started = sum(os.times()[:4])  # with the processes that it starts
    done = read(bag, messages)
    seconds = sum(os.times()[:4]) - started
    used = [resource.getrusage(who).ru_maxrss for who in USERS]
    return done / seconds, max(used) / 1024


def timed(
    read: Callable[[Path, int], int], bag: Path, messages: int, *, again: bool = False
) -> tuple[float, float]:
    """(messages/s, peak memory in MB) of one reading in a fresh process, or of the second there."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        runs = [pool.submit(_timed, read, bag, messages).result() for _ in range(1 + again)]
    return runs[-1]


def measure(bag: Path, messages: int) -> dict[str, float]:
    """Run every reader side by side and return the promised keys."""
    readers = {"ours": read_ours, "mcap_ros2": read_mcap_ros2, "rosbags": read_rosbags}
    runs: dict[str, list[tuple[float, float]]] = {
        name: [timed(read, bag, min(SAMPLE, messages)) for _ in range(REPEATS)]
        for name, read in readers.items()
    }
    median = {name: statistics.median(rate for rate, _ in found) for name, found in runs.items()}
    small = generated_bag(FRAMED)
    frames, copies, cuts = (
        [timed(make, small, FRAMED, again=True)[0] for make in makers]
        for makers in (
            (framed, framed_by_rosbags),
            (converted, converted_by_rosbags),
            (cut, cut_by_mcap),
        )
    )
    return {
        "messages_per_s": median["ours"],
        "mcap_ros2_per_s": median["mcap_ros2"],
        "rosbags_per_s": median["rosbags"],
        "ratio_mcap_ros2": median["ours"] / median["mcap_ros2"],
        "ratio_rosbags": median["ours"] / median["rosbags"],
        "peak_mb": max(peak for _, peak in runs["ours"]),
        "info_s": messages / timed(info, bag, messages)[0],
        "frame_ratio_rosbags_dataframe": frames[0] / frames[1],
        "convert_ratio_rosbags": copies[0] / copies[1],
        "cut_ratio_mcap": cuts[1] / cuts[0],
        "bag_mb": sum(file.stat().st_size for file in bag.iterdir()) / 1e6,
    }


def measure_large() -> dict[str, float]:
    """How long `nlsid bag info` takes for a large bag, and the memory that it needs."""
    with TemporaryDirectory() as folder:
        bag = Path(folder) / "large"
        _write(bag, FRAMED, IMAGES)
        rate, peak = timed(info, bag, FRAMED)
        return {
            "large_gb": next(bag.glob("*.mcap")).stat().st_size / 1e9,
            "large_info_s": FRAMED / rate,
            "large_peak_mb": peak,
        }


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__)
    options.add_argument("--messages", type=int, default=MESSAGES)
    options.add_argument(
        "--large", action="store_true", help="also a bag of 5 GB, made and removed"
    )
    arguments = options.parse_args()
    bag = generated_bag(arguments.messages)
    print(f"reading {len(SIGNALS)} numbers of {arguments.messages} messages in {bag}")
    keys = measure(bag, arguments.messages)
    if arguments.large:
        keys |= measure_large()
    tell(
        keys | peers("mcap", "mcap-ros2-support", "rosbags", "rosbags-dataframe"),
        as_json=arguments.json,
    )


if __name__ == "__main__":
    main()
