"""The grid rule: own stamps, holds, gaps, clocks, delays, repeats; samples live."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import bags
from bags.signals.grid import to_trajectories
from bags.signals.reader import Samples, bag_digest, read_signals
from bags.signals.sampling import Sample, Sampler
from bags.signals.timing import clock_relation, delay, seconds
from nlsid import Dataset, Degrees, Grid, Polynomial, Trajectory, read_bags
from nlsid_core.data.repeats import same_excitation
from nlsid_core.errors import BagError, DataError, ShapeError
from nlsid_core.identification.polynomial.moments import repeated_moments, rows_without_bias
from nlsid_core.identification.repeats import compare_repeats
from tests.bag_messages import COMMAND, PERIOD_NS, SPEED, START_NS, speed_bag
from tests.repeated import CLASS, pair

MS = 1_000_000


def samples(stamps_ms: list[float], values: list[float], path: str = SPEED) -> Samples:
    stamp_ns = START_NS + np.rint(np.array(stamps_ms) * MS).astype(np.int64)
    return Samples(path, stamp_ns, np.array(values, dtype=np.float64))


def to_trajectory(
    y: list[Samples], u: list[Samples], *, name: str = "trial", **rules: Any
) -> Trajectory:
    [trajectory] = to_trajectories(y, u, Grid(**rules), name=name)
    return trajectory


TENTHS, LATE = [0, 10, 20, 24, 40, 50, 54, 70, 80, 90], (np.arange(100) * 10.9).tolist()
LINEAR, LAST = f"{SPEED}|linear(0.02 s)", f"{SPEED}|hold(0.02 s)"
UP = list(range(6))
# the response's path, its ms and values; the command's ms and values; rules; y, and u where it says
GIVEN: list[tuple[Any, ...]] = [
    # samples on the grid are used as they are
    (SPEED, [0, 10, 20, 30], [1, 2, 3, 4], [0, 10, 20], [5, 6, 7], {}, [1, 2, 3, 4], [5, 6, 7, 7]),
    # jitter leaves values alone; the sample at 19.6 ms was taken before the command of 20 ms
    (
        SPEED,
        [0, 10.4, 19.6, 30.2],
        [1, 2, 3, 4],
        [0, 10, 20, 30],
        [0, 1, 2, 3],
        {"period": 0.01},
        [1, 2, 3, 4],
        [0, 1, 1, 3],
    ),
    # the grid follows samples that drift, here by a period, as the monitor does
    (
        SPEED,
        np.cumsum([0.0, *[10.0, 12.0, 10.0] * 5]).tolist(),
        list(range(16)),
        [0],
        [0],
        {"period": 0.01, "max_gap": 1.0},
        list(range(16)),
        None,
    ),
    (
        LINEAR,
        TENTHS,
        TENTHS,
        [0],
        [0],
        {"period": 0.01, "max_gap": 0.1},
        list(range(0, 100, 10)),
        None,
    ),
    (
        LAST,
        TENTHS,
        TENTHS,
        [0],
        [0],
        {"period": 0.01, "max_gap": 0.1},
        [0, 10, 20, 24, 40, 50, 54, 70, 80, 90],
        None,
    ),
    (
        LINEAR,
        LATE,
        LATE,
        [0],
        [0],
        {"period": 0.02, "max_gap": 2.0},
        list(range(0, 1080, 20)),
        None,
    ),
    # a sample that is filled in has the command of its own time
    (
        SPEED,
        [0, 10, 20, 40, 50],
        [0, 1, 2, 4, 5],
        [0, 10, 20, 30, 40, 50],
        UP,
        {"max_gap": 0.025},
        UP,
        UP,
    ),
    (
        SPEED,
        [0, 10, 20, 30, 40],
        [0] * 5,
        [0, 10, 40],
        [0, 1, 2],
        {"max_gap": 0.03},
        [0] * 5,
        [0, 1, 1, 1, 2],
    ),
    # a command just after a response does not act on it; of two with one stamp the last counts
    (SPEED, [0, 10, 20], [0, 1, 2], [0, 10.001, 20], [5, 6, 7], {}, [0, 1, 2], [5, 5, 7]),
    (SPEED, [0, 10, 20], [0, 1, 2], [0, 10, 10, 20], [5, 6, 7, 8], {}, [0, 1, 2], [5, 7, 8]),
    (SPEED, [0, 20, 40], [0, 1, 2], [0, 20, 40], [0, 1, 2], {"period": 0.02}, [0, 1, 2], [0, 1, 2]),
]


@pytest.mark.parametrize("case", GIVEN)
def test_samples_are_what_the_rules_say(case: tuple[Any, ...]) -> None:
    path, at, values, when, told, rules, y, u = case
    found = to_trajectory([samples(at, values, path)], [samples(when, told, COMMAND)], **rules)
    np.testing.assert_allclose(found.y[:, 0], y, rtol=1e-12)
    assert u is None or found.u[:, 0].tolist() == u
    assert found.period == rules.get("period", found.period)
    assert (found.y_names, found.u_names, found.t[0]) == ((path,), (COMMAND,), 0.0)
    assert ('"filled":1' in found.provenance) is (u == UP)


GAP = r"trial: /odom.*a gap of 0\.02 s after sample 2 at 1700000000\.020000000 s; at most 0"
OTHER = r"sampled every 0\.0109 s, asked for was 0\.02 s; .*resample"
REFUSED: list[tuple[Any, ...]] = [
    (
        SPEED,
        TENTHS,
        [0],
        {"max_gap": 0.1},
        r"2 of 10 samples are up to 60 % of a period off a grid",
    ),
    (SPEED, LATE, [0], {"period": 0.02, "max_gap": 2.0}, OTHER),
    (LINEAR, LATE, [0], {"period": 0.005, "max_gap": 2.0}, "no rule makes more samples than there"),
    (SPEED, [0, 10, 20, 40, 50], [0, 10, 20, 30, 40, 50], {}, GAP),
    (
        SPEED,
        [0, 10, 20, 30, 40],
        [0, 10, 40],
        {},
        r"/cmd_vel.*nothing for 0\.02 s; at most 0\.015 s",
    ),
    (SPEED, [0, 10, 20], [100, 110], {}, "overlap in 0 samples"),
    (SPEED, [0, 10, 10, 20], [0], {}, r"messages 1 and 2 have the same stamp 1700000000\.01"),
    (SPEED, [0], [0], {}, "has 1 sample; a sample time needs two"),
    (SPEED, [0, 20, 40], [0, 20, 40], {"period": 0.025}, r"every 0\.02 s, asked for was"),
    (SPEED, [0, 20, 40], [0, 20, 40], {"period": 0.01}, r"every 0\.02 s, asked for was"),
]


@pytest.mark.parametrize(("path", "at", "when", "rules", "reason"), REFUSED)
def test_what_is_no_grid_is_refused(path: str, at: Any, when: Any, rules: Any, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        to_trajectory([samples(at, at, path)], [samples(when, when, COMMAND)], **rules)


def test_samples_without_a_command_are_left_out_and_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    y = samples([0, 10, 20, 30, 40, 50, 60, 70], [float(k) for k in range(8)])
    u = samples([15, 25, 35, 45], [1.0, 2.0, 3.0, 4.0], COMMAND)
    with caplog.at_level(logging.WARNING):
        trajectory = to_trajectory([y], [u], name="trial")
    assert [
        column.ravel().tolist() for column in (trajectory.y, trajectory.u, trajectory.t[:1])
    ] == [
        [2.0, 3.0, 4.0, 5.0, 6.0],
        [1.0, 2.0, 3.0, 4.0, 4.0],
        [0.0],
    ]
    assert "trial: 3 of 8 samples left out" in caplog.text


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
    dataset = read_bags(
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
        read_bags(bags, responses=[SPEED], excitations=[COMMAND])
    named = {bag.parent.name: bag for bag in bags}
    data = read_bags(named, responses=[SPEED], excitations=[COMMAND])
    assert data.names == ("mon", "tue")


def test_trials_of_different_sample_times_are_refused(tmp_path: Path) -> None:
    slow = [START_NS + 2 * k * PERIOD_NS for k in range(3)]
    bags = [
        speed_bag(tmp_path / "fast", [0.0, 0.1, 0.2], [0.0, 0.1, 0.2]),
        speed_bag(tmp_path / "slow", [0.0, 0.1, 0.2], [0.0, 0.1, 0.2], stamps_ns=slow),
    ]
    with pytest.raises(DataError, match=r"slow: sample time 0\.05 s, but fast has 0\.025 s"):
        read_bags(bags, responses=[SPEED], excitations=[COMMAND])
    with pytest.raises(DataError, match=r"slow: /odom.*is sampled every 0\.05 s"):
        read_bags(bags, responses=[SPEED], excitations=[COMMAND], grid=Grid(0.025))


@pytest.mark.parametrize(
    ("step", "n"), [(0.1, 100), (0.1, 391), (0.004, 936), (1 / 3, 7), (2e-10, 9)]
)
def test_the_period_of_whole_nanoseconds_is_that_number(step: float, n: int) -> None:
    trajectory = Trajectory(t=step * np.arange(n), y=np.zeros((n, 1)), u=np.zeros((n, 1)))
    assert trajectory.period == pytest.approx(step, rel=1e-12)
    if step in (0.1, 0.004):
        assert trajectory.period == step


# -- Clocks, gaps, delays, repeats


def stamps(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.rint(seconds * 1e9).astype(np.int64)


@pytest.mark.parametrize(
    ("offset", "ppm"), [(0.0, 0.0), (-514_944.0, 0.0), (3.0, 40.0), (0.0, -90.0)]
)
def test_offset_and_drift_between_clocks_are_found_under_latency(offset: float, ppm: float) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0, 600, 0.02)
    latency = 0.001 + rng.exponential(0.004, len(t))
    log_ns = stamps(t + latency)
    stamp_ns = stamps(t + offset + 1e-6 * ppm * t)
    found = clock_relation(stamp_ns, log_ns)
    assert found.offset == pytest.approx(offset - 0.001, abs=2e-3)
    assert 1e6 * found.drift == pytest.approx(ppm, abs=2.0)
    assert (found.drift == 0.0) == (ppm == 0.0)
    assert str(found).startswith("one clock") == (abs(offset) < 1.0 and ppm == 0.0)
    assert found.latency == pytest.approx(0.004 * np.log(2), abs=2e-3)


def test_simulated_time_is_told_by_its_pace() -> None:
    t = np.arange(0, 60, 0.02)
    found = clock_relation(np.rint(0.4e9 * t).astype(np.int64), stamps(t))
    assert found.drift == pytest.approx(-0.6)
    assert str(found) == "stamps run at 0.4 times the pace of log time: simulated time?"


@pytest.mark.parametrize("true", [0.0, 0.13, 0.42])
def test_the_delay_of_a_response_is_found(true: float) -> None:
    rng = np.random.default_rng(6)
    t = np.arange(0, 60, 0.01)
    u = np.repeat(rng.standard_normal(200), 30)
    y = np.interp(t - true, t, u) + 0.1 * rng.standard_normal(len(t))
    found = delay(u, y, 0.01, 2.0)
    assert found.seconds == pytest.approx(true, abs=0.01)
    assert found.correlation > 0.9
    assert delay(u, -y, 0.01, 2.0).correlation < -0.9
    with pytest.raises(DataError, match="a constant signal has no delay"):
        delay(u, np.ones(len(u)), 0.01, 2.0)


def test_repeats_are_told_from_steps_of_another_height() -> None:
    step = np.repeat([0.0, 1.0], 50)
    rng = np.random.default_rng(8)
    assert same_excitation(step, step + 0.01 * rng.standard_normal(100))
    assert not same_excitation(step, 1.2 * step)
    assert not same_excitation(step, step[:80])
    assert not same_excitation(np.ones(100), np.ones(100))


def test_stamps_that_go_back_are_sorted_on_request(tmp_path: Path) -> None:
    order = [0, 2, 1, 3]
    times = [START_NS + k * PERIOD_NS for k in order]
    bag = speed_bag(tmp_path / "x", map(float, order), [0.0] * 4, stamps_ns=times)
    with pytest.raises(BagError, match="time goes back"):
        read_signals(bag, [SPEED])
    assert read_signals(bag, [SPEED], sort=True)[SPEED].values.tolist() == [0, 1, 2, 3]


def test_a_bag_with_a_gap_gives_a_trajectory_per_stretch(tmp_path: Path) -> None:
    ticks = [*range(30), *range(50, 90)]
    times = [START_NS + k * PERIOD_NS for k in ticks]
    values = [float(k) for k in ticks]
    bag = speed_bag(tmp_path / "x", values, values, stamps_ns=times)
    options = {"responses": [SPEED], "excitations": [COMMAND]}
    with pytest.raises(DataError, match="a gap of"):
        bags.read([bag], **options)  # type: ignore[arg-type]
    found = bags.read([bag], grid=Grid(split_gaps=True), **options)  # type: ignore[arg-type]
    assert [(trial.name, len(trial)) for trial in found] == [("x.1", 30), ("x.2", 40)]
    np.testing.assert_array_equal(found.trajectories[1].y[:, 0], np.arange(50.0, 90.0))
    np.testing.assert_array_equal(found.trajectories[1].u[:, 0], np.arange(50.0, 90.0))


# -- Repeats that are repeats, and repeats that are not


def test_repeats_pass_and_what_is_not_a_repeat_is_named() -> None:
    first, second = pair(1500, 1)
    assert not compare_repeats(first, second)
    other = pair(1500, 2)[1]
    late = replace(second, y=np.roll(second.y, 1))
    stronger = replace(second, y=1.15 * second.y)
    for stranger, reason in (
        (other, "excitations differ"),
        (late, "correlates"),
        (stronger, "correlates"),
    ):
        assert reason in compare_repeats(first, stranger)
        data = Dataset((first, replace(stranger, group=first.group)))
        with pytest.raises(DataError, match="are not repeats"):
            rows_without_bias(data, CLASS)


def test_true_repeats_are_hardly_ever_refused() -> None:
    assert not any(compare_repeats(*pair(400, seed)) for seed in range(60))


def test_coloured_noise_and_excitation_do_not_look_like_a_false_repeat() -> None:
    refused = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        w, *noises = (lfilter([1.0], [1.0, -0.95], rng.standard_normal(1000)) for _ in range(3))
        t = 0.01 * np.arange(1000)
        runs = [Trajectory(t=t, y=w + noise, u=w, name=str(k)) for k, noise in enumerate(noises)]
        refused += compare_repeats(*runs) != ""
    assert refused <= 1


def test_unusable_repeats_say_what_is_wrong() -> None:
    first, second = pair(400, 1)
    alone = Dataset((replace(first, group=""), replace(second, group="")))
    with pytest.raises(DataError, match="share a `group`"):
        rows_without_bias(alone, CLASS)
    with pytest.raises(DataError, match="common samples"):
        compare_repeats(*pair(50, 1))
    short = pair(2, 1)
    with pytest.raises(DataError, match="needed"):
        repeated_moments([short], CLASS)
    two = [
        replace(t, y=np.hstack([t.y, -t.y]), y_names=(), y_units=(), y_paths=())
        for t in (first, second)
    ]
    with pytest.raises(ShapeError, match="one output"):
        rows_without_bias(Dataset(tuple(two)), CLASS)
    with pytest.raises(DataError, match="left is 2"):
        Polynomial(1, (0,), Degrees(left=2), set="3.8")


# -- Samples live: each as soon as it is certain, and nothing lost silently


def sampler() -> Sampler:
    """Of one response and one command, in ns."""
    return Sampler(["/y:data"], ["/u:data"], period=1e-8)


def sample(stamp_ns: int, y: float, u: float) -> Sample:
    return Sample(stamp_ns, (y,), (u,))


# a number of a signal (0 responds, 1 drives) with its stamp, or a stamp to which all is flushed;
# the samples that are certain then; late, late responses, duplicates and incomplete ones at the end
STORIES: list[tuple[list[tuple[Any, list[Sample]]], tuple[int, int, int, int]]] = [
    (  # a response waits for an excitation at or after its stamp
        [
            ((1, 5, 0.5), []),
            ((0, 10, 1.0), []),
            ((1, 9, 0.9), []),  # a command at 10 may still come
            ((1, 12, 1.2), [sample(10, 1.0, 0.9)]),
            ((0, 12, 2.0), [sample(12, 2.0, 1.2)]),
            ((0, 13, 3.0), []),
            (13, [sample(13, 3.0, 1.2)]),
        ],
        (0, 0, 0, 0),
    ),
    (  # before the first command there are no samples
        [
            ((0, 10, 1.0), []),
            ((0, 20, 2.0), []),
            (19, []),
            ((1, 20, 0.5), [sample(20, 2.0, 0.5)]),
        ],
        (0, 0, 0, 1),
    ),
    (  # those that wait are released in the order of their stamps
        [
            ((1, 5, 0.0), []),
            ((0, 30, 3.0), []),
            ((0, 10, 1.0), []),
            ((0, 20, 2.0), []),
            ((1, 30, 0.0), [sample(10, 1.0, 0.0), sample(20, 2.0, 0.0), sample(30, 3.0, 0.0)]),
        ],
        (0, 0, 0, 0),
    ),
    (  # what cannot be released is counted
        [
            ((0, 10, 1.0), []),
            ((0, 10, 1.5), []),
            ((1, 10, 0.0), [sample(10, 1.0, 0.0)]),
            ((0, 10, 1.0), []),
            ((0, 9, 0.9), []),
        ],
        (0, 1, 2, 0),
    ),
    (  # a command that comes too late still holds afterwards
        [
            ((1, 0, 0.0), []),
            ((0, 10, 1.0), []),
            (10, [sample(10, 1.0, 0.0)]),
            ((1, 8, 0.8), []),
            ((0, 11, 1.1), []),
            (11, [sample(11, 1.1, 0.8)]),
        ],
        (1, 0, 0, 0),
    ),
]


@pytest.mark.parametrize(("story", "counts"), STORIES)
def test_a_sample_is_given_as_soon_as_it_is_certain(
    story: list[tuple[Any, list[Sample]]], counts: tuple[int, int, int, int]
) -> None:
    pairing = sampler()
    for event, given_then in story:
        found = pairing.flush(event) if isinstance(event, int) else pairing.feed(*event)
        assert found == given_then
    assert counts == (
        pairing.late,
        pairing.late_responses,
        pairing.duplicate_responses,
        pairing.incomplete,
    )
