"""The bag writer against the two libraries that read bags, and against a killed process."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from bags.recordings.writer import BagWriter
from nlsid_core.errors import BagError
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    ODOM,
    ODOM_TYPE,
    PERIOD_NS,
    START_NS,
    command,
    odometry,
    speed_bag,
)


def test_rosbags_reads_back_every_byte_type_hash_and_custom_datum(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4], custom={"repeat_group": "step"})
    with Reader(bag) as reader:
        assert reader.message_count == 4
        assert (reader.start_time, reader.duration) == (START_NS, PERIOD_NS + 1)
        assert {c.topic: c.msgtype for c in reader.connections} == {ODOM: ODOM_TYPE, CMD: CMD_TYPE}
        metadata: Any = reader.storage.metadata
        assert metadata.custom == {"repeat_group": "step"}
        assert metadata.ros_distro == "jazzy"
        read = [(c.topic, stamp, data) for c, stamp, data in reader.messages()]
    expected = [
        (CMD, START_NS, command(START_NS, 0.3)),
        (ODOM, START_NS, odometry(START_NS, 0.1)),
        (CMD, START_NS + PERIOD_NS, command(START_NS + PERIOD_NS, 0.4)),
        (ODOM, START_NS + PERIOD_NS, odometry(START_NS + PERIOD_NS, 0.2)),
    ]
    assert read == expected
    with AnyReader([bag]) as reader_with_types:  # recomputes every type hash from the schemas
        assert len(list(reader_with_types.messages())) == 4


def test_mcap_reads_profile_times_and_metadata_record(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "trial", custom={"source": "test"}) as bag:
        bag.write(CMD, CMD_TYPE, command(7, 0.5), log_time_ns=9, publish_time_ns=7)
    with (tmp_path / "trial" / "trial.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        [(schema, channel, message)] = reader.iter_messages()
        assert schema is not None
        assert (schema.name, schema.encoding) == (CMD_TYPE, "ros2msg")
        assert (channel.topic, channel.message_encoding) == (CMD, "cdr")
        assert (message.log_time, message.publish_time) == (9, 7)
        [record] = reader.iter_metadata()
        assert (record.name, record.metadata) == ("custom_data", {"source": "test"})


def test_a_topic_without_messages_is_listed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "quiet") as bag:
        bag.add_topic(CMD, CMD_TYPE)
    with Reader(tmp_path / "quiet") as reader:
        assert [(c.topic, c.msgcount) for c in reader.connections] == [(CMD, 0)]
        assert reader.message_count == 0


def test_an_existing_folder_is_refused_and_untouched(tmp_path: Path) -> None:
    (tmp_path / "trial").mkdir()
    for in_place in (False, True):
        with pytest.raises(BagError, match="trial exists already"):
            BagWriter(tmp_path / "trial", in_place=in_place)
    assert list(tmp_path.rglob("*")) == [tmp_path / "trial"]


@pytest.mark.parametrize("in_place", [False, True])
def test_after_an_exception_only_a_bag_in_place_keeps_what_was_written(
    tmp_path: Path, in_place: bool
) -> None:
    with (
        pytest.raises(BagError, match="is not known"),
        BagWriter(tmp_path / "trial", in_place=in_place) as bag,
    ):
        write_until_it_fails(bag)
    assert [path.name for path in tmp_path.iterdir()] == ["trial"] * in_place
    if in_place:
        with Reader(tmp_path / "trial") as reader:
            assert reader.message_count == 1


def test_a_folder_that_appears_while_writing_is_not_replaced(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "trial")
    (tmp_path / "trial").mkdir()
    with pytest.raises(BagError, match="appeared while"):
        bag.close()
    assert list(tmp_path.iterdir()) == [tmp_path / "trial"]


def test_a_second_type_on_a_topic_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "trial") as bag:
        bag.add_topic(CMD, CMD_TYPE)
        with pytest.raises(BagError, match=r"/cmd_vel holds 'geometry_msgs/msg/TwistStamped'"):
            bag.write(CMD, ODOM_TYPE, b"", log_time_ns=0, publish_time_ns=0)


def test_an_unknown_type_and_a_negative_time_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "trial") as bag:
        with pytest.raises(BagError, match="'my_robot/msg/Arm' is not known"):
            bag.add_topic("/arm", "my_robot/msg/Arm")
        with pytest.raises(BagError, match="times -1, 0 ns"):
            bag.write(CMD, CMD_TYPE, b"", log_time_ns=-1, publish_time_ns=0)


def test_a_closed_chunk_is_on_disk(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "trial", in_place=True)
    bag.write(CMD, CMD_TYPE, command(1, 0.5), log_time_ns=1, publish_time_ns=1)
    assert _stamps_on_disk(bag.path) == []
    bag.close_chunk()
    assert _stamps_on_disk(bag.path) == [1]
    bag.write(CMD, CMD_TYPE, command(2, 0.5), log_time_ns=2, publish_time_ns=2)
    assert _stamps_on_disk(bag.path) == [1]
    bag.close()
    assert _stamps_on_disk(bag.path) == [1, 2]


def test_a_killed_writer_loses_at_most_the_last_chunk(tmp_path: Path) -> None:
    script = (
        "import sys, time\n"
        "from bags.recordings.writer import BagWriter\n"
        "bag = BagWriter(sys.argv[1], in_place=True)\n"
        "while True:\n"
        "    now = time.time_ns()\n"
        f"    bag.write('{CMD}', '{CMD_TYPE}', b'\\0\\1\\0\\0' + bytes(64), log_time_ns=now,"
        " publish_time_ns=now)\n"
        "    if bag.counts[sys.argv[2]] % 20 == 0:\n        bag.close_chunk()\n"
        "    print(now, flush=True)\n"
        "    time.sleep(0.001)\n"
    )
    root = Path(__file__).parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "trial"), CMD],
        stdout=subprocess.PIPE,
        text=True,
        cwd=root,
    )
    assert process.stdout is not None
    first = process.stdout.readline()
    time.sleep(0.7)
    os.kill(process.pid, signal.SIGKILL)
    written = [int(line) for line in (first + process.communicate()[0]).split()]
    kept = _stamps_on_disk(tmp_path / "trial")
    assert kept == written[: len(kept)]
    assert len(written) - len(kept) <= 20


def _stamps_on_disk(bag: Path) -> list[int]:
    """Log times of the messages in complete chunks of a file that may be unfinished."""
    stamps: list[int] = []
    with (bag / f"{bag.name}.mcap").open("rb") as stream:
        try:
            stamps.extend(
                record.log_time
                for record in StreamReader(stream, validate_crcs=True).records
                if isinstance(record, Message)
            )
        except EndOfFile:
            return stamps
    return stamps


def write_until_it_fails(bag: BagWriter) -> None:
    bag.write(CMD, CMD_TYPE, command(0, 0.5), log_time_ns=0, publish_time_ns=0)
    bag.write("/x", "no/msg/Type", b"", log_time_ns=1, publish_time_ns=1)
