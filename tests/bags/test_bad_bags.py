"""Every way a bag can be bad: a BagError that names the bag, what is wrong, and what to do."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from bags.recordings.writer import BagWriter
from bags.signals.reader import bag_digest, bag_origin, read_signals
from nlsid_core.errors import BagError, DataError
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    COMMAND,
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


def test_a_missing_bag(tmp_path: Path) -> None:
    assert "there is no bag" in refused(tmp_path / "nowhere")
    for read in (bag_digest, bag_origin):
        with pytest.raises(BagError, match="there is no bag"):
            read(tmp_path / "nowhere")


def test_a_folder_that_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    assert "is not a bag" in refused(tmp_path / "notes")


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


def test_metadata_that_is_not_metadata(bag: Path) -> None:
    for text in ("", "a: [", "x: 1", "!!python/object/apply:os.system ['true']"):
        (bag / "metadata.yaml").write_text(text)
        assert "damaged or not a bag" in refused(bag)


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 100, b"#!/bin/sh\necho no\n", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 9]
)
def test_garbage_in_an_mcap_file(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "garbage.mcap"
    file.write_bytes(content)
    refused(file)


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


def test_a_missing_topic_lists_the_topics(bag: Path) -> None:
    message = refused(bag, "/imu:linear_acceleration.x")
    assert "has no topic /imu" in message
    assert "/odom (nav_msgs/msg/Odometry)" in message
    assert "/cmd_vel (geometry_msgs/msg/TwistStamped)" in message


def test_a_wrong_type_on_a_topic_is_named_with_its_fields(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "swapped") as bag:
        bag.write(ODOM, CMD_TYPE, command(1, 0.5), log_time_ns=1, publish_time_ns=1)
    message = refused(tmp_path / "swapped", "/odom:pose.pose.position.x")
    assert (
        "Field 'pose' does not exist on 'geometry_msgs/msg/TwistStamped'; it has: header, twist"
    ) in message


def test_two_types_on_one_topic(tmp_path: Path) -> None:
    file = tmp_path / "two.mcap"
    _write_mcap(file, ("Float64", "float64 data", "cdr"), ("Int32", "int32 data", "cdr"))
    assert "/x holds messages of std_msgs/msg/Float64 and std_msgs/msg/Int32" in refused(
        file, "/x:data"
    )


def test_a_serialisation_that_is_not_cdr(tmp_path: Path) -> None:
    file = tmp_path / "json.mcap"
    _write_mcap(file, ("Float64", "float64 data", "json"))
    assert "/x: it is serialised as 'json', only 'cdr' is read" in refused(file, "/x:data")


@pytest.mark.skipif(not RESOURCES.is_dir(), reason=f"needs {RESOURCES.name} beside the repository")
def test_the_wrong_format_bag_of_rosbag2_itself() -> None:
    bag = RESOURCES / "rosbag2_tests" / "resources" / "mcap" / "wrong_rmw_test"
    assert "wrong_format" in refused(bag, "/test_topic:data")


def test_a_missing_field_lists_what_exists(bag: Path) -> None:
    message = refused(bag, "/odom:twist.twist.linear.w")
    assert ("Field 'w' does not exist on 'geometry_msgs/msg/Vector3'; it has: x, y, z") in message


def test_a_bad_path_is_refused_before_a_message_is_read(bag: Path) -> None:
    file = bag / "trial.mcap"
    content = file.read_bytes()
    chunk = content.index(b"\x28\xb5\x2f\xfd")  # the first zstd frame: the messages
    file.write_bytes(content[:chunk] + bytes(40) + content[chunk + 40 :])
    assert "Field 'speed' does not exist" in refused(bag, SPEED, "/odom:speed")
    assert "damaged" in refused(bag, SPEED)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_located(tmp_path: Path, bad: float) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2, bad, 0.4, bad], [0.0] * 5)
    message = refused(bag)
    assert f"{SPEED} is {bad} in message 2 at 1700000000.050000000 s (2 of 5" in message
    assert len(read_signals(bag, [COMMAND])[COMMAND]) == 5


def test_time_going_backwards_is_located_and_measured(tmp_path: Path) -> None:
    stamps = [START_NS + k * PERIOD_NS for k in (0, 1, 2, 1, 2, 3)]
    bag = speed_bag(tmp_path / "trial", [0.1] * 6, [0.2] * 6, stamps_ns=stamps)
    message = refused(bag)
    assert "/odom: time goes back by 0.025 s at message 3: header stamp 17" in message
    assert "then 1700000000.025000000 s (1 such place)" in message


def test_stamps_that_are_never_filled_in(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4], stamps_ns=[0, 0])
    assert "every header stamp is 0; its publisher does not fill it in" in refused(bag)


def test_a_topic_without_messages(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "quiet") as bag:
        bag.add_topic(ODOM, ODOM_TYPE)
        bag.write(CMD, CMD_TYPE, command(1, 0.5), log_time_ns=1, publish_time_ns=1)
    assert "/odom has no messages; was its publisher running?" in refused(tmp_path / "quiet")


def test_a_message_that_is_too_short(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "cut") as bag:
        bag.write(ODOM, ODOM_TYPE, odometry(1, 0.5), log_time_ns=1, publish_time_ns=1)
        bag.write(ODOM, ODOM_TYPE, odometry(2, 0.5)[:-200], log_time_ns=2, publish_time_ns=2)
    assert "/odom: message 1 cannot be read: not a 'nav_msgs/msg/Odometry'" in refused(
        tmp_path / "cut"
    )


def test_a_dynamic_array_that_becomes_too_short(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "arm") as bag:
        for k, position in enumerate(([0.1, 0.2], [0.1])):
            data = joints(START_NS + k, position)
            bag.write("/arm", JOINT_TYPE, data, log_time_ns=k, publish_time_ns=k)
    message = refused(tmp_path / "arm", "/arm:position[1]")
    assert "/arm: message 1 cannot be read: position[1]: 'position' has 1 elements" in message


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace("trial.mcap", "../../elsewhere.mcap"),
        lambda text: text.replace("trial.mcap", "/etc/passwd"),
        lambda text: text.replace("version: 9", "version: nine"),
    ],
)
def test_metadata_that_lies_is_refused(bag: Path, damage: Callable[[str], str]) -> None:
    metadata = bag / "metadata.yaml"
    shutil.copy(bag / "trial.mcap", bag.parent.parent / "elsewhere.mcap")
    damaged = damage(metadata.read_text())
    assert damaged != metadata.read_text()
    metadata.write_text(damaged)
    assert "damaged or not a bag" in refused(bag)


def test_fewer_messages_than_the_bag_says_it_has(bag: Path) -> None:
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 50", "message_count: 51"))
    assert "/odom has 50 messages, the bag's index says 51" in refused(bag)


def _write_mcap(file: Path, *types: tuple[str, str, str]) -> None:
    """One message on /x of each (std_msgs type, its definition, encoding)."""
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for name, text, encoding in types:
            schema = writer.register_schema(f"std_msgs/msg/{name}", "ros2msg", text.encode())
            channel = writer.register_channel("/x", encoding, schema)
            writer.add_message(channel, 1, bytes(12), 1)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates half of its writer
