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
from bags.samples import dart, dart_tables
from bags.signals.reader import bag_origin, read_signals
from nlsid import Status, check
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre

SOURCE = Path(__file__).parents[2].parent / "shared" / "data" / "dart"
needs_source = pytest.mark.skipif(not SOURCE.is_dir(), reason="needs ../shared/data")


def test_24_drives_ship_and_are_small() -> None:
    bags = dart()
    counts = {floor: len(dart(floor)) for floor in ("rubbery", "control", "tape", "slippery")}
    assert counts == {"rubbery": 14, "control": 5, "tape": 2, "slippery": 3}
    assert len(bags) == 24
    assert sum(file.stat().st_size for bag in bags for file in bag.iterdir()) < 1.4e6
    assert all(bag_origin(bag)["custom"]["licence"].startswith("MIT") for bag in bags)


@needs_source
def test_the_shipped_commands_and_turns_are_those_of_the_published_table() -> None:
    file = "81_circles_tape_and_tiles/car_1_Datarecording_09_09_2024_17_58_23steer_neg03_ramp.csv"
    published = np.genfromtxt(SOURCE / file, delimiter=",", names=True, encoding="utf-8-sig")
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
    if SOURCE.is_dir():
        published = {SOURCE / table.relative_to(root): table for table in tables}
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
