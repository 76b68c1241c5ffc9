"""What a killed recorder leaves is found and made a whole bag again."""

import shutil
import struct
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from bags.recordings.bag import Bag
from bags.recordings.definitions import definitions_from
from bags.recordings.writer import BagWriter
from bags.signals.reader import read_signals
from bags.tools.recover import repair, unfinished_bags
from nlsid_core.errors import BagError
from tests.bag_messages import CMD, CMD_TYPE, ODOM, PERIOD_NS, START_NS, command

COUNT = 300


def killed_bag(path: Path, *, cut: int) -> Path:
    """A bag of 300 commands in three chunks whose file stops `cut` bytes early."""
    written = path.parent / "whole" / path.name
    with BagWriter(written, in_place=True) as bag:
        for k in range(COUNT):
            stamp = START_NS + k * PERIOD_NS
            times = {"log_time_ns": stamp, "publish_time_ns": stamp}
            bag.write(CMD, CMD_TYPE, command(stamp, float(k)), **times)
            if k % 100 == 99:
                bag.close_chunk()
    path.mkdir()
    data = (written / f"{path.name}.mcap").read_bytes()
    (path / f"{path.name}.mcap").write_bytes(data[: len(data) - cut])
    shutil.rmtree(path.parent / "whole")
    return path


@pytest.mark.parametrize("cut", [8, 200, 1000, 2500])
def test_every_complete_chunk_of_a_killed_bag_is_kept(tmp_path: Path, cut: int) -> None:
    bag = killed_bag(tmp_path / "trial", cut=cut)
    assert unfinished_bags(tmp_path) == [bag]
    kept = repair(bag)
    assert kept % 100 == 0
    assert kept >= 100
    with Bag(bag) as source:
        messages = list(source.messages([CMD]))
    assert [m.data for m in messages] == [
        command(START_NS + k * PERIOD_NS, float(k)) for k in range(kept)
    ]
    assert unfinished_bags(tmp_path) == []
    assert [p.name for p in tmp_path.iterdir()] == ["trial"]


def test_before_its_repair_mcap_reads_the_complete_chunks_and_rosbags_nothing(
    tmp_path: Path,
) -> None:
    bag = killed_bag(tmp_path / "trial", cut=1000)
    kept: list[bytes] = []
    with (
        (bag / "trial.mcap").open("rb") as stream,
        pytest.raises((EndOfFile, RecordLengthLimitExceeded)),
    ):
        kept.extend(r.data for r in StreamReader(stream).records if isinstance(r, Message))
    with pytest.raises(FileNotFoundError, match="Expected metadata file"):
        Reader(bag)
    with pytest.raises(BagError, match="truncated or unfinished"):
        Bag(bag)
    repair(bag)
    with AnyReader([bag]) as reader:
        assert [bytes(data) for _, _, data in reader.messages()] == kept
    with (bag / "trial.mcap").open("rb") as stream:
        finished = [m.data for *_, m in make_reader(stream, validate_crcs=True).iter_messages()]
    assert finished == kept


def test_a_repaired_bag_keeps_its_custom_types_and_its_own_data(tmp_path: Path) -> None:
    definition = definitions_from({"my_robot/msg/Arm": "float64 x\n"})["my_robot/msg/Arm"]
    bag = BagWriter(tmp_path / "run", in_place=True, custom={"robot": "arm"})
    bag.add_topic("/arm", definition.msgtype, definition=definition)
    for k in range(25):
        data = b"\0\1\0\0" + struct.pack("<d", float(k))
        bag.write("/arm", definition.msgtype, data, log_time_ns=k, publish_time_ns=k)
    bag.close_chunk()
    bag.abandon()
    assert (tmp_path / "run" / ".reserve").stat().st_size > 0
    assert repair(tmp_path / "run") == 25
    assert not (tmp_path / "run" / ".reserve").exists()
    with Bag(tmp_path / "run") as source:
        assert source.custom == {"robot": "arm"}
    [values] = read_signals(tmp_path / "run", ["/arm:x"]).values()
    assert values.values.tolist() == list(range(25))
    with AnyReader([tmp_path / "run"]) as reader:
        assert reader.message_count == 25


def test_a_bag_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "live", in_place=True) as bag:
        bag.add_topic(ODOM, "nav_msgs/msg/Odometry")
        assert unfinished_bags(tmp_path) == []
        with pytest.raises(BagError, match="it is being written"):
            repair(tmp_path / "live")
