"""A recording whose disk is full: closed with the room that was kept, or else left readable."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from bags.recordings.bag import Bag
from bags.recordings.writer import BagWriter, Output
from bags.signals.recording import Arrival, Recording
from bags.tools.recover import repair, unfinished_bags
from tests.bag_messages import CMD, CMD_TYPE, START_NS, command

ROOT = Path(__file__).parents[2]
LIMIT = 30_000  # bytes a file may have
SCRIPT = f"""
import resource, sys
from bags.recordings.definitions import standard_definition
from bags.recordings.writer import BagWriter
from bags.signals.recording import Arrival, Recording
from tests.bag_messages import CMD, CMD_TYPE, START_NS, command

recording = Recording(BagWriter(sys.argv[1], in_place=True), least_free=0.0)
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


def test_where_no_room_can_be_kept_the_bag_is_unfinished_and_can_be_repaired(
    tmp_path: Path,
) -> None:
    """A limit on the size of a file (EFBIG) stands in for a disk that the reserve does not help."""
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
    recording = Recording(BagWriter(tmp_path / "run", in_place=True), least_free=1e12)
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
