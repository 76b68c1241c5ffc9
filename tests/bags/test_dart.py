"""The shipped DART drives: the published numbers, and floors told apart by a proved tube."""

import tarfile
from pathlib import Path

import numpy as np
import pytest

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.monitoring.replay import replay_bag
from bags.samples import convert_dart, dart, dart_tables
from bags.signals.reader import bag_metadata, read_signals
from nlsid_core.errors import DataError
from nlsid_core.progress import silent
from nlsid_core.proofs import check
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status

SOURCE = Path(__file__).parents[2].parent / "shared" / "data" / "dart"
needs_source = pytest.mark.skipif(not SOURCE.is_dir(), reason="needs ../shared/data")


def test_24_drives_ship_and_are_small() -> None:
    bags = dart()
    counts = {floor: len(dart(floor)) for floor in ("rubbery", "control", "tape", "slippery")}
    assert counts == {"rubbery": 14, "control": 5, "tape": 2, "slippery": 3}
    assert len(bags) == 24
    assert sum(file.stat().st_size for bag in bags for file in bag.iterdir()) < 1.4e6
    assert all(bag_metadata(bag)["licence"].startswith("MIT") for bag in bags)


@needs_source
def test_the_shipped_bags_are_what_the_published_tables_convert_to(tmp_path: Path) -> None:
    found = {drive.name: drive for drive in convert_dart.drives(SOURCE)}
    name = "tape_20240909_155823"
    assert convert_dart.convert(found[name], tmp_path / name)
    shipped = next(bag for bag in dart("tape") if bag.name == name)
    signals = [
        f"/{topic}:twist.{part}"
        for topic in ("command", "motion")
        for part in ("linear.x", "angular.z")
    ]
    before, after = (read_signals(bag, signals) for bag in (shipped, tmp_path / name))
    for signal in signals:
        assert before[signal].values.tolist() == after[signal].values.tolist()
        assert before[signal].stamp_ns.tolist() == after[signal].stamp_ns.tolist()
    columns = found[name].columns
    steering = before["/command:twist.angular.z"]
    t = columns["t"] * 1e9
    rows = [int(np.argmin(np.abs(t - stamp))) for stamp in steering.stamp_ns.tolist()]
    np.testing.assert_allclose(steering.values, columns["steering"][rows], atol=convert_dart.STEP)
    yaw = np.unwrap(columns["vicon yaw"])
    rate = before["/motion:twist.angular.z"]
    turned = float(np.sum(rate.values) * 0.05)
    ends = np.interp([rate.stamp_ns[0] - 1e8, rate.stamp_ns[-1] - 1e8], t, yaw)
    assert turned == pytest.approx(ends[1] - ends[0], rel=0.01)
    long = next(drive for drive in found.values() if drive.name == "rubbery_20240909_123056")
    assert not convert_dart.convert(long, tmp_path / "long", longest=90.0)
    assert not (tmp_path / "long").exists()


def test_the_shipped_tables_are_rows_of_the_published_ones(tmp_path: Path) -> None:
    assert dart_tables().stat().st_size < 1e6
    with tarfile.open(dart_tables()) as archive:
        archive.extractall(tmp_path, filter="data")
    root = tmp_path / "dart"
    assert "Copyright (c) 2024 Lorenzo Lyons" in (root / "LICENSE").read_text()
    tables = sorted(root.glob("*/*.csv"))
    assert len(tables) == 17
    for table in tables:
        assert np.all(np.diff(convert_dart.read(table)["t"]) > 0)
    if SOURCE.is_dir():
        published = {SOURCE / table.relative_to(root): table for table in tables}
        for original, table in published.items():
            rows = set(original.read_text(encoding="utf-8-sig").splitlines())
            starts = {",".join(row.split(",")[:7]) for row in rows}
            assert set(table.read_text().splitlines()) <= rows | starts


def test_without_the_tables_nothing_is_converted(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"81_throttle_ramps: no \.csv files"):
        list(convert_dart.drives(tmp_path))
    bad = tmp_path / "bad.csv"
    bad.write_text("vicon x,vicon y\n1,2\n3,4\n")
    with pytest.raises(DataError, match="vicon time"):
        convert_dart.read(bad)


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
