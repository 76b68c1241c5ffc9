"""The grid rule: own stamps, zero-order hold, refusal of gaps; datasets of several bags."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.signals.grid import read_dataset, seconds, to_trajectories
from bags.signals.reader import Samples, bag_digest
from bags.signals.sampling import Grid
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError
from tests.bag_messages import COMMAND, PERIOD_NS, SPEED, START_NS, speed_bag

MS = 1_000_000


def samples(stamps_ms: list[float], values: list[float], path: str = SPEED) -> Samples:
    stamp_ns = START_NS + np.rint(np.array(stamps_ms) * MS).astype(np.int64)
    return Samples(path, stamp_ns, np.array(values, dtype=np.float64))


def to_trajectory(
    y: list[Samples], u: list[Samples], *, name: str = "trial", **rules: Any
) -> Trajectory:
    [trajectory] = to_trajectories(y, u, Grid(**rules), name=name)
    return trajectory


def test_samples_on_the_grid_are_used_as_they_are() -> None:
    y = samples([0, 10, 20, 30], [1.0, 2.0, 3.0, 4.0])
    u = samples([0, 10, 20], [5.0, 6.0, 7.0], COMMAND)
    trajectory = to_trajectory([y], [u], name="run")
    assert trajectory.t.tolist() == [0.0, 0.01, 0.02, 0.03]
    assert trajectory.y[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert trajectory.u[:, 0].tolist() == [5.0, 6.0, 7.0, 7.0]
    assert (trajectory.y_names, trajectory.u_names) == ((SPEED,), (COMMAND,))
    assert trajectory.name == "run"


def test_jitter_within_the_tolerance_leaves_the_values_alone() -> None:
    y = samples([0, 10.4, 19.6, 30.2], [1.0, 2.0, 3.0, 4.0])
    u = samples([0, 10, 20, 30], [0.0, 1.0, 2.0, 3.0], COMMAND)
    trajectory = to_trajectory([y], [u], period=0.01)
    assert trajectory.t.tolist() == [0.0, 0.01, 0.02, 0.03]
    assert trajectory.y[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    # the sample at 19.6 ms was taken before the command of 20 ms
    assert trajectory.u[:, 0].tolist() == [0.0, 1.0, 1.0, 3.0]


def test_the_grid_follows_samples_that_drift_as_the_monitor_does() -> None:
    stamps = np.cumsum([0.0, *[10.0, 12.0, 10.0] * 5])  # one whole period late at the end
    values = np.arange(16.0).tolist()
    u = samples([0], [0.0], COMMAND)
    trajectory = to_trajectory([samples(stamps.tolist(), values)], [u], period=0.01, max_gap=1.0)
    assert trajectory.y[:, 0].tolist() == values
    assert trajectory.period == 0.01


def test_stamps_between_the_points_of_the_grid_are_refused_with_the_key_to_set() -> None:
    stamps = [0.0, 10, 20, 24, 40, 50, 54, 70, 80, 90]
    y = samples(stamps, stamps)
    u = samples([0], [0.0], COMMAND)
    with pytest.raises(DataError, match=r"2 of 10 samples are up to 60 % of a period off a grid"):
        to_trajectory([y], [u], max_gap=0.1)
    linear = replace(y, path=f"{SPEED}|linear(0.02 s)")
    found = to_trajectory([linear], [u], period=0.01, max_gap=0.1)
    np.testing.assert_allclose(found.y[:, 0], np.arange(10) * 10.0, rtol=1e-15)
    last = replace(y, path=f"{SPEED}|hold(0.02 s)")
    found = to_trajectory([last], [u], period=0.01, max_gap=0.1)
    assert found.y[:, 0].tolist() == [0.0, 10.0, 20.0, 24.0, 40.0, 50.0, 54.0, 70.0, 80.0, 90.0]


def test_another_rate_is_resampled_only_by_a_stated_rule_and_never_upwards() -> None:
    stamps = (np.arange(100) * 10.9).tolist()
    y = samples(stamps, [3.0 * stamp for stamp in stamps])
    u = samples([0], [0.0], COMMAND)
    with pytest.raises(
        DataError, match=r"sampled every 0\.0109 s, asked for was 0\.02 s; .*resample"
    ):
        to_trajectory([y], [u], period=0.02, max_gap=2.0)
    linear = replace(y, path=f"{SPEED}|linear(0.02 s)")
    found = to_trajectory([linear], [u], period=0.02, max_gap=2.0)
    assert found.period == 0.02
    np.testing.assert_allclose(found.y[:, 0], 60.0 * np.arange(len(found)), rtol=1e-12)
    with pytest.raises(DataError, match="no rule makes more samples than there are"):
        to_trajectory([linear], [u], period=0.005, max_gap=2.0)


def test_a_filled_sample_has_the_command_of_its_own_time() -> None:
    y = samples([0, 10, 20, 40, 50], [0.0, 1.0, 2.0, 4.0, 5.0])
    u = samples([0, 10, 20, 30, 40, 50], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], COMMAND)
    trajectory = to_trajectory([y], [u], max_gap=0.025)
    assert trajectory.y[:, 0].tolist() == trajectory.u[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert '"filled":1' in trajectory.provenance


def test_a_missing_sample_is_refused_unless_the_gap_was_allowed() -> None:
    y = samples([0, 10, 20, 40, 50], [0.0, 1.0, 2.0, 4.0, 5.0])
    u = samples([0, 10, 20, 30, 40, 50], [0.0] * 6, COMMAND)
    message = r"trial: /odom.*a gap of 0\.02 s after sample 2 at 1700000000\.020000000 s; at most 0"
    with pytest.raises(DataError, match=message):
        to_trajectory([y], [u], name="trial")
    trajectory = to_trajectory([y], [u], max_gap=0.025)
    np.testing.assert_allclose(trajectory.y[:, 0], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], rtol=1e-15)


def test_a_command_held_for_longer_than_the_gap_is_refused() -> None:
    y = samples([0, 10, 20, 30, 40], [0.0] * 5)
    u = samples([0, 10, 40], [0.0, 1.0, 2.0], COMMAND)
    with pytest.raises(DataError, match=r"/cmd_vel.*nothing for 0\.02 s; at most 0\.015 s"):
        to_trajectory([y], [u])
    held = to_trajectory([y], [u], max_gap=0.03)
    assert held.u[:, 0].tolist() == [0.0, 1.0, 1.0, 1.0, 2.0]


def test_a_command_stamped_just_after_a_response_does_not_act_on_it() -> None:
    y = samples([0, 10, 20], [0.0, 1.0, 2.0])
    u = samples([0, 10.001, 20], [5.0, 6.0, 7.0], COMMAND)
    assert to_trajectory([y], [u]).u[:, 0].tolist() == [5.0, 5.0, 7.0]


def test_the_last_of_two_commands_with_one_stamp_counts() -> None:
    y = samples([0, 10, 20], [0.0, 1.0, 2.0])
    u = samples([0, 10, 10, 20], [5.0, 6.0, 7.0, 8.0], COMMAND)
    assert to_trajectory([y], [u]).u[:, 0].tolist() == [5.0, 7.0, 8.0]


def test_samples_without_a_command_are_left_out_and_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    y = samples([0, 10, 20, 30, 40, 50, 60, 70], [float(k) for k in range(8)])
    u = samples([15, 25, 35, 45], [1.0, 2.0, 3.0, 4.0], COMMAND)
    with caplog.at_level(logging.WARNING):
        trajectory = to_trajectory([y], [u], name="trial")
    assert trajectory.y[:, 0].tolist() == [2.0, 3.0, 4.0, 5.0, 6.0]
    assert trajectory.u[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0, 4.0]
    assert trajectory.t[0] == 0.0
    assert "trial: 3 of 8 samples left out" in caplog.text


def test_signals_that_do_not_overlap_are_refused() -> None:
    y = samples([0, 10, 20], [0.0, 1.0, 2.0])
    u = samples([100, 110], [1.0, 2.0], COMMAND)
    with pytest.raises(DataError, match="overlap in 0 samples"):
        to_trajectory([y], [u])


def test_repeated_stamps_and_single_samples_are_refused() -> None:
    u = samples([0, 10, 20], [0.0, 1.0, 2.0], COMMAND)
    with pytest.raises(DataError, match=r"messages 1 and 2 have the same stamp 1700000000\.01"):
        to_trajectory([samples([0, 10, 10, 20], [0.0, 1.0, 1.0, 2.0])], [u])
    with pytest.raises(DataError, match="has 1 sample; a sample time needs two"):
        to_trajectory([samples([0], [0.0])], [u])
    with pytest.raises(DataError, match="at least one response and one excitation"):
        to_trajectory([], [u])


def test_another_period_than_asked_for_is_refused() -> None:
    y = samples([0, 20, 40], [0.0, 1.0, 2.0])
    u = samples([0, 20, 40], [0.0, 1.0, 2.0], COMMAND)
    for period in (0.025, 0.01):
        with pytest.raises(DataError, match=r"is sampled every 0\.02 s, asked for was"):
            to_trajectory([y], [u], period=period)
    assert to_trajectory([y], [u], period=0.02).period == 0.02


def test_responses_on_two_topics_are_paired_by_equal_stamps_or_resampled() -> None:
    first = samples([0, 10, 20, 30], [0.0, 1.0, 2.0, 3.0])
    second = samples([0, 10.2, 19.8, 30], [5.0, 6.0, 7.0, 8.0], "/imu:x")
    u = samples([0, 10, 20, 30], [0.0] * 4, COMMAND)
    trajectory = to_trajectory([first, second], [u])
    assert trajectory.y.T.tolist() == [[0.0, 1.0, 2.0, 3.0], [5.0, 6.0, 7.0, 8.0]]
    apart = samples([-5, 5, 15, 25, 35], [-0.5, 0.5, 1.5, 2.5, 3.5], "/imu:x")
    with pytest.raises(DataError, match="responses on several topics need one stamp each"):
        to_trajectory([first, apart], [u])
    lines = [replace(s, path=f"{s.path}|linear(0.02 s)") for s in (first, apart)]
    trajectory = to_trajectory(lines, [u], period=0.01, max_gap=0.02)
    np.testing.assert_allclose(trajectory.y[:, 1], trajectory.y[:, 0], atol=1e-15)


def test_commands_have_a_limit_of_their_own() -> None:
    """A teleoperator pauses for half a second: more than a response may be missing."""
    y = samples([10.0 * k for k in range(100)], np.arange(100.0).tolist())
    u = samples([0, 10, 20, 520, 530], [0.0, 1.0, 2.0, 3.0, 4.0], f"{COMMAND}|hold(0.5 s)")
    trajectory = to_trajectory([y], [u])
    assert len(trajectory) == 100
    assert trajectory.u[2:52, 0].tolist() == [2.0] * 50
    with pytest.raises(DataError, match=r"nothing for 0\.41 s; at most 0\.4 s is held"):
        to_trajectory([y], [replace(u, path=f"{COMMAND}|hold(0.4 s)")])
    apart = Grid(split_gaps=True)
    parts = to_trajectories([y], [replace(u, path=f"{COMMAND}|hold(0.4 s)")], apart)
    assert [len(part) for part in parts] == [43, 42]


def test_equal_stamps_give_equal_seconds_however_late_the_clock() -> None:
    late = 4_000_000_000 * 10**9
    assert seconds(late + 75 * MS, late) == seconds(75 * MS, 0) == 0.075
    assert seconds(np.array([late + 75 * MS]), late)[0] == 0.075


def test_a_dataset_carries_names_groups_digests_and_reports_progress(tmp_path: Path) -> None:
    bags = [
        speed_bag(tmp_path / f"trial_{k}", [0.0, 0.1], [0.0, 0.1], custom={"repeat_group": "step"})
        for k in range(2)
    ]
    bags.append(speed_bag(tmp_path / "single", [0.0, 0.1], [0.0, 0.1]))
    seen: list[tuple[str, float]] = []
    dataset = read_dataset(
        [bags[0], bags[1] / "trial_1.mcap", bags[2]],
        responses=[SPEED],
        excitations=[COMMAND],
        progress=lambda what, fraction: seen.append((what, fraction)),
    )
    assert dataset.names == ("trial_0", "trial_1", "single")
    assert [t.name for t in dataset.repeats()["step"]] == ["trial_0", "trial_1"]
    assert [t.digest for t in dataset] == [bag_digest(bag) for bag in bags]
    assert dataset.period == 0.025
    assert seen == [("reading bags", k / 3) for k in (1, 2, 3)]


def test_two_bags_of_one_name_are_refused(tmp_path: Path) -> None:
    bags = [speed_bag(tmp_path / day / "trial", [0.0, 0.1], [0.0, 0.1]) for day in ("mon", "tue")]
    with pytest.raises(DataError, match="two bags are called 'trial'"):
        read_dataset(bags, responses=[SPEED], excitations=[COMMAND])
    named = {bag.parent.name: bag for bag in bags}
    data = read_dataset(named, responses=[SPEED], excitations=[COMMAND])
    assert data.names == ("mon", "tue")


def test_trials_of_different_sample_times_are_refused(tmp_path: Path) -> None:
    slow = [START_NS + 2 * k * PERIOD_NS for k in range(3)]
    bags = [
        speed_bag(tmp_path / "fast", [0.0, 0.1, 0.2], [0.0, 0.1, 0.2]),
        speed_bag(tmp_path / "slow", [0.0, 0.1, 0.2], [0.0, 0.1, 0.2], stamps_ns=slow),
    ]
    with pytest.raises(DataError, match=r"slow: sample time 0\.05 s, but fast has 0\.025 s"):
        read_dataset(bags, responses=[SPEED], excitations=[COMMAND])
    with pytest.raises(DataError, match=r"slow: /odom.*is sampled every 0\.05 s"):
        read_dataset(bags, responses=[SPEED], excitations=[COMMAND], grid=Grid(0.025))


@pytest.mark.parametrize(
    ("step", "n"), [(0.1, 100), (0.1, 391), (0.004, 936), (1 / 3, 7), (2e-10, 9)]
)
def test_the_period_of_whole_nanoseconds_is_that_number(step: float, n: int) -> None:
    trajectory = Trajectory(step * np.arange(n), np.zeros((n, 1)), np.zeros((n, 1)))
    assert trajectory.period == pytest.approx(step, rel=1e-12)
    if step in (0.1, 0.004):
        assert trajectory.period == step
