"""What a killed recorder leaves is found and made a whole bag again."""

import shutil
from pathlib import Path

import pytest

from bags.recordings.bag import Bag
from bags.recordings.repair import repair, unfinished_bags
from bags.recordings.writer import BagWriter
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


def test_a_bag_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "live", in_place=True) as bag:
        bag.add_topic(ODOM, "nav_msgs/msg/Odometry")
        assert unfinished_bags(tmp_path) == []
        with pytest.raises(BagError, match="it is being written"):
            repair(tmp_path / "live")
