"""`python -m benchmarks.robots`: a row for each robot, also for one that is not served."""

from pathlib import Path

import numpy as np
import pytest

from bags.samples import convert_dart
from bags.signals.reader import read_signals
from benchmarks.robots import DART_KINDS, ROBOTS, Robot, dart_split, measure
from nlsid_core.arrays import FloatArray
from tests.conftest import SHARED


@pytest.mark.slow
def test_a_robot_that_is_served_has_every_figure(tmp_path: Path) -> None:
    speed = next(robot for robot in ROBOTS if robot.name == "F1TENTH speed")
    row = measure(speed, tmp_path, cache=tmp_path)
    assert "refused" not in row
    assert row["lines_of_yaml_edited"] == 0
    assert row["test_error"] < 9.0
    assert row["half_width_of_range"] < 0.5
    assert (row["false_alarms"], row["test_bags"]) == (0, 8)
    assert row["caught"] == row["broken"] == 16
    assert 0.0 < row["minutes"] < 15.0


def test_a_robot_whose_recordings_are_not_there_is_listed_with_the_reason(tmp_path: Path) -> None:
    row = measure(Robot("none", "nowhere", lambda _a, _b: []), tmp_path, cache=tmp_path)
    assert row["refused"] == "data: no folder nowhere"


def test_a_drive_turns_as_its_poses_say(tmp_path: Path) -> None:
    """Yaw rate and speed, delayed by half their window, against differences of the raw poses."""
    if not (SHARED / "dart").is_dir():
        pytest.skip("needs dart in ../shared/data")
    drive = next(convert_dart.drives(SHARED / "dart"))
    convert_dart.convert(drive, tmp_path / "drive")
    paths = ["/motion:twist.angular.z", "/motion:twist.linear.x", "/command:twist.angular.z"]
    read = read_signals(tmp_path / "drive", paths)
    table = drive.columns
    t, yaw = table["t"], np.unwrap(table["vicon yaw"])
    x, y = table["vicon x"], table["vicon y"]
    at = read[paths[0]].stamp_ns / 1e9

    def slope(values: FloatArray) -> FloatArray:
        ahead, behind = np.interp(at, t, values), np.interp(at - 0.2, t, values)
        found: FloatArray = (ahead - behind) / 0.2
        return found

    assert np.abs(read[paths[0]].values - slope(yaw)).mean() < 0.1
    assert np.abs(read[paths[1]].values - np.hypot(slope(x), slope(y))).mean() < 0.1
    assert np.ptp(read[paths[0]].values) > 1.0
    commanded = np.unique(table["steering"])
    nearest = commanded[np.searchsorted(commanded[:-1], read[paths[2]].values - convert_dart.STEP)]
    assert np.abs(nearest - read[paths[2]].values).max() <= convert_dart.STEP


def test_every_kind_of_drive_is_dealt_to_training_calibration_and_test() -> None:
    bags = [Path(f"rubbery_{day}_{k:06d}") for day in DART_KINDS for k in range(4)]
    split = dart_split(bags, 3)
    assert split == dart_split(bags, 3)
    assert split != dart_split(bags, 4)
    assert not set(split["test"]) & set(split["calibration"])
    for days in (("20240909",), ("20240904", "20240927"), ("20240916",)):
        for use in split.values():
            assert any(name.split("_")[1] in days for name in use)
