"""Bad and hostile bags: an error that names the bag, what is wrong and what to do."""

import os
import random
import resource
import signal
import struct
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path
from shutil import rmtree
from typing import Final

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from bags.recordings.bag import Bag
from bags.recordings.mcap_file import McapFile
from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from bags.signals.reader import bag_digest, read_signals
from bags.signals.signal import numeric_paths
from bags.tools.convert import convert
from bags.tools.info import bag_info
from bags.tools.recover import recover
from bags.tools.tables import export_topics
from nlsid_core.errors import BagError, DataError, NlsidError
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
    put,
    speed_bag,
)
from tests.mcap_files import write_mcap

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
    *(  # huge ones cost no memory
        (
            lambda path, n=n: changed(path, "message_count: 50", f"message_count: {n}"),
            SPEED,
            f"/odom has 50 messages, the bag's index says {n}",
        )
        for n in (51, -1, 2**62, 10**30)
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


@pytest.mark.parametrize(
    "content", [b"", b"rosbag2_bagfile_information:\n\tversion: 9\n", b"\0" * 9]
)
def test_damaged_metadata_are_refused_in_a_line_that_says_what_reads_the_bag(
    tmp_path: Path, content: bytes
) -> None:
    """As a computer leaves them that lost its power; `recover` needs none."""
    bag = speed_bag(tmp_path / "run", [0.1, 0.2], [0.3, 0.4])
    (bag / "metadata.yaml").write_bytes(content)
    message = refused(bag)
    assert message.endswith("; `nlsid bag recover` reads the files without it")
    assert "\n" not in message
    assert recover(bag, tmp_path / "whole").messages == 4


def test_topics_of_other_systems_are_exported(tmp_path: Path) -> None:
    topic = "/ünit-1/speed.x"
    with BagWriter(tmp_path / "run") as writer:
        for k in range(3):
            put(writer, k, topic, CMD_TYPE, command(k, float(k)))
    with Bag(tmp_path / "run") as source:
        rows = export_topics(source, tmp_path / "tables", form="csv")
    assert (list(rows.counts.values()), rows.left_out) == ([3], ())
    read = read_signals(tmp_path / "run", [f"{topic}:twist.linear.x|clock(log)"])
    assert [list(samples.values) for samples in read.values()] == [[0.0, 1.0, 2.0]]


def test_an_unfinished_recording_is_called_unfinished(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "live")
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


# -- Bags made to break readers: paths that leave the bag, lies about sizes and counts, bombs, fuzz

FILES: Final = 4_000
SECONDS: Final = 10
MEGABYTES: Final = 500
WORKERS: Final = 2
PART: Final = 500  # files per task


def replaced(bag: Path, name: str) -> None:
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("trial.mcap", name))


@pytest.mark.parametrize("name", ["../other/trial.mcap", "/etc/passwd", "a/../../other/trial.mcap"])
def test_metadata_may_not_name_files_outside_the_bag(bag: Path, name: str) -> None:
    speed_bag(bag.parent / "other", [0.0, 1.0], [0.0, 1.0])
    (bag.parent / "other" / "other.mcap").rename(bag.parent / "other" / "trial.mcap")
    replaced(bag, name)
    with pytest.raises(BagError, match="which is outside the bag"):
        read_signals(bag, [SPEED])


def test_a_link_may_not_lead_outside_the_bag(bag: Path) -> None:
    (bag / "trial.mcap").rename(bag.parent / "elsewhere.mcap")
    (bag / "trial.mcap").symlink_to(bag.parent / "elsewhere.mcap")
    with pytest.raises(BagError, match="which is outside the bag"):
        read_signals(bag, [SPEED])
    (bag / "trial.mcap").unlink()
    (bag / "trial.mcap").symlink_to("trial.mcap")
    with pytest.raises((BagError, OSError)):
        read_signals(bag, [SPEED])


def test_a_type_made_of_itself_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "loop.mcap"
    text = "pkg/A a\n" + "=" * 80 + "\nMSG: pkg/A\npkg/A a"
    write_mcap(file, {"/x": ("pkg/msg/A", text)})
    with pytest.raises(BagError):
        read_signals(file, ["/x:a.a.a"])
    with pytest.raises(NlsidError):
        _read(file, tmp_path / "out")


@pytest.mark.slow
def test_ten_thousand_topics_are_listed_and_read(tmp_path: Path) -> None:
    file = tmp_path / "many.mcap"
    write_mcap(file, {f"/t{k}": ("std_msgs/msg/Float64", "float64 data") for k in range(10_000)})
    with Bag(file) as bag:
        assert len(bag.topics) == 10_000
        assert bag.count("/t9999") == 1
    assert read_signals(file, ["/t9999:data"])["/t9999:data"].values.tolist() == [0.5]


def test_topics_with_no_name_or_odd_names_are_listed(tmp_path: Path) -> None:
    file = tmp_path / "odd.mcap"
    names = ["", "/a b", "/ü", "../../x", "/x\ny", "[red]"]
    write_mcap(file, dict.fromkeys(names, ("std_msgs/msg/Float64", "float64 data")))
    assert {topic.topic for topic in bag_info(file).topics} == set(names)
    assert recover(file, tmp_path / "out").messages == len(names)
    assert {p.name for p in tmp_path.iterdir()} == {"odd.mcap", "out"}


@pytest.fixture(scope="module")
def zeros() -> bytes:
    """300 MB in a few kB."""
    return zstandard.ZstdCompressor(level=1).compress(bytes(300 * 2**20))


@pytest.mark.parametrize("stated", [2**20, 2**31, 2**62])
def test_a_decompression_bomb_is_refused_before_it_unpacks(
    tmp_path: Path, zeros: bytes, stated: int
) -> None:
    file = tmp_path / "bomb.mcap"
    file.write_bytes(bomb_file(zeros, stated))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with closing(McapFile(file, salvage=True)) as opened:
        assert opened.contents.lost
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 200 * 1024


def test_a_type_of_arrays_of_arrays_that_hold_nothing_is_refused(tmp_path: Path) -> None:
    line = "=" * 80
    parts = [
        "pkg/A[1000] a",
        line,
        "MSG: pkg/A",
        "pkg/B[1000] b",
        line,
        "MSG: pkg/B",
        "uint8[0] c",
    ]
    file = tmp_path / "deep.mcap"
    write_mcap(file, {"/x": ("pkg/msg/Deep", "\n".join(parts))})
    with pytest.raises(NlsidError):
        read_signals(file, ["/x:a[999].b[999].c[0]"])


def bomb_file(packed: bytes, *stated: int) -> bytes:
    """An MCAP file with chunks of those zeros, each stating its size."""
    content = b"\x89MCAP0\r\n" + struct.pack("<BQII", 1, 8, 0, 0)
    for size in stated:
        chunk = struct.pack("<QQQII", 0, 0, size, 0, 4) + b"zstd"
        chunk += struct.pack("<Q", len(packed)) + packed
        content += struct.pack("<BQ", 6, len(chunk)) + chunk
    return content


def seeds(folder: Path) -> list[bytes]:
    """Small bags of every layout: zstd, lz4, uncompressed, unchunked, custom types, a bomb."""
    found = []
    options: list[dict[str, object]] = [
        {"compression": kind, "chunk_size": 600} for kind in CompressionType
    ]
    options.append({"use_chunking": False})
    types = {
        "/cmd": (CMD_TYPE, standard_types().generate_msgdef(CMD_TYPE, ros_version=2)[0]),
        "/odom": (ODOM_TYPE, standard_types().generate_msgdef(ODOM_TYPE, ros_version=2)[0]),
        "/x": (
            "pkg/msg/X",
            "string[] names\nfloat64[] data\npkg/Y[2] y\n"
            + "=" * 80
            + "\nMSG: pkg/Y\nint16 a\nstring<=8 b",
        ),
    }
    for k, option in enumerate(options):
        file = folder / f"seed_{k}.mcap"
        with file.open("wb") as stream:
            writer = Writer(stream, **option)  # type: ignore[arg-type]
            writer.start(profile="ros2")
            channels = {
                topic: writer.register_channel(
                    topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode())
                )
                for topic, (kind, text) in types.items()
            }
            for n in range(12):
                writer.add_message(channels["/cmd"], n, command(n + 1, float(n)), n)
                data = b"\0\1\0\0" + struct.pack("<IIxxxxxxxx", 0, 1) + struct.pack("<d", n)
                writer.add_message(channels["/x"], n, data, n)
            writer.add_metadata("custom_data", {"a": "b"})
            writer.finish()  # type: ignore[no-untyped-call]
        found.append(file.read_bytes())
    zeros = zstandard.ZstdCompressor(level=1).compress(bytes(300 * 2**20))
    return [*found, bomb_file(zeros, 300 * 2**20, 2**20)]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """One to four changes: bits, bytes, lengths, cuts, copies, schema text."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        kind, at = rng.randrange(7), rng.randrange(8, max(9, len(data) - 8))
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif kind == 2:
            value = rng.choice((0, 1, 2**16, 2**31 - 1, 2**32, 2**62, 2**64 - 1, len(data)))
            data[at : at + 8] = struct.pack("<Q", value)
        elif kind == 3:
            del data[rng.randrange(8, len(data)) :]
        elif kind == 4:
            data[at:at] = data[at : at + rng.randrange(200)]
        elif kind == 5:
            del data[at : at + rng.randrange(1, 64)]
        else:
            words = (b"float64", b"string", b"uint8", b"data", b"[]", b"pkg/Y", b"names", b"zstd")
            found = data.find(rng.choice(words))
            if found >= 0:
                text = rng.choice((b"[99999]", b"pkg/X", b"\xff\xfe", b"__x__", b"\n=="))
                data[found : found + len(text)] = text
        if len(data) < 16:
            break
    return bytes(data)


def fuzz(folder: str, first: int, contents: list[bytes]) -> dict[str, int]:
    """Outcomes of PART mutated files: data or one of our errors; anything else is raised."""
    limit = MEGABYTES * 2**20
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    signal.signal(signal.SIGPROF, _too_long)
    outcomes = {"data": 0, "error": 0}
    home = Path(folder) / f"part_{first}"
    home.mkdir()
    for number in range(first, first + PART):
        rng = random.Random(number)
        file, out = home / f"{number}.mcap", home / f"{number}.out"
        file.write_bytes(mutated(rng.choice(contents), rng))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of processor time
        for step in STEPS:
            try:
                step(file, out)
            except NlsidError:
                outcomes["error"] += 1
            except BaseException as error:
                kept = Path(folder) / f"bad_{number}.mcap"
                kept.write_bytes(file.read_bytes())
                raise AssertionError(f"file {number}, {kept}: {error!r}") from error
            else:
                outcomes["data"] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
        left = {entry.name for entry in home.iterdir()}
        assert left <= {file.name, out.name}, left
        for entry in out.iterdir() if out.is_dir() else ():
            entry.unlink()
        if out.is_dir():
            out.rmdir()
        file.unlink()
    return outcomes


def _info(file: Path, _: Path) -> None:
    bag_info(file)
    bag_info(file, messages=True)


def _read(file: Path, _: Path) -> None:
    with Bag(file, unfinished=True) as bag:
        for topic in list(bag.topics)[:4]:
            kind, types = bag.types_on(topic)
            for entry in list(numeric_paths(kind, types))[:3]:
                read_signals(bag, [f"{topic}:{entry[0]}"])


def _convert(file: Path, out: Path) -> None:
    with Bag(file, unfinished=True) as bag:
        convert([bag], out)
    assert bag_info(out, messages=True).ending is None
    rmtree(out)


STEPS: Final[tuple[Callable[[Path, Path], object], ...]] = (_info, _read, _convert, recover)


def _too_long(_signal: int, _frame: object) -> None:
    raise TimeoutError(f"more than {SECONDS} s of processor time")


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_thousands_of_mutated_files_give_data_or_our_error_in_bounded_time_and_memory(
    tmp_path: Path,
) -> None:
    contents = seeds(tmp_path)
    outside = set(os.listdir(tmp_path))  # noqa: PTH208
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        parts = [
            pool.submit(fuzz, str(tmp_path), first, contents) for first in range(0, FILES, PART)
        ]
        outcomes = [part.result() for part in parts]
    total = {key: sum(found[key] for found in outcomes) for key in ("data", "error")}
    assert total["data"] + total["error"] == FILES * len(STEPS)
    assert total["data"] > 0.05 * FILES
    assert total["error"] > 0.05 * FILES
    assert {p.name for p in tmp_path.iterdir() if not p.name.startswith("part_")} == outside


def test_a_few_mutated_files_give_data_or_our_error(tmp_path: Path) -> None:
    contents = seeds(tmp_path)
    for number in range(60):
        rng = random.Random(-number)
        file = tmp_path / "mutated.mcap"
        file.write_bytes(mutated(rng.choice(contents), rng))
        for step in STEPS[:3]:
            try:
                step(file, tmp_path / "out")
            except NlsidError as error:
                assert str(file) in str(error)  # noqa: PT017
