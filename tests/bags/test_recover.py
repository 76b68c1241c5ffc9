"""Unfinished and damaged bags: what is complete comes back, the rest is named."""

import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from bags.recordings.bag import Bag
from bags.recordings.mcap_file import McapFile
from bags.recordings.writer import BagWriter
from bags.signals.reader import bag_origin, read_signals
from bags.tools.convert import convert
from bags.tools.recover import recover
from nlsid_core.errors import BagError
from tests.bag_messages import ODOM, ODOM_TYPE, SPEED, START_NS, odometry, speed_bag

CHUNKS, PER_CHUNK = 12, 10


@pytest.fixture
def chunked(tmp_path: Path) -> Path:
    """A bag whose messages, ten to a chunk, are numbered by their speed."""
    with BagWriter(tmp_path / "run", custom={"robot": "car"}) as bag:
        for k in range(CHUNKS * PER_CHUNK):
            stamp = START_NS + k
            times = {"log_time_ns": stamp, "publish_time_ns": stamp}
            bag.write(ODOM, ODOM_TYPE, odometry(stamp, float(k)), **times)
            if k % PER_CHUNK == PER_CHUNK - 1:
                bag.close_chunk()
    return tmp_path / "run"


def chunk_ends(file: Path) -> list[int]:
    with closing(McapFile(file)) as opened:
        return [block.offset + block.size for block in opened.contents.blocks]


def test_every_truncation_gives_back_every_message_of_every_complete_chunk(
    chunked: Path, tmp_path: Path
) -> None:
    file = chunked / "run.mcap"
    content = file.read_bytes()
    ends = chunk_ends(file)
    assert len(ends) == CHUNKS
    cut = tmp_path / "cut.mcap"
    for percent in range(1, 100):
        length = len(content) * percent // 100
        cut.write_bytes(content[:length])
        out = tmp_path / f"whole_{percent}"
        complete = sum(end <= length for end in ends)
        if not complete and length < ends[0]:
            try:
                assert recover(cut, out).messages == 0
            except BagError:
                assert not out.exists()
            continue
        recovery = recover(cut, out)
        assert recovery.messages == complete * PER_CHUNK
        assert recovery.lost or length > ends[-1]
        values = read_signals(out, [SPEED])[SPEED].values
        assert values.tolist() == list(range(complete * PER_CHUNK))


def test_a_damaged_chunk_is_named_and_the_others_come_back(chunked: Path, tmp_path: Path) -> None:
    file = chunked / "run.mcap"
    content = bytearray(file.read_bytes())
    with closing(McapFile(file)) as opened:
        block = opened.contents.blocks[4]
    content[block.offset + block.size // 2] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(BagError):
        read_signals(chunked, [SPEED])
    with pytest.raises(BagError, match=f"the chunk at byte {block.offset}"), Bag(chunked) as bag:
        convert([bag], tmp_path / "copy")
    recovery = recover(chunked, tmp_path / "whole")
    assert recovery.messages == (CHUNKS - 1) * PER_CHUNK
    assert any("states 120 messages, 110 are there" in what for what in recovery.lost)
    assert f"the chunk at byte {block.offset}" in recovery.lost[0]
    values = read_signals(tmp_path / "whole", [SPEED])[SPEED].values
    assert set(values) == set(range(120)) - set(range(40, 50))
    assert bag_origin(tmp_path / "whole")["custom"] == {"robot": "car"}


def test_records_after_a_damaged_length_are_found_again(chunked: Path, tmp_path: Path) -> None:
    file = chunked / "run.mcap"
    content = bytearray(file.read_bytes())
    with closing(McapFile(file)) as opened:
        block = opened.contents.blocks[4]
    record = block.offset - 9 - 32 - 4 - 8
    assert content[record] == 6
    content[record + 6] = 0xFF  # its length now runs far past the end
    file.write_bytes(content)
    recovery = recover(file, tmp_path / "whole")
    assert recovery.messages == (CHUNKS - 1) * PER_CHUNK
    assert f"bytes {record} to" in recovery.lost[0]


def test_a_damaged_summary_or_index_costs_no_message(chunked: Path, tmp_path: Path) -> None:
    file = chunked / "run.mcap"
    content = bytearray(file.read_bytes())
    for at in range(chunk_ends(file)[-1] + 20, len(content) - 9, 7):
        content[at] ^= 0x55
    file.write_bytes(content)
    with pytest.raises(BagError):
        read_signals(chunked, [SPEED])
    assert recover(chunked, tmp_path / "whole").messages == CHUNKS * PER_CHUNK


def test_a_folder_without_metadata_gets_them(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "run", np.arange(5.0), np.arange(5.0))
    (bag / "metadata.yaml").write_text("not: [metadata")
    recovery = recover(bag, tmp_path / "whole")
    assert recovery.messages == 10
    [lost] = recovery.lost
    assert "metadata.yaml: it is not YAML" in lost
    with Bag(bag / "run.mcap") as before, Bag(tmp_path / "whole") as after:
        assert list(before.messages()) == list(after.messages())


def test_nothing_to_recover_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(BagError, match="no message can be read"):
        recover(tmp_path / "empty.mcap", tmp_path / "whole")
    assert [p.name for p in tmp_path.iterdir()] == ["empty.mcap"]
    with pytest.raises(BagError, match="there is no bag"):
        recover(tmp_path / "nowhere", tmp_path / "whole")


def test_an_interrupted_copy_leaves_nothing_half_written(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "run", np.arange(3000.0), np.arange(3000.0))
    script = (
        "import os, signal\n"
        "from bags.tools.recover import recover\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # some shells ignore it
        "def interrupt(*_): os.kill(os.getpid(), signal.SIGINT)\n"
        f"recover({str(bag)!r}, {str(tmp_path / 'whole')!r}, progress=interrupt)\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert run.returncode in (-signal.SIGINT, 130, 1)
    assert b"KeyboardInterrupt" in run.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
