"""`python -m benchmarks.robots`: a row for each robot, also for one that is not served."""

from pathlib import Path

import numpy as np
import pytest

from bags.signals.reader import read_signals
from benchmarks.robots import DART_ROLES, ROBOTS, Robot, measure, write_drive
from nlsid_core.arrays import FloatArray
from tests.conftest import SHARED


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
    folder = SHARED / "dart" / DART_ROLES["rubbery"][0]
    if not folder.is_dir():
        pytest.skip("needs dart in ../shared/data")
    file = sorted(folder.glob("*.csv"))[0]
    write_drive(file, tmp_path / "drive")
    paths = ["/odom:twist.angular.z", "/odom:twist.linear.x", "/command:twist.angular.z"]
    read = read_signals(tmp_path / "drive", paths)
    table = np.genfromtxt(file, delimiter=",", names=True)
    t = table["vicon_time"] - table["vicon_time"][0]
    kept = np.concatenate([[True], np.diff(t) > 0])
    t, yaw = t[kept], np.unwrap(table["vicon_yaw"][kept])
    x, y = table["vicon_x"][kept], table["vicon_y"][kept]
    at = (read[paths[0]].stamp_ns - 1_700_000_000 * 10**9) / 1e9

    def slope(values: FloatArray) -> FloatArray:
        ahead, behind = np.interp(at, t, values), np.interp(at - 0.2, t, values)
        found: FloatArray = (ahead - behind) / 0.2
        return found

    assert np.abs(read[paths[0]].values - slope(yaw)).mean() < 0.1
    assert np.abs(read[paths[1]].values - np.hypot(slope(x), slope(y))).mean() < 0.1
    assert np.ptp(read[paths[0]].values) > 1.0
    assert set(np.unique(read[paths[2]].values)) <= set(np.unique(table["steering"]))
