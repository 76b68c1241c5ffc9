"""The shipped recordings hold the published numbers; floors told apart by a proved tube."""

import tarfile
from pathlib import Path

import numpy as np
import pytest

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from bags.recordings.message_types import header_stamp_ns
from bags.samples import dart, dart_tables, f1tenth
from bags.signals.reader import bag_origin, read_signals
from nlsid import Status, check
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre

SOURCE = Path(__file__).parents[2].parent / "shared" / "data" / "f1tenth" / "F1tenthCar"
needs_source = pytest.mark.skipif(not SOURCE.is_dir(), reason="needs ../shared/data")

SIGNALS = {
    "/steering_command:position[0]": ("input", 0),
    "/cmd_vel:twist.linear.x": ("input", 1),
    "/odom:pose.pose.position.x": ("trajectory", 0),
    "/odom:pose.pose.position.y": ("trajectory", 1),
    "/odom:twist.twist.linear.x": ("trajectory", 3),
}


def test_41_trials_ship_in_order_and_are_small() -> None:
    bags = f1tenth()
    assert [bag.name for bag in bags] == [f"trial_{k:02d}" for k in range(1, 42)]
    size = sum(file.stat().st_size for bag in bags for file in bag.iterdir())
    assert size < 1.5e6


@needs_source
def test_every_shipped_number_is_the_published_one_bit_for_bit() -> None:
    for trial, bag in enumerate(f1tenth(), start=1):
        tables = {
            name: np.loadtxt(SOURCE / f"measurement_{trial}" / f"{name}.csv", delimiter=",")
            for name in ("input", "trajectory")
        }
        yaw = ["/odom:pose.pose.orientation.z", "/odom:pose.pose.orientation.w"]
        read = read_signals(bag, [*SIGNALS, *yaw])
        for path, (name, column) in SIGNALS.items():
            np.testing.assert_array_equal(read[path].values, tables[name][:, column])
        z, w = (read[path].values for path in yaw)
        np.testing.assert_allclose(2 * np.arctan2(z, w), tables["trajectory"][:, 2], atol=1e-15)


def test_stamps_are_25_ms_apart_and_commands_come_before_the_motion() -> None:
    starts = []
    for bag in f1tenth():
        with Bag(bag) as source:
            messages = list(source.messages())
        assert [m.topic for m in messages[:3]] == ["/cmd_vel", "/steering_command", "/odom"]
        start = messages[0].log_time_ns
        starts.append(start)
        for topic, count in {"/cmd_vel": 120, "/steering_command": 120, "/odom": 121}.items():
            of_topic = [m for m in messages if m.topic == topic]
            times = [m.log_time_ns for m in of_topic]
            assert times == [start + k * 25_000_000 for k in range(count)]
            assert [header_stamp_ns(m.data) for m in of_topic] == times
    assert min(np.diff(starts)) > 3 * 10**9


def test_repeats_excitation_source_and_licence_are_in_the_metadata() -> None:
    metadata = {int(bag.name[-2:]): bag_origin(bag)["custom"] for bag in f1tenth()}
    groups = {k: data["repeat_group"] for k, data in metadata.items() if "repeat_group" in data}
    expected: dict[int, str] = {}
    for first, speed in ((1, "0.4"), (12, "0.3"), (23, "0.35")):
        expected |= dict.fromkeys(range(first, first + 5), f"speed step 0 to {speed} m/s")
    assert groups == expected
    assert metadata[38]["excitation"] == (
        "speed [m/s] 0.35, 0.4 at 0.025 s, 0.35 at 1.025 s, 0.3 at 2.025 s; steering [rad] 0"
    )
    assert all(data["licence"] == "CC0-1.0" for data in metadata.values())
    assert all("Kochdumper" in data["source"] for data in metadata.values())


def test_licence_and_citation_ship_beside_the_bags() -> None:
    folder = f1tenth()[0].parent
    assert "CC0 1.0 Universal" in (folder / "LICENSE").read_text()
    assert "Kochdumper" in (folder / "README.md").read_text()


# -- The shipped DART drives: the published numbers, and floors told apart by a proved tube

DRIVES = Path(__file__).parents[2].parent / "shared" / "data" / "dart"
needs_drives = pytest.mark.skipif(not DRIVES.is_dir(), reason="needs ../shared/data")


def test_24_drives_ship_and_are_small() -> None:
    bags = dart()
    counts = {floor: len(dart(floor)) for floor in ("rubbery", "control", "tape", "slippery")}
    assert counts == {"rubbery": 14, "control": 5, "tape": 2, "slippery": 3}
    assert len(bags) == 24
    assert sum(file.stat().st_size for bag in bags for file in bag.iterdir()) < 1.4e6
    assert all(bag_origin(bag)["custom"]["licence"].startswith("MIT") for bag in bags)


@needs_drives
def test_the_shipped_commands_and_turns_are_those_of_the_published_table() -> None:
    file = "81_circles_tape_and_tiles/car_1_Datarecording_09_09_2024_17_58_23steer_neg03_ramp.csv"
    published = np.genfromtxt(DRIVES / file, delimiter=",", names=True, encoding="utf-8-sig")
    signals = ["/command:twist.angular.z", "/motion:twist.angular.z"]
    steering, rate = read_signals(dart("tape")[0], signals).values()
    t = published["vicon_time"] * 1e9
    rows = [int(np.argmin(np.abs(t - stamp))) for stamp in steering.stamp_ns.tolist()]
    np.testing.assert_allclose(steering.values, published["steering"][rows], atol=2.0**-10)
    turned = float(np.sum(rate.values) * 0.05)
    ends = [rate.stamp_ns[0] - 1e8, rate.stamp_ns[-1] - 1e8]
    start, end = np.interp(ends, t, np.unwrap(published["vicon_yaw"]))
    assert turned == pytest.approx(end - start, rel=0.01)


def test_the_shipped_tables_are_rows_of_the_published_ones(tmp_path: Path) -> None:
    assert dart_tables().stat().st_size < 1e6
    with tarfile.open(dart_tables()) as archive:
        archive.extractall(tmp_path, filter="data")
    root = tmp_path / "dart"
    assert "Copyright (c) 2024 Lorenzo Lyons" in (root / "LICENSE").read_text()
    tables = sorted(root.glob("*/*.csv"))
    assert len(tables) == 17
    if DRIVES.is_dir():
        published = {DRIVES / table.relative_to(root): table for table in tables}
        for original, table in published.items():
            rows = set(original.read_text(encoding="utf-8-sig").splitlines())
            starts = {",".join(row.split(",")[:7]) for row in rows}
            assert set(table.read_text().splitlines()) <= rows | starts


@pytest.mark.slow
def test_unseen_drives_stay_inside_and_other_floors_are_named(tmp_path: Path) -> None:
    """The whole way with a product of two topics' signals, one of them lagged, as an input."""
    config = load_config(config_file("dart.yaml"))
    fit = identify_bags(dart("rubbery"), config, tmp_path, progress=silent)
    assert fit.fit.errors["test"]["rse"] < 10.0  # %
    design_funnel_files(tmp_path / documents.MODEL, config, tmp_path)
    for name in (documents.MODEL_PROOF, documents.FUNNEL_PROOF):
        assert str(check(tmp_path / name)).startswith("PROVED")
    proved = documents.load(tmp_path / documents.FUNNEL)
    test = [bag for bag in dart("rubbery") if bag.name in config.split.test]
    said = {
        bag.name: replay_bag(proved, bag, centre=Centre.COMMAND)
        for bag in (*test, *dart("tape"), *dart("slippery"))
    }
    for name, replay in said.items():
        inside = replay.verdict == Status.INSIDE.value
        assert inside is name.startswith("rubbery"), (name, replay.reason)
