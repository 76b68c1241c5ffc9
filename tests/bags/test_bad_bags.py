"""Every way a bag can be bad: a BagError that names the bag, what is wrong, and what to do."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from bags.recordings.writer import BagWriter
from bags.signals.reader import bag_digest, read_signals
from nlsid_core.errors import BagError, DataError
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    JOINT_TYPE,
    ODOM,
    ODOM_TYPE,
    PERIOD_NS,
    SPEED,
    START_NS,
    command,
    joints,
    odometry,
    speed_bag,
)

RESOURCES = Path(__file__).parents[2].parent / "shared" / "data" / "rosbag2_resources"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return speed_bag(tmp_path / "trial", np.linspace(0, 1, 50), np.linspace(1, 2, 50))


def refused(bag: Path, *paths: str) -> str:
    """The error of reading `paths`; it names the bag and is a DataError too."""
    with pytest.raises(BagError) as caught:
        read_signals(bag, paths or (SPEED,))
    assert isinstance(caught.value, DataError)
    assert bag.name in str(caught.value)
    return str(caught.value)


def written(path: Path, *messages: tuple[str, str, bytes]) -> Path:
    """A bag of these (topic, type, data); /odom is announced."""
    with BagWriter(path) as bag:
        if all(topic != ODOM for topic, _, _ in messages):
            bag.add_topic(ODOM, ODOM_TYPE)
        for k, (topic, kind, data) in enumerate(messages, start=1):
            bag.write(topic, kind, data, log_time_ns=k, publish_time_ns=k)
    return path


def mcap_of(file: Path, *types: tuple[str, str, str]) -> Path:
    """One message on /x of each (std_msgs type, its definition, encoding)."""
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for name, text, encoding in types:
            schema = writer.register_schema(f"std_msgs/msg/{name}", "ros2msg", text.encode())
            channel = writer.register_channel("/x", encoding, schema)
            writer.add_message(channel, 1, bytes(12), 1)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates half of its writer
    return file


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def file_of(path: Path, content: bytes) -> Path:
    path.with_suffix(".mcap").write_bytes(content)
    return path.with_suffix(".mcap")


def changed(path: Path, old: str, new: str) -> Path:
    """A bag whose metadata say something else."""
    metadata = speed_bag(path, np.linspace(0, 1, 50), np.linspace(1, 2, 50)) / "metadata.yaml"
    text = metadata.read_text()
    assert not old or old in text
    metadata.write_text(text.replace(old, new) if old else new)
    return path


FLOAT, INT = ("Float64", "float64 data", "cdr"), ("Int32", "int32 data", "cdr")
BACK = [START_NS + k * PERIOD_NS for k in (0, 1, 2, 1, 2, 3)]
GOOD = (ODOM, ODOM_TYPE, odometry(1, 0.5))
CUT = (ODOM, ODOM_TYPE, odometry(2, 0.5)[:-200])
ARM = [("/arm", JOINT_TYPE, joints(START_NS, q)) for q in ([0.1, 0.2], [0.1])]
DAMAGED = "damaged or not a bag"
REFUSED: list[tuple[Callable[[Path], Path], str, str]] = [
    (lambda path: path, SPEED, "there is no bag"),
    (folder, SPEED, "is not a bag"),
    (lambda path: changed(path, "", ""), SPEED, DAMAGED),
    (lambda path: changed(path, "", "a: ["), SPEED, DAMAGED),
    (lambda path: changed(path, "", "x: 1"), SPEED, DAMAGED),
    (lambda path: changed(path, "", "!!python/object/apply:os.system ['true']"), SPEED, DAMAGED),
    (lambda path: changed(path, "version: 9", "version: nine"), SPEED, DAMAGED),
    (
        lambda path: changed(path, "message_count: 50", "message_count: 51"),
        SPEED,
        "/odom has 50 messages, the bag's index says 51",
    ),
    (lambda path: file_of(path, b""), SPEED, "no MCAP, SQLite or ROS 1 file: it is empty"),
    (lambda path: file_of(path, b"\0" * 100), SPEED, "no MCAP, SQLite or ROS 1 file"),
    (lambda path: file_of(path, b"#!/bin/sh\necho no\n"), SPEED, "no MCAP, SQLite or ROS 1"),
    (lambda path: file_of(path, b"\x89MCAP0\r\n"), SPEED, "truncated or unfinished"),
    (lambda path: file_of(path, b"\x89MCAP0\r\n" * 9), SPEED, "truncated or unfinished"),
    (lambda path: written(path, GOOD), "/imu:x", "no topic /imu; it has: /odom (nav_msgs/msg"),
    (
        lambda path: written(path, GOOD),
        "/odom:twist.twist.linear.w",
        "Field 'w' does not exist on 'geometry_msgs/msg/Vector3'; it has: x, y, z",
    ),
    (
        lambda path: written(path, (ODOM, CMD_TYPE, command(1, 0.5))),
        "/odom:pose.pose.position.x",
        "Field 'pose' does not exist on 'geometry_msgs/msg/TwistStamped'; it has: header, twist",
    ),
    (
        lambda path: mcap_of(path, FLOAT, INT),
        "/x:data",
        "/x holds messages of std_msgs/msg/Float64 and std_msgs/msg/Int32",
    ),
    (
        lambda path: mcap_of(path, ("Float64", "float64 data", "json")),
        "/x:data",
        "/x: it is serialised as 'json', only 'cdr' is read",
    ),
    *(
        (
            lambda path, bad=bad: speed_bag(path, [0.1, 0.2, bad, 0.4, bad], [0.0] * 5),
            SPEED,
            f"{SPEED} is {bad} in message 2 at 1700000000.050000000 s (2 of 5",
        )
        for bad in (np.nan, np.inf, -np.inf)
    ),
    (
        lambda path: speed_bag(path, [0.1] * 6, [0.2] * 6, stamps_ns=BACK),
        SPEED,
        "/odom: time goes back by 0.025 s at message 3: header stamp 1700000000.050000000 s, then "
        "1700000000.025000000 s (1 such place)",
    ),
    (
        lambda path: speed_bag(path, [0.1, 0.2], [0.3, 0.4], stamps_ns=[0, 0]),
        SPEED,
        "every header stamp is 0; its publisher does not fill it in",
    ),
    (
        lambda path: written(path, (CMD, CMD_TYPE, command(1, 0.5))),
        SPEED,
        "/odom has no messages; was its publisher running?",
    ),
    (
        lambda path: written(path, GOOD, CUT),
        SPEED,
        "/odom: message 1 cannot be read: not a 'nav_msgs/msg/Odometry'",
    ),
    (
        lambda path: written(path, *ARM),
        "/arm:position[1]",
        "/arm: message 1 cannot be read: position[1]: 'position' has 1 elements",
    ),
]


@pytest.mark.parametrize(("made", "signal", "message"), REFUSED)
def test_what_is_wrong_is_said(
    tmp_path: Path, made: Callable[[Path], Path], signal: str, message: str
) -> None:
    assert message in refused(made(tmp_path / "trial"), signal)


def test_a_missing_bag_has_no_digest(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="there is no bag"):
        bag_digest(tmp_path / "nowhere")


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_called_truncated_in_a_folder_or_alone(bag: Path, keep: float) -> None:
    file = bag / "trial.mcap"
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content))])
    for path in (bag, file):
        message = refused(path)
        assert str(file) in message
        assert "truncated or unfinished" in message
        assert "copy it again, or recover" in message


def test_an_unfinished_recording_is_called_unfinished(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "live", in_place=True)
    bag.write(ODOM, ODOM_TYPE, odometry(1, 0.5), log_time_ns=1, publish_time_ns=1)
    bag.close_chunk()
    assert "truncated or unfinished" in refused(tmp_path / "live")
    bag.close()
    assert len(read_signals(tmp_path / "live", [SPEED])[SPEED]) == 1


def test_a_folder_without_metadata(bag: Path) -> None:
    (bag / "metadata.yaml").unlink()
    assert "no metadata.yaml: the recording was not closed" in refused(bag)
    assert len(read_signals(bag / "trial.mcap", [SPEED])[SPEED]) == 50


def test_a_flipped_byte_is_never_read_as_data(bag: Path) -> None:
    file = bag / "trial.mcap"
    good = file.read_bytes()
    whole = read_signals(file, [SPEED])[SPEED].values
    rng = np.random.default_rng(1)
    refusals = 0
    for position in rng.integers(8, len(good) - 8, size=200):
        damaged = bytearray(good)
        damaged[position] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        try:
            values = read_signals(file, [SPEED])[SPEED].values
        except BagError:
            refusals += 1
            continue
        np.testing.assert_array_equal(values, whole)  # in bytes that no value depends on
    assert refusals > 20


def test_a_bad_path_is_refused_before_a_message_is_read(bag: Path) -> None:
    file = bag / "trial.mcap"
    content = file.read_bytes()
    chunk = content.index(b"\x28\xb5\x2f\xfd")  # the first zstd frame: the messages
    file.write_bytes(content[:chunk] + bytes(40) + content[chunk + 40 :])
    assert "Field 'speed' does not exist" in refused(bag, SPEED, "/odom:speed")
    assert "damaged" in refused(bag, SPEED)


@pytest.mark.skipif(not RESOURCES.is_dir(), reason=f"needs {RESOURCES.name} beside the repository")
def test_the_wrong_format_bag_of_rosbag2_itself() -> None:
    bag = RESOURCES / "rosbag2_tests" / "resources" / "mcap" / "wrong_rmw_test"
    assert "wrong_format" in refused(bag, "/test_topic:data")
