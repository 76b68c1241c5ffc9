"""Unfinished and damaged bags: what is complete comes back, the rest is named."""

import resource
import shutil
import signal
import struct
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from bags.monitoring.replay import replay_messages
from bags.recordings.bag import Bag
from bags.recordings.definitions import definitions_from
from bags.recordings.mcap_file import McapFile
from bags.recordings.quality import LATCHED
from bags.recordings.writer import BagWriter, Output
from bags.signals.reader import bag_origin, read_signals
from bags.signals.recording import Arrival, Recording
from bags.tools.convert import convert
from bags.tools.recover import recover, repair, unfinished_bags
from nlsid import Dataset, Design, Fit, Grid, OutputTube, Status, read_bags
from nlsid_core.design import design_output_tube
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError
from nlsid_core.models import DifferenceEquation, Signal
from nlsid_core.running.comparison import Centre
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    COMMAND,
    ODOM,
    ODOM_TYPE,
    PERIOD_NS,
    SPEED,
    START_NS,
    command,
    odometry,
    put,
    speed_bag,
)
from tests.conftest import PERIOD, simulate_truth
from tests.mcap_files import three_readers

CHUNKS, PER_CHUNK = 12, 10


@pytest.fixture
def chunked(tmp_path: Path) -> Path:
    """A bag whose messages, ten to a chunk, are numbered by their speed."""
    with BagWriter(tmp_path / "run", custom={"robot": "car"}) as bag:
        for k in range(CHUNKS * PER_CHUNK):
            stamp = START_NS + k
            put(bag, stamp, ODOM, ODOM_TYPE, odometry(stamp, float(k)))
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


# -- What a killed recorder leaves is found and made a whole bag again

COUNT = 300


def killed_bag(path: Path, *, cut: int) -> Path:
    """A bag of 300 commands in three chunks whose file stops `cut` bytes early."""
    written = path.parent / "whole" / path.name
    with BagWriter(written) as bag:
        for k in range(COUNT):
            stamp = START_NS + k * PERIOD_NS
            put(bag, stamp, CMD, CMD_TYPE, command(stamp, float(k)))
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
    with pytest.raises(BagError, match="truncated or unfinished"):
        Bag(bag)
    kept = repair(bag)
    assert kept % 100 == 0
    assert kept >= 100
    expected = [command(START_NS + k * PERIOD_NS, float(k)) for k in range(kept)]
    assert three_readers(bag, CMD) == [expected] * 3
    assert unfinished_bags(tmp_path) == []
    assert [p.name for p in tmp_path.iterdir()] == ["trial"]


def test_a_repaired_bag_keeps_its_custom_types_and_its_own_data(tmp_path: Path) -> None:
    definition = definitions_from({"my_robot/msg/Arm": "float64 x\n"})["my_robot/msg/Arm"]
    bag = BagWriter(tmp_path / "run", custom={"robot": "arm"})
    bag.add_topic("/arm", definition.msgtype, definition=definition, offered=(LATCHED,))
    for k in range(25):
        data = b"\0\1\0\0" + struct.pack("<d", float(k))
        bag.write("/arm", definition.msgtype, data, log_time_ns=k, publish_time_ns=k)
    bag.close_chunk()
    bag.abandon()
    assert repair(tmp_path / "run") == 25
    with Bag(tmp_path / "run") as source:
        assert source.custom == {"robot": "arm"}
        assert source.offered("/arm") == (LATCHED,)
    [values] = read_signals(tmp_path / "run", ["/arm:x"]).values()
    assert values.values.tolist() == list(range(25))
    with AnyReader([tmp_path / "run"]) as reader:
        assert reader.message_count == 25


def test_a_bag_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "live") as bag:
        bag.add_topic(ODOM, "nav_msgs/msg/Odometry")
        assert unfinished_bags(tmp_path) == []
        with pytest.raises(BagError, match="it is being written"):
            repair(tmp_path / "live")


# -- A recording whose disk is full: closed while there is room, or else left readable

ROOT = Path(__file__).parents[2]
LIMIT = 30_000  # bytes a file may have
SCRIPT = f"""
import resource, sys
from bags.recordings.definitions import standard_definition
from bags.recordings.writer import BagWriter
from bags.signals.recording import Arrival, Recording
from tests.bag_messages import CMD, CMD_TYPE, START_NS, command

recording = Recording(BagWriter(sys.argv[1]), least_free=0.0)
resource.setrlimit(resource.RLIMIT_FSIZE, ({LIMIT}, {LIMIT}))
recording.add_topic(CMD, standard_definition(CMD_TYPE))
for k in range(2000):
    stamp = START_NS + k
    data = command(stamp, k**0.5)  # does not compress away
    recording.add(Arrival(CMD, CMD_TYPE, data, stamp, stamp))
    if k % 50 == 49:
        recording.keep_up()
recording.close()
print(recording.ended)
"""


def test_where_there_is_no_room_the_bag_is_unfinished_and_can_be_repaired(
    tmp_path: Path,
) -> None:
    """A limit on the size of a file (EFBIG) stands in for a full disk."""
    bag = tmp_path / "run"
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(bag)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("recording stopped: [Errno 27] File too large")
    assert "the bag is unfinished and will be repaired" in done.stdout
    assert (bag / "run.mcap").stat().st_size <= LIMIT
    assert unfinished_bags(tmp_path) == [bag]
    kept = repair(bag)
    assert kept % 50 == 0
    assert kept >= 500
    with Bag(bag) as source:
        data = [message.data for message in source.messages()]
    assert data == [command(START_NS + k, k**0.5) for k in range(kept)]


def test_a_write_that_fails_leaves_nothing_of_itself_behind(
    tmp_path: Path,
) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    output = Output(tmp_path / "file")
    output.write(b"whole")
    resource.setrlimit(resource.RLIMIT_FSIZE, (8, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            output.write(b"too long to fit")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    output.write(b" again")
    output.close()
    assert (tmp_path / "file").read_bytes() == b"whole again"


def test_it_ends_while_there_is_room_left_and_says_so(tmp_path: Path) -> None:
    recording = Recording(BagWriter(tmp_path / "run"), least_free=1e12)
    recording.expect(CMD)
    first = Arrival(CMD, CMD_TYPE, command(START_NS, 0.0), START_NS, START_NS)
    recording.add(first)
    recording.keep_up()
    assert "are to stay free" in recording.ended
    recording.add(first)
    recording.close()
    with Bag(tmp_path / "run") as source:
        assert source.count(CMD) == 1
        assert source.custom["ended"] == recording.ended
        assert source.custom[f"{CMD} received"] == "1"


# -- The recorder's clock is set back while it records: log times go back inside a file

SET_AT, BACK = 40, 20  # samples; from the first on, log times are those of so many before


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A drive of a healthy robot; only its log times are wrong."""
    u = np.repeat([0.0, 0.4, 0.1, 0.8, 0.3, 0.6, 0.2, 0.9], 10)
    with BagWriter(tmp_path / "drive") as target:
        for k, (speed, value) in enumerate(zip(simulate_truth(u), u, strict=True)):
            log_ns = START_NS + round((k - BACK * (k >= SET_AT)) * PERIOD * 1e9)
            put(target, log_ns, CMD, CMD_TYPE, command(1, value))
            put(target, log_ns, ODOM, ODOM_TYPE, odometry(1, speed))
    return tmp_path / "drive"


def test_identification_refuses_it_as_it_does_header_stamps(bag: Path) -> None:
    with pytest.raises(BagError) as caught:
        read_bags(
            [bag], responses=[SPEED], excitations=[COMMAND], grid=Grid(max_gap=0.3, clock="log")
        )
    assert f"time goes back by 1.9 s at message {SET_AT}: log time 1700000003.900" in str(
        caught.value
    )
    assert "then 1700000002.000000000 s (1 such place)" in str(caught.value)
    [asked_for] = read_signals(bag, [f"{SPEED}|clock(log)"], sort=True).values()
    assert (np.diff(asked_for.stamp_ns) >= 0).all()


@pytest.mark.parametrize("resampled", ["", "|linear(0.1 s)", "|hold(0.1 s)"])
def test_the_monitor_says_it_and_does_not_blame_the_robot(
    bag: Path, fit: Fit[DifferenceEquation], train: Dataset, resampled: str
) -> None:
    model = replace(
        fit.model,
        y=Signal("speed", "m/s", f"{SPEED}|clock(log){resampled}"),
        u=Signal("command", "m/s", f"{COMMAND}|clock(log)"),
    )
    design = design_output_tube(OutputTube(model, train))
    wired: AnyDesign = Design(design.model, None, design.funnel)
    said = replay_messages(wired, bag, centre=Centre.COMMAND)
    readings = [entry.reading for entry in said]
    assert [r.status for r in readings[len(model) : SET_AT]] == [Status.INSIDE] * (
        SET_AT - len(model)
    )
    assert f"time went back by 1.9 s on {ODOM}" in {r.reason for r in readings}
    assert {r.status for r in readings[SET_AT : SET_AT + BACK]} == {Status.UNKNOWN}
    assert readings[-1].status is Status.INSIDE, "a new run, once the stamps are new again"
    assert {r.status for r in readings} == {Status.UNKNOWN, Status.INSIDE}


def test_messages_are_read_as_recorded_or_by_log_time(bag: Path) -> None:
    with Bag(bag) as source:
        recorded = [(m.topic, m.log_time_ns) for m in source.messages(as_recorded=True)]
        assert [topic for topic, _ in recorded] == [CMD, ODOM] * 80
        assert recorded[2 * SET_AT][1] < recorded[2 * SET_AT - 1][1]
        by_log = [(m.topic, m.log_time_ns) for m in source.messages()]
    assert by_log == sorted(recorded, key=lambda message: message[1])
