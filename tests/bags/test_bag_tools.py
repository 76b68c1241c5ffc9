"""`nlsid bag`: info, signals, plot, check, recover, export, cut, merge, split, import."""

import csv
import json
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from typer.testing import CliRunner

from bags.commands.bag_cli import bag_app
from bags.commands.cli import app
from bags.recordings.bag import Bag
from bags.recordings.definitions import definitions_from
from bags.recordings.folders import expand_bags
from bags.recordings.message_types import standard_types, types_in_bag
from bags.recordings.writer import BagWriter
from bags.samples import schunk
from bags.signals.reader import bag_origin, read_signals
from bags.tools.copies import Rows
from bags.tools.fitness import Level, check_fitness
from bags.tools.importing import import_table
from bags.tools.info import bag_info
from nlsid import Polynomial, frame, identify, read_bags
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
    TRANSFORMS,
    command,
    joints,
    odometry,
    put,
    serialised,
    speed_bag,
    transforms,
)
from tests.conftest import SHARED
from tests.mcap_files import write_mcap
from tests.verbs import nlsid

ROBOT = SHARED / "schunk_arm" / "Robot"


def run(*arguments: object, status: int = 0) -> str:
    result = CliRunner().invoke(bag_app, [str(argument) for argument in arguments])
    if status == 0 and result.exception is not None:
        raise result.exception
    assert result.exit_code == status, result.output
    return result.output


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    t = np.arange(400) * 0.025
    return speed_bag(tmp_path / "trial", np.sin(t), np.repeat(np.arange(40.0), 10))


def test_a_recovery_that_lost_something_ends_with_status_1(bag: Path, tmp_path: Path) -> None:
    file = next(bag.glob("*.mcap"))
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    output = run("recover", damaged, "--out", tmp_path / "whole", status=1)
    assert "what was lost is said above" in output


def leaves(command: Any, name: str = "nlsid") -> dict[str, Any]:
    """Every verb below a command, by its whole name."""
    if not hasattr(command, "commands"):
        return {name: command}
    inside = command.commands.items()
    return {k: v for word, verb in inside for k, v in leaves(verb, f"{name} {word}").items()}


def test_verbs_are_few_and_an_option_means_the_same_in_all_of_them() -> None:
    verbs = leaves(typer.main.get_command(app))
    assert 15 <= len(verbs) <= 21, sorted(verbs)  # decision 64
    said: dict[str, set[str]] = {}
    for name, verb in verbs.items():
        assert verb.help, name
        for parameter in verb.params:
            if parameter.param_type_name == "option":
                assert not parameter.required, f"{name} {parameter.name} has to be given"
                for flag in parameter.opts:
                    said.setdefault(flag, set()).add(parameter.opts[0])
                if parameter.opts[0] in (
                    "--response",
                    "--excitation",
                    "--clock",
                    "--json",
                    "--verbose",
                ):
                    said.setdefault(f"help of {parameter.opts[0]}", set()).add(parameter.help)
    assert {"-y", "-u", "--clock", "--json", "--out", "--verbose"} <= set(said)
    assert not {flag: names for flag, names in said.items() if len(names) > 1}


SCRIPT = """
import sys

sys.modules.update(dict.fromkeys(("scipy", "cvxpy", "clarabel")))
import nlsid
from bags.commands.main import main

assert len(nlsid.frame(sys.argv[3], ["/odom"])) == 400
sys.argv[0] = "nlsid"
main()
"""


def test_bag_tools_need_no_solver_and_what_does_says_which_extra(bag: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    verbs: dict[int, list[tuple[object, ...]]] = {
        0: [
            ("bag", "check", bag),
            ("bag", "plot", bag, "--out", tmp_path / "signals.png"),
            ("bag", "convert", bag, "--out", copy),
        ],
        2: [("identify", copy, bag)],
    }
    for status, verb in ((status, verb) for status, some in verbs.items() for verb in some):
        command = [sys.executable, "-c", SCRIPT, *map(str, verb)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stderr
    assert done.stderr == "error: this needs scipy: pip install 'nlsid[identify]'\n"
    assert bag_info(copy).messages == 800


def test_a_folder_holds_bags_of_one_file_or_one_bag_of_several(bag: Path, tmp_path: Path) -> None:
    content = (bag / "trial.mcap").read_bytes()
    for folder, names in (("runs", ("trial_01", "trial_02")), ("one", ("trial_0", "trial_1"))):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / f"{name}.mcap").write_bytes(content)
    runs = tmp_path / "runs"
    assert expand_bags([runs]) == [runs / "trial_01.mcap", runs / "trial_02.mcap"]
    assert expand_bags([tmp_path / "one"]) == [tmp_path / "one"]


def test_info_states_counts_rates_clocks_and_losses(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "x", custom={"robot": "car"}) as writer:
        for k in range(200):
            stamp = START_NS + k * PERIOD_NS
            data = odometry(stamp - 5 * 10**9, float(k))
            times = {"log_time_ns": stamp, "publish_time_ns": stamp}
            writer.write(ODOM, ODOM_TYPE, data, **times, sequence=k + 3 * (k > 100))
    assert not bag_info(tmp_path / "x", topics=()).topics
    for read in (False, True):
        [topic] = bag_info(tmp_path / "x", messages=read).topics
        assert topic.count == 200
        assert topic.times.rate == pytest.approx(40.0)
        assert topic.times.jitter == pytest.approx(0.0)
        assert (topic.messages is not None) == read
        output = run("info", tmp_path / "x", *["--messages"] * read)
        for part in (
            "200",
            "40 Hz",
            "storage mcap, compression zstd",
            "2023-11-14 22:13",
            "robot: car",
        ):
            assert part in output
        for part in ("-5.000 s", "3 sequence numbers are missing"):
            assert (part in output) == read


def test_info_reads_what_there_is_of_an_unfinished_bag(bag: Path) -> None:
    file = bag / "trial.mcap"
    file.write_bytes(file.read_bytes()[:-20])
    output = run("info", file)
    assert "unfinished" in output
    assert "800 messages on 2 topics" in output


def test_signals_lists_paths_with_units(bag: Path) -> None:
    output = run("signals", bag)
    line = next(line for line in output.splitlines() if "/odom:twist.twist.linear.x" in line)
    assert line.split() == ["/odom:twist.twist.linear.x", "float64", "m/s", "-0.999923", "0.999992"]
    covariance = next(line for line in output.splitlines() if "/odom:pose.covariance[*]" in line)
    assert covariance.split()[2:] == ["36", "0", "0"]
    assert "/odom:pose.pose.orientation.yaw" in output


def test_signals_names_the_joints_and_gives_their_ranges(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "arm") as writer:
        for k in range(5):
            put(writer, k, "/arm", JOINT_TYPE, joints(START_NS + k, [0.5 * k, -1.0 * k]))
        writer.add_topic("/empty", JOINT_TYPE)
    found = json.loads(run("signals", tmp_path / "arm", "--json"))
    listed = {entry["signal"]: entry for entry in found}
    assert listed["/arm:position[name=joint_1]"] == {
        "signal": "/arm:position[name=joint_1]",
        "number": "float64",
        "unit": "rad or m",
        "elements": 1,
        "low": -4.0,
        "high": 0.0,
        "note": "",
    }
    assert listed["/arm:effort[*]"]["low"] is None
    assert listed["/empty:position[*]"]["elements"] == 0
    for signal in ("/arm:position[name=joint_0]", "/arm:position[name=joint_1]"):
        assert len(read_signals(tmp_path / "arm", [signal])[signal]) == 5


def test_info_and_check_speak_json_and_status(bag: Path, tmp_path: Path) -> None:
    info = json.loads(run("info", bag, "--json"))
    assert (info["messages"], info["unfinished"]) == (800, None)
    assert {topic["topic"]: topic["count"] for topic in info["topics"]} == {CMD: 400, ODOM: 400}
    still = speed_bag(tmp_path / "still", np.sin(np.arange(100.0)), np.ones(100))
    said = json.loads(run("check", still, "-u", COMMAND, "-y", SPEED, "--json", status=1))
    assert said[0]["verdict"] == "bad"
    assert {"level", "check", "what"} == set(said[0]["findings"][0])


def test_the_command_line_says_its_version_and_completes_names() -> None:
    assert nlsid("--version").startswith("nlsid 0.")
    assert "--install-completion" in nlsid("--help")


def test_operations_are_exported(bag: Path, tmp_path: Path) -> None:
    signal = f"{SPEED}|derivative(0.2 s)|to(g)"
    run("export", bag, "--out", tmp_path / "tables", "-s", signal)
    with (tmp_path / "tables" / "odom.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    column = [float(row[signal.removeprefix(f"{ODOM}:")]) for row in rows]
    expected = read_signals(bag, [signal])[signal].values.tolist()
    assert column[-len(expected) :] == expected
    assert np.isnan(column[: -len(expected)]).all()


STAMPED = "std_msgs/Header header\nfloat64 throttle\n"
DEFINED = {  # place -> its text, the type, the bytes before the number and the signal
    "msg/Drive.msg": (STAMPED, "my/msg/Drive", (b"\1" + bytes(7)) * 2, "/drive:throttle"),
    "msg/Drive.idl": (
        "module my { module msg { struct Drive { long count; double throttle; }; }; };",
        "my/msg/Drive",
        bytes(8),
        "/drive:throttle",
    ),
    "srv/Drive.srv": (
        "float64 throttle\n---\nbool done\n",
        "my/srv/Drive_Event",
        bytes(40) + b"\1" + bytes(7),
        "/drive:request[0].throttle",
    ),
    "action/Drive.action": (
        "float64 far\n---\nbool done\n---\nfloat64 throttle\n",
        "my/action/Drive_FeedbackMessage",
        bytes(16),
        "/drive:feedback.throttle",
    ),
}


@pytest.mark.parametrize("place", DEFINED)
def test_a_type_that_the_bag_does_not_define_is_read_from_its_file(
    tmp_path: Path, place: str
) -> None:
    text, msgtype, before, signal = DEFINED[place]
    file = tmp_path / "my" / place
    file.parent.mkdir(parents=True)
    file.write_text(text)
    bare = tmp_path / "bare.mcap"
    with bare.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        channel = writer.register_channel("/drive", "cdr", writer.register_schema(msgtype, "", b""))
        for k in range(50):
            data = b"\0\1\0\0" + before + struct.pack("<d", k) + b"\0" * 4 * ("srv" in place)
            writer.add_message(channel, START_NS + k, data, START_NS + k)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates half of its writer
    with pytest.raises(BagError, match=rf"'{msgtype}' is not known: .*--definitions"):
        read_signals(bare, [signal])
    given = ["--definitions", tmp_path / "my"]
    assert "throttle" in run("signals", bare, *given)
    run("export", bare, "--out", tmp_path / "tables", *given)
    run("info", bare, *given)
    run("convert", bare, "--out", tmp_path / "defined", *given)
    read = read_signals(tmp_path / "defined", [signal])
    assert read[signal].values.tolist() == np.arange(50.0).tolist()


@pytest.mark.pictures
@pytest.mark.parametrize("name", ["a.png", "a.svg"])
def test_a_plot_is_a_picture(bag: Path, tmp_path: Path, name: str) -> None:
    run("plot", bag, "--out", tmp_path / name, "-s", SPEED, "-s", f"{SPEED}|derivative(0.2 s)")
    content = (tmp_path / name).read_bytes()
    assert content.startswith(b"\x89PNG" if name.endswith("png") else b"<")
    with pytest.raises(DataError, match="a picture is a"):
        run("plot", bag, "--out", tmp_path / "a.bmp", "-s", SPEED)


def test_a_cut_has_the_messages_of_its_stretch_and_topics(bag: Path, tmp_path: Path) -> None:
    run("convert", bag, "--out", tmp_path / "part", "--start", "1", "--end", "2", "--topics", "/o*")
    with Bag(tmp_path / "part") as part, Bag(bag) as whole:
        expected = [
            m
            for m in whole.messages([ODOM])
            if START_NS + 10**9 <= m.log_time_ns < START_NS + 2 * 10**9
        ]
        assert list(part.messages()) == expected
        assert len(expected) == 40
    with pytest.raises(BagError, match="exists already"):
        run("convert", bag, "--out", tmp_path / "part")
    with pytest.raises(BagError, match="no message can be read there"):
        run("convert", bag, "--out", tmp_path / "none", "--start", "99")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(("how", "count"), [(("--every", "30"), 4), (("--max-size", "0.02"), 5)])
def test_parts_of_a_bag_merge_to_the_whole(
    tmp_path: Path, how: tuple[str, str], count: int
) -> None:
    bag = speed_bag(tmp_path / "long", np.arange(4000.0), np.arange(4000.0))
    run("convert", bag, "--out", tmp_path / "part", *how)
    parts = sorted(tmp_path.glob("part_*"))
    assert len(parts) == count
    run("convert", *reversed(parts), "--out", tmp_path / "again")
    with Bag(tmp_path / "again") as again, Bag(bag) as whole:
        assert list(again.messages()) == list(whole.messages())


CHOSEN: dict[tuple[str, ...], tuple[int, float]] = {  # messages of the trial, from s on
    ("--end", "2"): (160, 0.0),
    ("--start", "2023-11-14T22:13:29.5"): (40, 9.5),
    ("--start", str((START_NS + 95 * 10**8) // 10**9)): (80, 9.0),
    ("--around", "5", "--before", "0.1", "--after", "0.05"): (14, 4.9),
    ("--around", ODOM, "--before", "0", "--after", "0"): (800, 0.0),
}


@pytest.mark.parametrize("options", CHOSEN)
def test_a_moment_is_s_or_a_date_and_an_event_a_moment_or_a_topic(
    bag: Path, tmp_path: Path, options: tuple[str, ...]
) -> None:
    run("convert", bag, "--out", tmp_path / "part", *options)
    with Bag(tmp_path / "part") as part:
        times = [message.log_time_ns for message in part.messages()]
    count, first = CHOSEN[options]
    assert (len(times), times[0]) == (count, START_NS + round(first * 1e9))


def test_names_and_times_change_and_what_does_not_fit_is_refused(bag: Path, tmp_path: Path) -> None:
    speed = SPEED.replace(ODOM, "/robot/odom")
    named = ["--rename", f"{ODOM}=/robot/odom"]
    run("convert", bag, "--out", tmp_path / "moved", "--restamp", "+10", *named)
    moved = read_signals(tmp_path / "moved", [speed])[speed]
    before = read_signals(bag, [SPEED])[SPEED]
    np.testing.assert_array_equal(moved.values, before.values)
    np.testing.assert_array_equal(moved.stamp_ns, before.stamp_ns + 10 * 10**9)
    with BagWriter(tmp_path / "late") as writer:
        for k in range(3):
            put(writer, 7 + k, ODOM, ODOM_TYPE, odometry(START_NS + k, float(k)))
    for rule, expected in (("header", START_NS), ("log", 7)):
        run("convert", tmp_path / "late", "--out", tmp_path / rule, "--restamp", rule)
        with Bag(tmp_path / rule) as copy:
            logged = next(iter(copy.messages())).log_time_ns
        stamped = read_signals(tmp_path / rule, [SPEED])[SPEED].stamp_ns[0]
        assert (logged, stamped) == (expected, expected)
    for wrong in (
        ["--topics", "/none*"],
        ["--rename", f"{ODOM}={CMD}"],
        ["--rename", f"{ODOM}=/one", "--rename", f"{CMD}=/one"],
        *(["--restamp", rule] for rule in ("soon", "nan", "inf", "1e300", "+3e9", "-3e9")),
        *(["--start", moment] for moment in ("noon", "nan", "-inf", "1e300", "2024-13-01")),
        ["--max-size", "0"],
        ["--max-size", "nan"],
        ["--storage", "hdf5"],
        ["--compression", "zip"],
        ["--compression", "lz4", "--storage", "sqlite3"],
        ["--every", "0"],
    ):
        with pytest.raises(BagError):
            run("convert", bag, "--out", tmp_path / "wrong", *wrong)
        assert not (tmp_path / "wrong").exists()


@pytest.mark.parametrize(
    ("storage", "asked", "name"),
    [
        ("sqlite3", "copy", "copy"),
        ("ros1", "copy.bag", "copy.bag"),
        ("ros1", "run_1.5", "run_1.5.bag"),
    ],
)
def test_other_storages_hold_the_same_numbers(
    bag: Path, tmp_path: Path, storage: str, asked: str, name: str
) -> None:
    said = run("convert", bag, "--out", tmp_path / asked, "--storage", storage)
    assert f"{storage} keeps no sequence numbers" in said
    assert storage in run("info", tmp_path / name)
    copy, before = (read_signals(b, [SPEED])[SPEED] for b in (tmp_path / name, bag))
    np.testing.assert_array_equal(copy.values, before.values)
    np.testing.assert_array_equal(copy.stamp_ns, before.stamp_ns)


def test_two_definitions_of_a_type_do_not_merge(tmp_path: Path) -> None:
    for name, text in (("a", "float64 x"), ("b", "float64 x"), ("c", "float32 x")):
        write_mcap(tmp_path / f"{name}.mcap", {"/x": ("pkg/msg/X", text)})
    a, b, c = (tmp_path / f"{name}.mcap" for name in "abc")
    run("convert", a, b, "--out", tmp_path / "ab")
    with pytest.raises(BagError, match="two definitions of 'pkg/msg/X'; keep them in two bags"):
        run("convert", a, c, "--out", tmp_path / "ac")
    assert not (tmp_path / "ac").exists()


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_exported_topics_hold_the_bags_numbers_bit_for_bit(
    bag: Path, tmp_path: Path, form: str
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow")
    run("export", bag, "--out", tmp_path / "tables", "-f", form)
    table = table_in(tmp_path / "tables" / f"odom.{form}")
    samples = read_signals(bag, [SPEED])[SPEED]
    np.testing.assert_array_equal(table["twist.twist.linear.x"], samples.values)
    np.testing.assert_array_equal(np.asarray(table["stamp_ns"], dtype=np.int64), samples.stamp_ns)
    covariance = table["pose.covariance"][399]
    assert list(json.loads(covariance) if form == "csv" else covariance) == [0.0] * 36
    assert set(table["header.frame_id"]) == set(frame(bag, [ODOM])["header.frame_id"])


def table_in(path: Path) -> Any:
    if path.suffix == ".csv":
        with path.open() as stream:
            rows = list(csv.DictReader(stream))
        columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
        columns["twist.twist.linear.x"] = list(map(float, columns["twist.twist.linear.x"]))
        return columns
    from pyarrow import parquet

    table = parquet.read_table(path)
    return {name: table[name].to_numpy() for name in table.column_names}


def test_what_changes_its_length_and_what_is_nested_are_lists_of_true_types(tmp_path: Path) -> None:
    text = (
        "byte[] codes\nbool on\nstring word\nstring[] words\n"
        "geometry_msgs/Point[] points\nuint8[] pixels\n"
    )
    defined = definitions_from({"my/msg/All": text})["my/msg/All"]
    embedded = MessageDefinition(MessageDefinitionFormat.MSG, defined.text)
    types = types_in_bag("my/msg/All", embedded)
    point = types.types["geometry_msgs/msg/Point"]
    with BagWriter(tmp_path / "all") as writer:
        writer.add_topic("/all", "my/msg/All", definition=defined)
        for k in range(400):  # two chunks: in the first there is no point
            codes = np.full(k % 3, 200, np.uint8)
            words, points = ["a"] * (k % 2), [point(float(k), 0.0, 0.0)] * (k // 300)
            message: Any = types.types["my/msg/All"](
                codes, k > 5, f"w{k}", words, points, np.zeros(5000, np.uint8)
            )
            data = bytes(types.serialize_cdr(message, "my/msg/All"))
            writer.write("/all", "my/msg/All", data, log_time_ns=k, publish_time_ns=k)
    rows = frame(tmp_path / "all", ["/all"])
    assert rows.attrs["left_out"] == ["/all:pixels: 5000 elements; name those you need"]
    assert rows["on"].dtype == bool
    assert rows["word"].tolist() == [f"w{k}" for k in range(400)]
    assert [list(codes) for codes in rows["codes"][:3]] == [[], [200], [200, 200]]
    assert rows["words"].tolist()[:2] == [[], ["a"]]
    assert rows["points"].iloc[399] == [{"x": 399.0, "y": 0.0, "z": 0.0}]
    run("export", tmp_path / "all", "--out", tmp_path / "tables")
    with (tmp_path / "tables" / "all.csv").open() as stream:
        cells = list(csv.DictReader(stream))
    assert [json.loads(row["codes"]) for row in cells[:3]] == [[], [200], [200, 200]]
    assert (cells[7]["on"], cells[7]["word"], cells[7]["words"]) == ("True", "w7", '["a"]')
    parquet = pytest.importorskip("pyarrow.parquet")
    run("export", tmp_path / "all", "--out", tmp_path / "columns", "-f", "parquet")
    columns = parquet.read_table(tmp_path / "columns" / "all.parquet")
    assert columns["points"].to_pylist() == rows["points"].tolist()
    assert str(columns.schema.field("codes").type) == "list<element: uint8>"


def test_a_frame_has_one_time_base(bag: Path) -> None:
    whole = frame(bag, [SPEED, CMD])
    assert whole.index.is_monotonic_increasing
    assert len(whole) == 400
    assert whole.index[0].value == START_NS
    fifth = frame(bag, [f"{SPEED}|to(km/h)", CMD], period=0.5, clock="log")
    assert fifth.index[1].value - fifth.index[0].value == 500_000_000
    with pytest.raises(BagError, match="has no topic /nothing"):
        frame(bag, "/nothing")
    for clock, period in (("logged", 1.0), ("log", 0.0)):
        with pytest.raises(BagError, match="a frame has the clock header or log"):
            frame(bag, SPEED, clock=clock, period=period)


def test_a_frame_keeps_large_integers_where_rows_come_before_them(tmp_path: Path) -> None:
    """NaN in the first rows would make floats of them, which have 53 bits."""
    large = {2: 2**60 + 1, 3: 2**60 + 3}
    with BagWriter(tmp_path / "late") as writer:
        for k in range(4):
            put(writer, k, CMD, CMD_TYPE, command(k, float(k)))
            for kind, value in (("Int64", large[k]), ("Bool", k == 2)) if k > 1 else ():
                msgtype = f"std_msgs/msg/{kind}"
                message = standard_types().types[msgtype](value)
                put(writer, k, f"/{kind}", msgtype, serialised(msgtype, message))
    rows = frame(tmp_path / "late", [COMMAND, "/Int64", "/Bool"], clock="log")
    assert rows["/Int64:data"].isna().tolist() == [True, True, False, False]
    assert [rows[f"/{name}:data"].dropna().tolist() for name in ("Int64", "Bool")] == [
        list(large.values()),
        [True, False],
    ]
    assert (
        frame(tmp_path / "late", ["/Int64", COMMAND], clock="log")["/Int64:data"].dtype == "int64"
    )


def test_the_chain_of_transforms_that_the_page_shows_is_that_of_the_frames(tmp_path: Path) -> None:
    """Its program, on two links that turn: each beside other publishers, one of them static."""
    page = (Path(__file__).parents[2] / "docs" / "howto-bags.md").read_text()
    program = next(part for part in page.split("```")[1::2] if "from_quat" in part)
    angles, turn = 0.1 * np.arange(5), 0.3
    with BagWriter(tmp_path / "run") as writer:
        for k, angle in enumerate(angles):
            at, still = (k + 1) * 10**9, (np.zeros(3), 0.0)
            sent = [("/tf", "odom", (np.array([2.0, 0.0, 0.0]), angle)), ("/tf", "camera", still)]
            if k == 0:
                base = np.array([1.0, 0.0, 0.0]), turn
                sent += [("/tf_static", "base_link", base), ("/tf_static", "lidar", still)]
            for topic, child, moved in sent:
                put(writer, at, topic, TRANSFORMS, transforms(at, {child: moved}))
    known: dict[str, Any] = {"BAG": tmp_path / "run"}
    exec(program.partition("\n")[2], known)  # the program of the page
    np.testing.assert_allclose(known["pose"][:, 0, 3], 2.0 + np.cos(angles), atol=1e-12)
    np.testing.assert_allclose(known["pose"][:, 1, 3], np.sin(angles), atol=1e-12)
    np.testing.assert_allclose(known["pose"][:, 0, 0], np.cos(angles + turn), atol=1e-12)


def test_a_good_recording_is_called_fit_and_bad_ones_say_why(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    u = np.repeat(rng.standard_normal(100), 8)
    y = np.convolve(u, np.exp(-np.arange(40) / 10) / 10)[:800] + 1e-4 * rng.standard_normal(800)
    good = speed_bag(tmp_path / "good", y, u)
    again = speed_bag(tmp_path / "again", y, u + 1e-3 * rng.standard_normal(800))
    still = speed_bag(tmp_path / "still", y, np.ones(800))
    coarse = speed_bag(tmp_path / "coarse", np.clip(np.round(y, 0), -1, 0.5), u)
    jitter = (START_NS + np.arange(800) * PERIOD_NS + rng.integers(0, PERIOD_NS, 800)).tolist()
    ragged = speed_bag(tmp_path / "ragged", y, u, stamps_ns=jitter)
    results = check_fitness(
        [good, again, still, coarse, ragged], excitations=[COMMAND], responses=[SPEED]
    )
    found = {r.bag.name: r for r in results}
    assert found["good"].verdict is Level.GOOD
    reasons = {n: {f.check for f in r.findings if f.level > Level.GOOD} for n, r in found.items()}
    assert found["still"].verdict is Level.LOOK, "other bags have other commands"
    assert "excitation" in reasons["still"]
    assert {"saturation", "quantisation"} <= reasons["coarse"]
    assert "regularity" in reasons["ragged"]
    assert "fit for identification" in run("check", good, "-u", COMMAND, "-y", SPEED)
    assert "not fit" in run("check", still, "-u", COMMAND, "-y", SPEED, status=1)
    run("check", good, still, "-u", COMMAND, "-y", SPEED)


def test_every_element_of_a_command_is_checked(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    with BagWriter(tmp_path / "arm") as writer:
        for k in range(100):
            for topic in ("/joint_commands", "/joint_states"):
                stamp = START_NS + k * PERIOD_NS
                put(writer, stamp, topic, JOINT_TYPE, joints(stamp, rng.standard_normal(3)))
    [found] = check_fitness(
        [tmp_path / "arm"],
        excitations=["/joint_commands:position[*]"],
        responses=["/joint_states:position[*]"],
    )
    said = " ".join(finding.what for finding in found.findings)
    for k in range(3):
        assert f"/joint_commands:position[{k}]: 95 % of its power" in said
        assert f"/joint_states:position[{k}]: 40 Hz" in said


def test_commands_that_come_when_they_like_are_not_bad(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    with BagWriter(tmp_path / "teleop") as writer:
        held = 0.0
        for k in range(800):
            stamp = START_NS + k * PERIOD_NS
            held += 0.3 * (rng.standard_normal() - held)
            put(writer, stamp, ODOM, ODOM_TYPE, odometry(stamp, held))
            if rng.random() < 0.3:
                at = stamp + int(rng.integers(0, PERIOD_NS))
                put(writer, at, CMD, CMD_TYPE, command(at, float(rng.standard_normal())))
    [found] = check_fitness([tmp_path / "teleop"], excitations=[COMMAND], responses=[SPEED])
    assert found.verdict < Level.BAD
    said = {f.check: f for f in found.findings}
    assert said["commands"].level is Level.GOOD
    assert "(grid.hold)" in said["commands"].what


def test_a_command_that_changes_only_where_no_response_is_is_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "late") as writer:
        for k in range(100):
            stamp = START_NS + k * PERIOD_NS
            put(writer, stamp, CMD, CMD_TYPE, command(stamp, 1.0 if k < 50 else 0.5))
            if k >= 50:
                put(writer, stamp, ODOM, ODOM_TYPE, odometry(stamp, 0.1 * (k % 7)))
    [found] = check_fitness([tmp_path / "late"], excitations=[COMMAND], responses=[SPEED])
    assert found.verdict is Level.BAD
    said = [finding.what for finding in found.findings if finding.level is Level.BAD]
    assert said == [f"{COMMAND} is 0.5 wherever every response was recorded: no excitation"]
    dataset = read_bags([tmp_path / "late"], responses=[SPEED], excitations=[COMMAND])
    with pytest.raises(DataError, match=r"/cmd_vel.* is constant \(0\.5\) in all trials"):
        identify(dataset, Polynomial(1))


def test_imported_columns_read_back_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    table = rng.standard_normal((50, 2))
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="cmd,speed", comments="")
    run(
        "import",
        tmp_path / "log.csv",
        "--out",
        tmp_path / "bag",
        "--period",
        "0.02",
        "-s",
        f"{CMD}:twist.linear.x=cmd",
        "-s",
        f"{ODOM}:twist.twist.linear.x=speed",
        "-s",
        "/power:data=cmd",
        "--type",
        f"{CMD}=geometry_msgs/msg/TwistStamped",
        "--type",
        f"{ODOM}={ODOM_TYPE}",
        "--start",
        "1000",
        "--custom",
        "robot=car",
    )
    read = read_signals(tmp_path / "bag", [COMMAND, SPEED, "/power:data"])
    written = np.loadtxt(tmp_path / "log.csv", delimiter=",", skiprows=1)
    for path in (COMMAND, "/power:data"):  # a topic with one number needs no type
        np.testing.assert_array_equal(read[path].values, written[:, 0])
    np.testing.assert_array_equal(read[SPEED].values, written[:, 1])
    assert np.diff(read[SPEED].stamp_ns).tolist() == [20_000_000] * 49
    assert read[SPEED].stamp_ns[0] == 1000 * 10**9
    assert bag_origin(tmp_path / "bag")["custom"] == {"robot": "car"}


def test_every_column_is_a_topic_where_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t,voltage [V],yaw rate,2nd=b\n0,1,0.1,7\n0.02,2,0.3,8\n")
    run("import", tmp_path / "log.csv", "--out", tmp_path / "bag")
    read = read_signals(
        tmp_path / "bag", ["/voltage_V:data", "/yaw_rate:data", "/column_2nd_b:data"]
    )
    assert [signal.values.tolist() for signal in read.values()] == [[1, 2], [0.1, 0.3], [7, 8]]


def import_speed(tmp_path: Path, text: str, rows: Rows) -> str:
    """A bag `bag` of a table's column `speed`; how its times were understood."""
    (tmp_path / "log.csv").write_text(text)
    return import_table(
        tmp_path / "log.csv",
        tmp_path / "bag",
        [f"{SPEED}=speed"],
        types={ODOM: ODOM_TYPE},
        rows=rows,
    ).times


@pytest.mark.parametrize(
    ("title", "asked", "first", "scale", "said"),
    [
        ("t", "t", 0.0, 1.0, "taken as s"),
        ("t_ms", "t_ms", 0.0, 1e3, "taken as ms"),
        ("time [us]", "time [us]", 0.0, 1e6, "taken as us"),
        ("t", "t|unit(ns)", 0.0, 1e9, "taken as ns"),
        ("stamp", "stamp", 1.7e9, 1e3, "taken as ms"),
        ("stamp", "stamp", 1.7e9, 1e6, "taken as us"),
        ("stamp", "stamp", 1.7e9, 1.0, "taken as s"),
    ],
)
def test_times_in_every_unit_are_read_right(
    tmp_path: Path, title: str, asked: str, first: float, scale: float, said: str
) -> None:
    rows = [f"{(first + 0.025 * k) * scale:.6f},{k}" for k in range(5)]
    times = import_speed(tmp_path, "\n".join([f"{title},speed", *rows]), Rows(time=asked))
    assert times.startswith("5 rows over 0.1 s, 40 Hz by the column ")
    assert times.endswith(said)
    stamps = read_signals(tmp_path / "bag", [SPEED])[SPEED].stamp_ns
    assert np.abs(np.diff(stamps) - 25_000_000).max() < 1000


BY_T, BY_S = Rows(time="t"), Rows(time="t|unit(s)")
SEVENTIES = r"since 1970 \(1 such rows\)"
TABLES: list[tuple[str, Rows, list[float] | str]] = [
    ("t,speed\n0,0\n25,1\n50,2\n", BY_S, [0.0, 1.0, 2.0]),
    ("t,speed\n0,0\n25,1\n50,2\n", BY_T, r"are 25 apart, 3 rows over 50: .*--time 't\|unit\(ms\)'"),
    ("t,speed\n0,1\n0.1,2\n0.1,2.5\n", BY_T, "does not increase after row 1"),
    ('t,"speed",mode\n0.0,1.5,auto\n0.1,3,"by, hand"\n', BY_T, [1.5, 3.0]),
    ("t,speed\n0,1\n,2\n1,3\n", BY_T, r"^no time in row 1 \(1 such rows\)$"),
    ("t,speed\n0,1\n0.1,fast\n0.2,2\n", BY_T, "'fast' in line 3, column 'speed' is no number$"),
    ("0,1\n0.1,2\n", BY_T, "its first line holds numbers; write the columns' titles there$"),
    ("x,x\n0.1,2\n", BY_T, "two columns are called 'x'$"),
    ("t;x\n0;1\n\n0.1\n", BY_T, "1 cells in line 4, 2 in line 1$"),
    *((empty, BY_T, r"log\.csv holds no table of numbers$") for empty in ("", "\n\n", "t,x\n")),
    (
        "t,speed\n-0.1,1\n0.4,2\n",
        BY_T,
        rf"^the time of row 0 is -0\.1 s {SEVENTIES}.*--start 1 moves",
    ),
    (
        "t,speed\n2147483647.5,1\n2147483648,2\n",
        BY_T,
        f"^the time of row 1 is 2147483648 s {SEVENTIES}",
    ),
    ("t,speed\n-0.1,1\n0.4,2\n", Rows(time="t", start=0.1), [1.0, 2.0]),
    ("speed,Time (ms)\n1,0\n2,100\n", Rows(), [1.0, 2.0]),
    ("stemp,speed\n0,1\n0.1,2\n", Rows(), r"their times \(--time\); there are: stemp, speed$"),
]


@pytest.mark.parametrize(("text", "rows", "said"), TABLES)
def test_a_table_is_read_or_what_is_wrong_is_said(
    tmp_path: Path, text: str, rows: Rows, said: list[float] | str
) -> None:
    if isinstance(said, list):
        import_speed(tmp_path, text, rows)
        assert read_signals(tmp_path / "bag", [SPEED])[SPEED].values.tolist() == said
        return
    with pytest.raises(DataError, match=said):
        import_speed(tmp_path, text, rows)
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("/arm:position[0]=nothing", "no column of numbers 'nothing'; there are: a, b"),
        ("/arm:posit[0]=a", "Field 'posit' does not exist"),
        ("/arm:position[0]", "is not signal=column"),
        ("/other:position[0]=a", "nothing is assigned to /arm"),
        ("", "make one topic: name them"),
    ],
)
def test_an_import_that_does_not_fit_is_refused_and_writes_nothing(
    tmp_path: Path, assignment: str, message: str
) -> None:
    (tmp_path / "log.csv").write_text("a,b,b?\n0,0,0\n1,1,1\n")
    with pytest.raises(DataError, match=message):
        import_table(
            tmp_path / "log.csv",
            tmp_path / "x",
            [assignment] * bool(assignment),
            types={"/arm": JOINT_TYPE},
            rows=Rows(period=1.0),
        )
    assert os.listdir(tmp_path) == ["log.csv"]  # noqa: PTH208


def test_the_shipped_arm_is_small_and_documented() -> None:
    bags = schunk()
    assert len(bags) == 6
    assert sum(f.stat().st_size for bag in bags for f in bag.iterdir()) < 1e6
    folder = bags[0].parent
    assert "CC0 1.0 Universal" in (folder / "LICENSE").read_text()
    assert "Althoff" in (folder / "README.md").read_text()
    for bag in bags:
        assert bag_origin(bag)["custom"]["licence"] == "CC0-1.0"
        read = read_signals(bag, ["/joint_states:velocity[*]", "/joint_states:effort[*]"])
        assert len(read) == 12
        assert set(np.diff(read["/joint_states:effort[0]"].stamp_ns).tolist()) == {4_000_000}


@pytest.mark.skipif(not ROBOT.is_dir(), reason="needs schunk_arm in ../shared/data")
def test_the_shipped_arm_has_the_published_numbers_bit_for_bit() -> None:
    for bag in schunk():
        source = ROBOT / bag_origin(bag)["custom"]["source_trial"]
        torque = np.loadtxt(source / "input.csv", delimiter=",")
        states = np.loadtxt(source / "trajectory.csv", delimiter=",")[:-1]
        for k in range(6):
            fields = ("position", "velocity", "effort")
            paths = [f"/joint_states:{field}[name=joint_{k + 1}]" for field in fields]
            read = read_signals(bag, paths)
            for path, column in zip(
                paths, (states[:, k], states[:, 6 + k], torque[:, k]), strict=True
            ):
                np.testing.assert_array_equal(read[path].values, column)
