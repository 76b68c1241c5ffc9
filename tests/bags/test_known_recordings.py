"""Recordings that others found to be read or copied wrongly, and siblings of each.

The files in ../shared/cases/bags are judged by its EXPECT.md; the siblings are made on the spot:
other storage, other compression, ROS 1 and 2, nested types.
"""

import csv
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from typer.testing import CliRunner

from bags.commands.bag_cli import bag_app
from bags.recordings.bag import Bag
from bags.recordings.mcap_records import CUSTOM_DATA
from bags.recordings.message_types import decode, standard_types, types_in_bag
from bags.signals.reader import read_signals
from bags.tools.info import bag_info
from bags.tools.recover import recover
from nlsid_core.errors import BagError
from tests.bag_messages import CMD_TYPE, START_NS, command, speed_bag
from tests.conftest import SHARED
from tests.mcap_files import write_mcap

CASES = SHARED.parent / "cases" / "bags"
STEP_NS = 20_000_000
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="needs cases/bags in ../shared")

COPIES = [("convert", []), ("convert", ["--every", "10"]), ("recover", [])]


def run(*arguments: object) -> tuple[int, str]:
    """Status and words of `nlsid bag`; an error that `nlsid` says in a line is status 2."""
    result = CliRunner().invoke(bag_app, [str(argument) for argument in arguments])
    if isinstance(result.exception, BagError):
        return 2, str(result.exception)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def table(folder: Path, name: str) -> dict[str, list[str]]:
    """The columns of an exported CSV file, as they are written."""
    with (folder / f"{name}.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    return {column: [row[column] for row in rows] for column in rows[0]}


def exported(bag: Path, out: Path, name: str, column: str) -> list[float]:
    status, said = run("export", bag, "--out", out)
    assert status == 0, said
    return [float(value) for value in table(out, name)[column]]


def ramp(count: int, step: float = 1.0) -> list[float]:
    return [step * k for k in range(count)]


# case, topic's file, column, values in order
EXPORTED = [
    ("compressed_messages_no_metadata/a", "odom", "twist.linear.x", ramp(100, 0.01)),
    ("compressed_whole_qos/a", "odom", "twist.linear.x", ramp(100, 0.01)),
    ("counts_disagree/a", "odom", "twist.linear.x", ramp(60, 0.01)),
    ("humble_range/a", "range", "range", ramp(20, 0.1)),
    ("idl/a.mcap", "t", "a", ramp(5, 0.5)),
    ("mcap_ros1/a.mcap", "odom", "twist.linear.x", ramp(100, 0.01)),
    *(
        (f"metadata_oddities/{name}", "odom", "twist.linear.x", ramp(100, 0.01))
        for name in ("empty_id", "renamed", "v10", "v4")
    ),
    ("no_slash/a.bag", "speed", "data", ramp(40)),
    ("no_slash/a.bag", "cmd__throttle", "data", [100.0 + k for k in range(40)]),
    ("order_of_files/a", "odom", "twist.linear.x", ramp(120)),
    ("order_of_files/b", "odom", "twist.linear.x", ramp(30)),
    ("order_of_files/c.bag", "s", "data", ramp(40)),
    ("ros1_bad_topic/a.bag", "wheel", "data", ramp(20)),
    ("ros1_bad_topic/a.bag", "s", "data", ramp(20)),
    ("ros1_bad_topic/b.bag", "cmd_vel", "linear.x", ramp(20)),
    ("ros1_unindexed/a.bag.active", "s", "data", ramp(50)),
    ("ros1_unindexed/b.bag", "s", "data", ramp(50)),
    ("small_things/empty.mcap", "odom", "twist.linear.x", ramp(20, 0.01)),
    ("small_things/crlf.mcap", "t", "a", ramp(5, 0.5)),
    ("wal/a", "odom", "twist.linear.x", ramp(100, 0.01)),
]
# case, status of `recover`, what it says, what it does not say
RECOVERED = [
    ("compressed_messages_no_metadata/a", 0, "100 messages", "nothing was lost"),
    (
        "compressed_whole_qos/a",
        0,
        "100 messages, read back and compared; nothing was lost",
        "lost:",
    ),
    ("counts_disagree/a", 1, "states 100 messages, 60 are there", "nothing was lost"),
    ("metadata_oddities/renamed", 1, "100 messages", "nothing was lost"),
    ("metadata_oddities/empty_id", 0, "100 messages", "lost:"),
    ("order_of_files/a", 0, "120 messages", "lost:"),
    ("ros1_bad_topic/a.bag", 0, "20 messages on /s", "lost:"),
    ("ros1_unindexed/a.bag.active", 1, "50 messages", "nothing was lost"),
    ("ros1_unindexed/b.bag", 1, "the last 38 bytes", "nothing was lost"),
    ("wal/a", 0, "100 messages", "nothing was lost"),
    ("what_a_copy_loses/a.mcap", 1, "3 sequence numbers are missing", "nothing was lost"),
]


@needs_cases
@pytest.mark.parametrize(("case", "name", "column", "values"), EXPORTED)
def test_a_known_recording_is_exported_right(
    tmp_path: Path, case: str, name: str, column: str, values: list[float]
) -> None:
    np.testing.assert_allclose(exported(CASES / case, tmp_path / "out", name, column), values)


@needs_cases
@pytest.mark.parametrize(("case", "status", "said", "not_said"), RECOVERED)
def test_a_known_recording_is_recovered_right(
    tmp_path: Path, case: str, status: int, said: str, not_said: str
) -> None:
    before = {p.name: p.read_bytes() for p in (CASES / case).parent.rglob("*") if p.is_file()}
    found, output = run("recover", CASES / case, "--out", tmp_path / "whole")
    assert found == status
    assert said in output
    assert not_said not in output
    assert run("info", tmp_path / "whole")[0] == 0
    with Bag(tmp_path / "whole") as bag:
        for topic in bag.topics:
            times = [message.log_time_ns for message in bag.messages([topic], as_recorded=True)]
            assert times == sorted(times)
    after = {p.name: p.read_bytes() for p in (CASES / case).parent.rglob("*") if p.is_file()}
    assert before == after, "a bag is not changed by reading it"


@needs_cases
def test_what_else_the_known_recordings_are_to_say(tmp_path: Path) -> None:
    assert "100 messages, 60 are there" in run("info", CASES / "counts_disagree" / "a")[1]
    cut = run("convert", CASES / "counts_disagree" / "a", "--out", tmp_path / "c")
    assert "100 messages, 60 are there" in cut[1]
    signals = run("signals", CASES / "no_slash" / "a.bag")[1]
    assert "speed:data" in signals
    assert "cmd/throttle:data" in signals
    derived = "/s:data|derivative(0.08 s)"
    out = tmp_path / "d"
    run("export", CASES / "order_of_files" / "c.bag", "--out", out, "-s", derived)
    [steps] = [v for k, v in table(out, "s").items() if "derivative" in k]
    np.testing.assert_allclose([float(v) for v in steps[4:]], 50.0)
    run("export", CASES / "small_things" / "strings.mcap", "--out", tmp_path / "s")
    assert "data" in table(tmp_path / "s", "status")
    run("export", CASES / "small_things" / "empty.mcap", "--out", tmp_path / "e")
    assert list(table(tmp_path / "e", "go")) == ["log_time_ns", "publish_time_ns"]


@needs_cases
def test_each_half_keeps_the_definition_that_it_was_written_with(tmp_path: Path) -> None:
    source = CASES / "two_definitions" / "a.mcap"
    run("convert", source, "--out", tmp_path / "cut", "--end", "0.1")
    assert exported(tmp_path / "cut", tmp_path / "e", "t", "a") == [1.0] * 5
    run("convert", source, "--out", tmp_path / "part", "--every", "0.2")
    for copy in (tmp_path / "part_01", tmp_path / "part_02"):
        values = read_signals(copy, ["/t:a", "/t:b"])
        assert set(values["/t:a"].values) == {1.0}
        assert set(values["/t:b"].values) == {2.0}
    run("convert", source, "--out", tmp_path / "all")
    assert "parts with different definitions" in run("info", "--messages", tmp_path / "all")[1]


@needs_cases
@pytest.mark.parametrize(("how", "more"), COPIES)
def test_a_copy_keeps_all_that_is_no_message(tmp_path: Path, how: str, more: list[str]) -> None:
    run(how, CASES / "what_a_copy_loses" / "a.mcap", "--out", tmp_path / "copy", *more)
    copy = tmp_path / ("copy_01" if more else "copy")
    said = run("info", "--messages", copy)[1]
    for word in ("/quiet", "3 sequence numbers are missing", "robot: x"):
        assert word in said
    with Bag(CASES / "what_a_copy_loses" / "a.mcap") as before, Bag(copy) as after:
        assert list(before.kept_beside) == list(after.kept_beside) != []


# Siblings


def float_message(value: float) -> bytes:
    return b"\0\1\0\0" + struct.pack("<d", value)


def sqlite_bag(
    file: Path, messages: Iterable[tuple[str, str, bytes]], *, release: str = "humble", wal: int = 0
) -> Path:
    """A .db3 as Humble writes it, of (topic, type, data); the last `wal` messages in its -wal."""
    file.parent.mkdir(parents=True, exist_ok=True)
    base = sqlite3.connect(file)
    base.execute("PRAGMA journal_mode=WAL" if wal else "PRAGMA journal_mode=DELETE")
    if release:
        base.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        base.execute("INSERT INTO schema VALUES (3, ?)", [release])
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
        "serialization_format TEXT, offered_qos_profiles TEXT)"
    )
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB)"
    )
    known: dict[str, int] = {}
    listed = list(messages)
    for k, (topic, kind, data) in enumerate(listed):
        if wal and k >= len(listed) - wal:
            base.commit()
        if wal and k == len(listed) - wal:
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        if topic not in known:
            known[topic] = len(known) + 1
            base.execute(
                "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", [known[topic], topic, kind]
            )
        row = [k + 1, known[topic], START_NS + k * STEP_NS, data]
        base.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
    base.commit()
    if wal:  # as a kill leaves it
        kept = {end: Path(f"{file}{end}").read_bytes() for end in ("", "-wal")}
        base.close()
        for end, content in kept.items():
            Path(f"{file}{end}").write_bytes(content)
        return file
    base.close()
    return file


def ros1_bag(
    file: Path,
    messages: Sequence[tuple[int, bytes]],
    *,
    kind: str = "std_msgs/Float64",
    text: str = "float64 data",
    compression: str = "none",
    closed: bool = True,
) -> Path:
    """A ROS 1 bag of (connection, data): connections 0 and 1 are both on `speed`."""
    writer = Ros1Writer(file)
    writer.chunk_threshold = 500
    if compression != "none":
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    with writer:
        known = {
            number: writer.add_connection(
                "speed", kind.replace("/", "/msg/"), msgdef=text, md5sum="*", callerid=f"/{number}"
            )
            for number in sorted({number for number, _ in messages})
        }
        for k, (number, data) in enumerate(messages):
            writer.write(known[number], START_NS + k * STEP_NS, data)
    if not closed:
        content = file.read_bytes()
        at = content.index(b"index_pos=") + len(b"index_pos=")
        (end,) = struct.unpack_from("<Q", content, at)
        file.write_bytes(content[:at] + bytes(8) + content[at + 8 : end])
    return file


def zstd(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def mcap_bag(
    file: Path,
    channels: Sequence[tuple[str, str, str, str, str]],
    messages: Iterable[tuple[int, int, bytes]],
    *,
    change: Callable[[Any], None] = lambda _: None,
    **options: Any,
) -> Path:
    """Channels of (topic, type, schema's encoding, its text, encoding); (channel, log ns, data).

    change: what to do to mcap's writer before it ends the file. options: of the writer.
    """
    with file.open("wb") as stream:
        settings: dict[str, Any] = {"compression": CompressionType.LZ4, "chunk_size": 300} | options
        writer = Writer(stream, **settings)
        writer.start(profile="ros2")
        numbers = [
            writer.register_channel(
                topic, encoding, writer.register_schema(kind, form, text.encode())
            )
            for topic, kind, form, text, encoding in channels
        ]
        for k, (channel, log_ns, data) in enumerate(messages):
            writer.add_message(numbers[channel], log_ns, data, log_ns, sequence=k)
        change(writer)
        writer.finish()  # type: ignore[no-untyped-call]
    return file


FLOAT = ("/x", "std_msgs/msg/Float64", "ros2msg", "float64 data", "cdr")


@pytest.mark.parametrize("storage", ["sqlite", "mcap"])
def test_messages_compressed_one_by_one_are_unpacked(tmp_path: Path, storage: str) -> None:
    packed = [zstd(float_message(k)) for k in range(50)]
    if storage == "mcap":
        rows = [(0, START_NS + k, data) for k, data in enumerate(packed)]
        bag = mcap_bag(tmp_path / "a.mcap", [FLOAT], rows)
    else:
        bag = sqlite_bag(tmp_path / "a.db3", [("/x", FLOAT[1], data) for data in packed])
    assert read_signals(bag, ["/x:data"])["/x:data"].values.tolist() == ramp(50)
    assert recover(bag, tmp_path / "whole").messages == 50
    with Bag(tmp_path / "whole") as whole:
        assert {message.data[:4] for message in whole.messages()} == {b"\0\1\0\0"}


def test_a_message_that_cannot_be_unpacked_is_named_and_left_out_of_copies(tmp_path: Path) -> None:
    packed = [zstd(float_message(k)) for k in range(5)]
    packed[3] = packed[3][:-2]
    bag = sqlite_bag(
        tmp_path / "a.db3",
        [*(("/x", FLOAT[1], data) for data in packed), ("/y", FLOAT[1], float_message(7.0))],
    )
    with pytest.raises(BagError, match=r"/x: message 3 cannot be read"):
        read_signals(bag, ["/x:data"])
    assert "cannot be read" in run("info", "--messages", bag)[1]
    status, said = run("export", bag, "--out", tmp_path / "out")
    assert (status, table(tmp_path / "out", "y")["data"]) == (0, ["7.0"])
    assert "left out" in said
    status, said = run("recover", bag, "--out", tmp_path / "whole")
    assert status == 1
    assert "/x: 1 messages are left out" in said
    assert "4 messages on /x" in said


def test_a_topic_without_a_name_is_left_out_of_an_export_and_the_others_are_not(
    tmp_path: Path,
) -> None:
    bag = tmp_path / "run.mcap"
    write_mcap(bag, dict.fromkeys(("", "/x"), (FLOAT[1], FLOAT[3])))
    status, said = run("export", bag, "--out", tmp_path / "out")
    assert (status, len(table(tmp_path / "out", "x")["data"])) == (0, 1)
    assert "left out" in said


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_a_file_compressed_whole_is_read_by_its_content(tmp_path: Path, suffix: str) -> None:
    plain = tmp_path / "run" / f"a{suffix}"
    plain.parent.mkdir()
    rows = [float_message(k) for k in range(20)]
    if suffix == ".mcap":
        mcap_bag(plain, [FLOAT], ((0, START_NS + k, data) for k, data in enumerate(rows)))
    elif suffix == ".db3":
        sqlite_bag(plain, [("/x", FLOAT[1], data) for data in rows])
    else:
        ros1_bag(plain, [(0, data[4:]) for data in rows])
    packed = plain.with_name(f"{plain.name}.zstd")
    content = plain.read_bytes()
    packed.write_bytes(zstd(content[:500]) + zstd(content[500:]))  # as pzstd does, in frames
    assert recover(plain.parent, tmp_path / "both").messages == 20
    plain.unlink()
    signal = "speed:data" if suffix == ".bag" else "/x:data"
    assert read_signals(packed, [signal])[signal].values.tolist() == ramp(20)
    assert "20 messages" in run("info", packed.parent)[1]
    packed.write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(BagError, match=packed.name):
        read_signals(packed, [signal])


@pytest.mark.parametrize("wal", [1, 60])
def test_what_is_in_a_wal_file_is_read_and_the_bag_stays_as_it_is(tmp_path: Path, wal: int) -> None:
    rows = [("/x", FLOAT[1], float_message(k)) for k in range(100)]
    file = sqlite_bag(tmp_path / "run" / "run_0.db3", rows, wal=wal)
    before = {path: path.read_bytes() for path in file.parent.iterdir()}
    assert len(before) == 2
    assert recover(file.parent, tmp_path / "whole").messages == 100
    assert read_signals(file, ["/x:data"])["/x:data"].values.tolist() == ramp(100)
    assert before == {path: path.read_bytes() for path in file.parent.iterdir()}
    file.rename(file.with_name("renamed_0.db3"))
    assert "run_0.db3-wal is not read: messages of run_0.db3" in run("info", file.parent)[1]


@pytest.mark.parametrize("release", ["foxy", "galactic", "humble", ""])
@pytest.mark.parametrize("kind", ["sensor_msgs/msg/Range", "visualization_msgs/msg/MarkerArray"])
def test_a_type_that_changed_is_read_as_the_release_defines_it(
    tmp_path: Path, release: str, kind: str
) -> None:
    types, wanted = standard_types(f"ros2_{release or 'galactic'}"), 2.5

    def zero(name: str) -> Any:
        defined = types.get_msgdef(name)
        return defined.deserialize_ros1(memoryview(bytes(2**12)), 0, defined.cls, types)[0]

    message, signal = zero(kind), "/x:range"
    if kind.endswith("Range"):
        message.header.stamp.sec, message.range = 5, wanted
    else:
        signal = "/x:markers[0].scale.y"
        message.markers.append(zero("visualization_msgs/msg/Marker"))
        message.markers[0].scale.y = wanted
    data = bytes(types.serialize_cdr(message, kind))
    bag = sqlite_bag(tmp_path / "a.db3", [("/x", kind, data)] * 3, release=release)
    assert read_signals(bag, [signal])[signal].values == pytest.approx(wanted)
    run("convert", bag, "--out", tmp_path / "cut")
    assert read_signals(tmp_path / "cut", [signal])[signal].values[0] == wanted


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("form", ["ros2msg", "ros2idl"])
def test_definitions_are_read_whatever_their_lines_end_with(
    tmp_path: Path, form: str, newline: str
) -> None:
    line = "=" * 80
    inner_idl = (
        '#include "builtin_interfaces/msg/Time.idl"\n#pragma once\n'
        "module p { module msg { struct I { builtin_interfaces::msg::Time t; double a; }; }; };"
    )
    outer_idl = '#include "p/msg/I.idl"\nmodule p { module msg { struct L { p::msg::I i; }; }; };'
    text = {
        "ros2msg": f"# c\np/I i\n{line}\nMSG: p/I\nbuiltin_interfaces/Time t\nfloat64 a\n",
        "ros2idl": f"{line}\nIDL: p/msg/L\n{outer_idl}\n{line}\nIDL: p/msg/I\n{inner_idl}\n",
    }[form].replace("\n", newline)
    data = b"\0\1\0\0" + struct.pack("<iId", 1, 2, 0.5)
    bag = mcap_bag(tmp_path / "a.mcap", [("/x", "p/msg/L", form, text, "cdr")], [(0, 5, data)])
    assert read_signals(bag, ["/x:i.a"])["/x:i.a"].values.tolist() == [0.5]
    run("convert", bag, "--out", tmp_path / "cut")
    assert read_signals(tmp_path / "cut", ["/x:i.a"])["/x:i.a"].values.tolist() == [0.5]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@pytest.mark.parametrize("closed", [True, False])
def test_a_ros_1_bag_with_two_publishers_and_no_slash(
    tmp_path: Path, compression: str, closed: bool
) -> None:
    rows = [(k % 2, struct.pack("<d", k)) for k in range(35)]
    bag = ros1_bag(tmp_path / "a.bag", rows, compression=compression, closed=closed)
    assert exported(bag, tmp_path / "out", "speed", "data") == ramp(35)
    if not closed:
        with pytest.raises(BagError, match="unfinished"):
            read_signals(bag, ["speed:data"])
    cut = tmp_path / "cut.bag.active"
    cut.write_bytes(bag.read_bytes()[:-50])
    found = recover(cut, tmp_path / "whole")
    assert found.lost
    assert 20 <= found.messages <= 35
    values = read_signals(tmp_path / "whole", ["speed:data"])["speed:data"].values
    assert values.tolist() == ramp(found.messages)


def test_a_chunk_of_ros_1_that_a_kill_left_open_is_read_to_its_last_message(tmp_path: Path) -> None:
    """A recorder writes a chunk's size when it closes it."""
    bag = ros1_bag(tmp_path / "a.bag", [(0, struct.pack("<d", k)) for k in range(10)], closed=False)
    content = bytearray(bag.read_bytes())
    at = content.index(b"op=\x05")
    size = content.index(b"size=", at)
    length = size + 9
    content[length : length + 4] = bytes(4)
    content[size + 5 : size + 9] = bytes(4)
    bag.write_bytes(content[:-20])
    assert recover(bag, tmp_path / "whole").messages == 10


@pytest.mark.parametrize(
    ("kind", "text", "data", "field"),
    [
        ("std_msgs/Float32", "float32 data", struct.pack("<fB", 0.5, 0), "data"),
        ("std_msgs/Float32", "", struct.pack("<f", 0.5), "data"),
        (
            "geometry_msgs/Twist",
            "Vector3 linear\nVector3 angular",
            struct.pack("<6d", 0.5, *[0] * 5),
            "linear.x",
        ),
        ("p/Stamped", "Header header\nfloat64 a", struct.pack("<IIIId", 1, 2, 3, 0, 0.5), "a"),
    ],
)
def test_definitions_and_padding_of_ros_1_are_read_as_they_come(
    tmp_path: Path, kind: str, text: str, data: bytes, field: str
) -> None:
    bag = ros1_bag(tmp_path / "a.bag", [(0, data)] * 3, kind=kind, text=text)
    (read,) = read_signals(bag, [f"speed:{field}"]).values()
    stamps = [2 * 10**9 + 3 if kind == "p/Stamped" else START_NS + k * STEP_NS for k in range(3)]
    assert (read.values.tolist(), read.stamp_ns.tolist()) == ([0.5] * 3, stamps)
    package, _, name = kind.partition("/")
    channel = ("/x", f"{package}/{name}", "ros1msg", text, "ros1")
    mcap = mcap_bag(tmp_path / "a.mcap", [channel], [(0, 5, data)])
    assert read_signals(mcap, [f"/x:{field}"])[f"/x:{field}"].values.tolist() == [0.5]
    run("convert", mcap, "--out", tmp_path / "copy")
    assert read_signals(tmp_path / "copy", [f"/x:{field}"])[f"/x:{field}"].values[0] == 0.5


def test_one_damaged_topic_of_ros_1_does_not_spoil_the_others(tmp_path: Path) -> None:
    good = ros1_bag(tmp_path / "good.bag", [(0, struct.pack("<d", k)) for k in range(10)])
    bad = ros1_bag(tmp_path / "bad.bag", [(0, b"\0" * 3)] * 10)
    assert "10 messages" in run("info", bad)[1]
    assert (
        "speed: cannot be read: not a 'std_msgs/msg/Float64' of ROS 1"
        in run("info", "--messages", bad)[1]
    )
    status, said = run("export", bad, "--out", tmp_path / "out")
    assert (status, "nothing was exported" in said) == (2, True)
    run("convert", good, bad, "--out", tmp_path / "all")
    assert read_signals(tmp_path / "all", ["speed:data"])["speed:data"].values.tolist() == ramp(10)


@pytest.mark.parametrize(("how", "more"), COPIES)
def test_a_copy_keeps_two_definitions_apart(tmp_path: Path, how: str, more: list[str]) -> None:
    channels = [
        ("/t", "p/msg/V", "ros2msg", text, "cdr")
        for text in ("float64 a\nfloat64 b", "float64 b\nfloat64 a")
    ]
    rows = [
        (half, START_NS + (10 * half + k) * STEP_NS, b"\0\1\0\0" + struct.pack("<2d", *pair))
        for half, pair in enumerate([(1.0, 2.0), (2.0, 1.0)])
        for k in range(10)
    ]
    bag = mcap_bag(tmp_path / "a.mcap", channels, rows)
    run(how, bag, "--out", tmp_path / "copy", *more)
    found = []
    with Bag(tmp_path / ("copy_01" if more else "copy")) as copy:
        for channel, batch in copy.batches():
            types = types_in_bag(channel.msgtype, channel.definition)
            messages = [decode(batch.data(k), channel.msgtype, types) for k in range(len(batch))]
            found += [(message.a, message.b) for message in messages]  # type: ignore[attr-defined]
    assert found == [(1.0, 2.0)] * 20


def test_a_schema_that_is_not_read_is_copied_as_it_is(tmp_path: Path) -> None:
    channel = ("/p", "pkg.Message", "protobuf", "\x01\u00e9", "protobuf")
    bag = mcap_bag(
        tmp_path / "a.mcap", [channel, FLOAT], [(0, 1, b"xyz"), (1, 2, float_message(0))]
    )
    run("convert", bag, "--out", tmp_path / "cut")
    with Bag(bag) as before, Bag(tmp_path / "cut") as after:
        assert [c.definition for c in before.channels] == [c.definition for c in after.channels]
        assert [m.data for m in before.messages()] == [m.data for m in after.messages()]
    status, said = run("export", bag, "--out", tmp_path / "out")
    assert (status, "left out" in said, "protobuf" in said) == (0, True, True)
    for ending in (".db3", ".bag", ".mcap"):
        status, said = run("convert", bag, "--out", tmp_path / f"b{ending}", "--restamp", "+1")
        unmoved = "stay as they are: /p, /x" if ending == ".mcap" else "stay as they are: /x"
        assert (status, "/p is left out" in said, unmoved in said) == (0, ending != ".mcap", True)
        assert (tmp_path / f"b{ending}").is_file()
        assert bag_info(tmp_path / f"b{ending}").span_ns[1] == 10**9 + 2


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
@pytest.mark.parametrize("listed", [True, False])
def test_parts_are_read_in_the_order_of_time(tmp_path: Path, suffix: str, listed: bool) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    order = [*range(12)][::-1] if listed else [*range(12)]
    for k in range(12):
        rows = [(0, START_NS + (3 * k + i) * STEP_NS, float_message(3 * k + i)) for i in range(3)]
        file = folder / f"run_{k}{suffix}"
        if suffix == ".mcap":
            mcap_bag(file, [FLOAT], rows)
        else:
            sqlite_bag(file, [("/x", FLOAT[1], data) for *_, data in rows])
            base = sqlite3.connect(file)
            base.execute("UPDATE messages SET timestamp = timestamp + ?", [3 * k * STEP_NS])
            base.commit()
            base.close()
    if listed:
        names = "".join(f"    - run_{k}{suffix}\n" for k in order)
        (folder / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 5\n  topics_with_message_count:\n"
            "    - {topic_metadata: {name: /x}, message_count: 36}\n"
            f"  relative_file_paths:\n{names}"
        )
    assert exported(folder, tmp_path / "out", "x", "data") == ramp(36)
    (folder / f"run_5{suffix}").unlink()
    with pytest.raises(BagError, match="which is not there" if listed else "no metadata.yaml"):
        read_signals(folder, ["/x:data"])
    status, said = run("recover", folder, "--out", tmp_path / "whole")
    assert (status, "nothing was lost" in said) == (1, False)
    assert ("run_5" if listed else "part 5 of the recording is not there") in said


def test_numbers_keep_their_types_in_arrays_and_nested_messages(tmp_path: Path) -> None:
    line = "=" * 80
    text = f"p/I i\nint64[2] n\nbool[] on\n{line}\nMSG: p/I\nuint64 u\nint8 s"
    head = struct.pack("<Qb7xqqI2?", 2**64 - 1, -3, 2**53 + 1, -(2**53) - 1, 2, True, False)
    rows = [(0, START_NS + k, b"\0\1\0\0" + head) for k in range(3)]
    bag = mcap_bag(tmp_path / "a.mcap", [("/x", "p/msg/N", "ros2msg", text, "cdr")], rows)
    run("export", bag, "--out", tmp_path / "out")
    columns = table(tmp_path / "out", "x")
    assert {name: values[0] for name, values in columns.items() if "time" not in name} == {
        "i.u": str(2**64 - 1),
        "i.s": "-3",
        "n": str([2**53 + 1, -(2**53) - 1]),
        "on": "[true, false]",
    }
    parquet = pytest.importorskip("pyarrow.parquet")
    run("export", bag, "--out", tmp_path / "p", "-f", "parquet")
    read = parquet.read_table(tmp_path / "p" / "x.parquet")
    assert read["i.u"].to_pylist()[0] == 2**64 - 1
    assert str(read.schema.field("on").type) == "list<element: bool>"


def test_two_topics_whose_files_would_have_one_name_do_not_share_it(tmp_path: Path) -> None:
    channels = [(topic, *FLOAT[1:]) for topic in ("/a/b", "/a__b", "a/b")]
    rows = [(k, START_NS + k, float_message(k)) for k in range(3)]
    bag = mcap_bag(tmp_path / "a.mcap", channels, rows)
    run("export", bag, "--out", tmp_path / "out")
    found = [
        path.read_text().splitlines()[1].split(",")[2] for path in (tmp_path / "out").iterdir()
    ]
    assert sorted(found) == ["0.0", "1.0", "2.0"]


def damaged_metadata(change: Callable[[str], str], folder: Path) -> Path:
    bag = speed_bag(folder, ramp(50), ramp(50))
    metadata = bag / "metadata.yaml"
    before = metadata.read_text()
    metadata.write_text(change(before))
    assert metadata.read_text() != before
    return bag


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace("version: 9", "version: 12"), "version 12"),
        (lambda text: text.replace("storage_identifier: mcap", "storage_identifier: ''"), ""),
        (lambda text: text.replace("storage_identifier: mcap", "storage_identifier: sqlite3"), ""),
        (lambda text: text.replace("trial.mcap", "then_0.mcap"), "then_0.mcap, which is not there"),
        (lambda text: text.replace("trial.mcap", "trial/trial.mcap"), ""),
        (
            lambda text: text.replace("message_count: 100", "message_count: 120"),
            "120 messages in all",
        ),
        (
            lambda text: text.replace(
                "count:\n  -", "count:\n  - {topic_metadata: {name: /q}, message_count: 0}\n  -"
            ),
            "/q: metadata.yaml lists it, no file declares it",
        ),
        (lambda text: text.replace("name: /odom", "name: /gone"), "/gone: metadata.yaml states 50"),
        (lambda text: text.replace("offered_qos_profiles: []", "offered_qos_profiles: 7"), ""),
    ],
)
def test_metadata_that_are_odd_are_read_with_a_word(
    tmp_path: Path, change: Callable[[str], str], said: str
) -> None:
    bag = damaged_metadata(change, tmp_path / "trial")
    status, output = run("info", bag)
    assert (status, "100 messages" in output) == (0, True)
    assert ("not as stated" in output) == bool(said)
    assert said in output
    status, output = run("recover", bag, "--out", tmp_path / "whole")
    assert status == int(bool(said))
    assert "100 messages" in output


@pytest.mark.parametrize("stated", [51, 49])
def test_nothing_was_lost_is_not_said_where_counts_differ(tmp_path: Path, stated: int) -> None:
    bag = damaged_metadata(
        lambda text: text.replace("message_count: 50", f"message_count: {stated}"),
        tmp_path / "trial",
    )
    for how in ("convert", "export", "recover", "info"):
        out = [] if how == "info" else ["--out", tmp_path / how]
        status, said = run(how, bag, *out)
        assert f"states {stated} messages, 50 are there" in said
        assert "nothing was lost" not in said
        assert status == int(how == "recover")
    assert not (tmp_path / "recover" / "missing").exists()


def test_a_copy_of_a_copy_still_tells_what_was_lost(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        number = writer.register_channel("/cmd", "cdr", writer.register_schema(CMD_TYPE, "", b""))
        for k in range(60):
            data = command(START_NS + k, 0.0)
            writer.add_message(number, START_NS + k, data, 0, sequence=k + 4 * (k > 30))
        writer.add_attachment(1, 2, "map.png", "image/png", b"pixels")
        writer.add_metadata("calibration", {"k": "1"})
        writer.finish()  # type: ignore[no-untyped-call]
    run("convert", file, "--out", tmp_path / "one")
    run("convert", tmp_path / "one", "--out", tmp_path / "two")
    assert "4 sequence numbers are missing" in run("info", "--messages", tmp_path / "two")[1]
    with Bag(tmp_path / "two") as bag:
        assert len(list(bag.kept_beside)) == 2
    merged = shutil.copytree(tmp_path / "one", tmp_path / "again")
    run("convert", tmp_path / "one", merged, "--out", tmp_path / "both")
    assert "8 sequence numbers are missing" in run("info", "--messages", tmp_path / "both")[1]


def test_what_only_a_file_says_of_its_bag_is_kept(tmp_path: Path) -> None:
    """A topic that only the summary declares, and custom data without a metadata.yaml."""

    def change(writer: Any) -> None:
        writer.add_metadata(CUSTOM_DATA, {"robot": "x"})
        known = writer._Writer__channels  # as C++'s writer leaves a topic without a message
        known[9] = replace(known[1], id=9, topic="/quiet")

    rows = [(0, START_NS + k, float_message(k)) for k in range(5)]
    (tmp_path / "run").mkdir()
    mcap_bag(tmp_path / "run" / "run_0.mcap", [FLOAT], rows, change=change)
    recover(tmp_path / "run", tmp_path / "whole")
    with Bag(tmp_path / "whole") as bag:
        assert list(bag.topics) == ["/x", "/quiet"]
        assert bag.custom == {"robot": "x"}


def altered(file: Path, before: bytes, after: bytes) -> Path:
    content = file.read_bytes()
    assert before in content
    file.write_bytes(content.replace(before, after, 1))
    return file


def without_counts(total: int) -> Callable[[Any], None]:
    def change(writer: Any) -> None:
        writer._Writer__statistics.channel_message_counts = {}
        writer._Writer__statistics.message_count = total

    return change


MESSAGES = [(0, START_NS + k * STEP_NS, float_message(k)) for k in range(20)]
PLAIN = CompressionType.NONE


def without_data(file: Path) -> Path:
    sqlite_bag(file, [("/x", FLOAT[1], data) for *_, data in MESSAGES])
    base = sqlite3.connect(file)
    base.execute("UPDATE messages SET data = NULL WHERE id = 5")
    base.commit()
    base.close()
    return file


def torn_wal(file: Path) -> Path:
    sqlite_bag(file, [("/x", FLOAT[1], data) for *_, data in MESSAGES], wal=10)
    beside = Path(f"{file}-wal")
    beside.write_bytes(beside.read_bytes()[:-100])
    return file


def flipped_loose(file: Path) -> Path:
    mcap_bag(file, [FLOAT], MESSAGES, use_chunking=False, enable_data_crcs=True)
    return altered(file, float_message(7), float_message(8))


def late_chunk(file: Path) -> Path:
    mcap_bag(file, [FLOAT], MESSAGES, compression=PLAIN, chunk_size=200)
    return altered(file, struct.pack("<Q", START_NS), struct.pack("<Q", START_NS + 2**50))


def unlisted_message(file: Path) -> Path:
    """One behind the last chunk, of which neither summary nor statistics know."""
    mcap_bag(file, [FLOAT], MESSAGES)
    content = file.read_bytes()
    at = 8
    while content[at] != Opcode.DATA_END:
        at += 9 + int.from_bytes(content[at + 1 : at + 9], "little")
    message = struct.pack("<HIQQ", 1, 20, START_NS, START_NS) + float_message(20)
    added = struct.pack("<BQ", Opcode.MESSAGE, len(message)) + message
    places = (each + len(added) for each in struct.unpack_from("<QQ", content, len(content) - 28))
    footer = struct.pack("<QQI", *places, 0)
    file.write_bytes(content[:at] + added + content[at:-28] + footer + content[-8:])
    return file


def unknown_connection(file: Path) -> Path:
    ros1_bag(file, [(0, data[4:]) for *_, data in MESSAGES])
    return altered(file, b"conn=\0\0\0\0\r\0\0\0time", b"conn=\1\0\0\0\r\0\0\0time")


# how it is made, status of `recover`, messages there, what is said, what `convert` says (status 2)
TOLD = [
    (without_data, 1, 19, "1 messages have no time or no data", "have no time or no data"),
    (torn_wal, 1, 19, "the last 1 pages in a-wal are damaged", ""),
    (flipped_loose, 1, 20, "the checksum of all differs", "the checksum of all differs"),
    (late_chunk, 0, 20, "nothing was lost", ""),
    (unlisted_message, 1, 21, "the file states 20 messages, 21 are there", "statistics say 20"),
    (unknown_connection, 1, 19, "1 messages of unknown connection 1", "not hold what its index"),
    (
        lambda file: mcap_bag(file, [FLOAT], MESSAGES, change=without_counts(20)),
        0,
        20,
        "nothing was lost",
        "",
    ),
    (
        lambda file: mcap_bag(file, [FLOAT], MESSAGES, change=without_counts(21)),
        1,
        20,
        "its statistics say 21",
        "its statistics say 21",
    ),
]


@pytest.mark.parametrize(("make", "status", "count", "said", "refused"), TOLD)
def test_what_is_not_as_a_file_states_is_told(
    tmp_path: Path, make: Callable[[Path], Path], status: int, count: int, said: str, refused: str
) -> None:
    bag = make(tmp_path / "a")
    found, output = run("recover", bag, "--out", tmp_path / "whole")
    assert found == status
    assert f"{count} messages, read back" in output
    assert said in output
    assert ("nothing was lost" in output) == (status == 0)
    with Bag(tmp_path / "whole") as whole:
        times = [message.log_time_ns for message in whole.messages(as_recorded=True)]
    assert times == sorted(times)
    found, output = run("convert", bag, "--out", tmp_path / "copy")
    assert (found, refused in output) == (2 if refused else 0, True)


def test_of_a_damaged_sqlite_file_both_ends_come_back(tmp_path: Path) -> None:
    rows = [("/x", FLOAT[1], float_message(k)) for k in range(3000)]
    file = sqlite_bag(tmp_path / "a.db3", rows)
    content = bytearray(file.read_bytes())
    middle = len(content) // 2 // 4096 * 4096
    content[middle : middle + 8192] = b"\xab" * 8192
    file.write_bytes(content)
    with pytest.raises(BagError, match=file.name):
        read_signals(file, ["/x:data"])
    found = recover(file, tmp_path / "whole")
    assert 2500 < found.messages < 3000
    assert "malformed" in found.lost[0]
    values = read_signals(tmp_path / "whole", ["/x:data"])["/x:data"].values
    assert {0.0, 2999.0} < set(values) < set(ramp(3000))
    file.write_bytes(content[: middle - 100])
    cut = recover(file, tmp_path / "cut")
    assert 1000 < cut.messages < 2000
    assert any("bytes are not there" in what for what in cut.lost)


@pytest.mark.parametrize("form", ["sqlite", "ros1", "mcap", "zstd"])
def test_any_changed_byte_ends_in_a_reading_or_an_error_that_names_the_file(
    tmp_path: Path, form: str
) -> None:
    rows = [float_message(k) for k in range(30)]
    plain = tmp_path / "a.mcap"
    if form == "sqlite":
        sqlite_bag(plain, [("/x", FLOAT[1], data) for data in rows])
    elif form == "ros1":
        ros1_bag(plain, [(0, data[4:]) for data in rows], compression="bz2")
    else:
        mcap_bag(plain, [FLOAT], ((0, START_NS + k, data) for k, data in enumerate(rows)))
    content = plain.read_bytes() if form != "zstd" else zstd(plain.read_bytes())
    rng = np.random.default_rng(2)
    for k in range(60):
        changed = bytearray(content)
        changed[int(rng.integers(len(content)))] ^= int(rng.integers(1, 256))
        plain.write_bytes(changed)
        for act in (lambda: bag_info(plain), lambda k=k: recover(plain, tmp_path / f"out_{k}")):
            with suppress(BagError):
                act()
