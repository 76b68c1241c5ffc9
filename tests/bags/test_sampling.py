"""What a sample is: by brute force, in any order of arrival, from messages as from arrays."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bags.monitoring.replay import Replay, replay_messages
from bags.recordings.bag import Bag
from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from bags.signals.expressions import Expression
from bags.signals.grid import filled_samples
from bags.signals.reader import read_signals
from bags.signals.sampling import LOST, MOST_LOST, Sample, Sampler
from bags.tools.listing import bag_signals
from nlsid import Design, Grid, OutputTube, Polynomial, Status, identify, read_bags
from nlsid_core.design import design_output_tube
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError
from nlsid_core.running.comparison import Centre
from tests.bag_messages import (
    CMD,
    COMMAND,
    ODOM,
    ODOM_TYPE,
    SPEED,
    START_NS,
    TRANSFORMS,
    command,
    odometry,
    put,
    serialised,
    speed_bag,
    transforms,
    twist,
)

MS = 1_000_000
Y, Z, U = "/y:data", "/z:data", "/u:data"

Series = list[tuple[int, float]]


def series(rng: np.random.Generator, period: float, count: int) -> Series:
    """Jittered stamps in ns, with a gap now and then, and values that tell samples apart."""
    steps = rng.uniform(0.7, 1.3, count) * np.where(rng.random(count) < 0.05, 5.0, 1.0)
    stamps = np.cumsum(np.rint(steps * period * 1e9)).astype(np.int64) + rng.integers(10 * MS)
    return list(zip(stamps.tolist(), rng.standard_normal(count).tolist(), strict=True))


def brute(signal: str, values: Series, at: int) -> float:
    """The value of a signal in a sample at `at`, from the words of the rule."""
    rule = Expression.parse(signal).operation("hold", "linear")
    before = [(stamp, value) for stamp, value in values if stamp <= at]
    after = [(stamp, value) for stamp, value in values if stamp > at]
    if not before:
        return math.nan
    if rule is None or rule.name == "hold":
        limit = math.inf if rule is None else round(rule.window * 1e9)
        return before[-1][1] if at - before[-1][0] <= limit else math.nan
    (t0, v0) = before[-1]
    if t0 == at:
        return v0
    if not after or after[0][0] - t0 > round(rule.window * 1e9):
        return math.nan
    return v0 + (after[0][1] - v0) * ((at - t0) / (after[0][0] - t0))


def is_bridged(values: Series, at: int, period_ns: int) -> bool:
    """Whether `at` is on no message, and those around it are more than 1.5 periods apart."""
    before = [stamp for stamp, _ in values if stamp <= at]
    after = [stamp for stamp, _ in values if stamp > at]
    return before[-1] != at and 2 * (after[0] - before[-1]) > 3 * period_ns


def fed(sampler: Sampler, events: Sequence[tuple[int, int, float]]) -> list[Sample]:
    given = [sample for k, stamp, value in events for sample in sampler.feed(k, stamp, value)]
    return came(given + sampler.flush())


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("together", [5, 64])
def test_numbers_taken_together_give_the_samples_of_numbers_taken_one_by_one(
    seed: int, together: int
) -> None:
    """Recordings are read so: messages lost, stamps that repeat, NaN and lags in them."""
    rng, other = np.random.default_rng(seed), "/imu:angular_velocity.z"
    driving = [f"{U}|hold(0.12 s)", f"{U}|lag(0.1 s)"]
    one, many = (Sampler([Y, other], driving, period=0.05) for _ in range(2))
    events = []
    for k, (every, scatter) in enumerate([(50, 2), (50, 1), (70, 30), (40, 20)]):
        stamps = every * np.arange(200) + rng.integers(-scatter, scatter + 1, 200)
        kept = rng.random(200) > (0.0, 0.1, 0.2, 0.2)[k]
        values = np.where(rng.random(200) < 0.02, np.nan, rng.standard_normal(200))
        pairs = zip(stamps[kept].tolist(), values[kept].tolist(), strict=True)
        events += [(t * MS, -k, value) for t, value in pairs]
    given: list[Sample] = []
    alone: list[Sample] = []
    for count, (at, k, value) in enumerate(sorted(events, key=lambda e: e[:2]), start=1):
        alone += one.feed(-k, at, value)
        if count % together:
            many.add(-k, at, value)
        else:
            given += many.feed(-k, at, value)
    given += many.flush()
    assert repr(given) == repr(alone + one.flush())
    assert len(given) > 150
    assert sum(not sample.missing for sample in given) > 50
    for count_of in ("incomplete", "late", "late_responses", "duplicate_responses"):
        assert getattr(many, count_of) == getattr(one, count_of)


def came(samples: Sequence[Sample]) -> list[Sample]:
    """Those of which a message came."""
    return [sample for sample in samples if sample.missing != LOST]


def interleaved(
    rng: np.random.Generator, columns: Sequence[Series]
) -> list[tuple[int, int, float]]:
    """Every signal in its order, the signals in any order among each other."""
    which = rng.permutation([k for k, column in enumerate(columns) for _ in column])
    left = [iter(column) for column in columns]
    return [(int(k), *next(left[k])) for k in which]


@pytest.mark.parametrize("seconds", [60, 1_700_000_000])
def test_over_a_clock_that_was_set_the_grid_goes_on_at_the_next_message(seconds: int) -> None:
    """However long nothing came, one or two samples say so."""
    sampler = Sampler([f"{Y}|linear(0.2 s)"], [f"{U}|hold(1 s)"], period=0.05)
    first = [50 * MS * k for k in range(100)]
    later = [stamp + seconds * 1000 * MS + 20 * MS for stamp in first]
    samples = fed(sampler, [(k, at, 1.0) for at in first + later for k in (1, 0)])
    assert len(samples) < 205
    assert {s.stamp_ns % (50 * MS) for s in samples} == {0}
    known = [s.stamp_ns for s in samples if not s.missing]
    assert [at for at in known if at <= first[-1]] == first
    assert [at for at in known if at > first[-1]] == [
        at for at in range(later[0] // (50 * MS) * 50 * MS, later[-1], 50 * MS) if at >= later[0]
    ]
    assert sum(bool(s.missing) for s in samples) in (1, 2)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["none", "hold", "linear"]))
def test_samples_are_what_the_rule_says_in_any_order_of_arrival(seed: int, rule: str) -> None:
    rng = np.random.default_rng(seed)
    end = "" if rule == "none" else f"|{rule}(0.03 s)"
    signals = ([Y + end] if rule == "none" else [Y + end, Z + end], [f"{U}|hold(0.03 s)"])
    columns = [series(rng, 0.01, 60) for _ in range(sum(map(len, signals)))]
    sampler = Sampler(*signals, period=0.01)
    given = fed(sampler, interleaved(rng, columns))
    texts = [*signals[0], *signals[1]]
    if rule == "none":
        times = [stamp for stamp, _ in columns[0]]
    else:
        first = max(column[0][0] for column in columns)
        times = list(range(first, min(c[-1][0] for c in columns[:-1]) + 1, 10 * MS))
    truth = [
        (at, [brute(text, c, at) for text, c in zip(texts, columns, strict=True)]) for at in times
    ]
    while truth and not np.isfinite(truth[0][1]).all():
        del truth[0]
    assert [sample.stamp_ns for sample in given] == [at for at, _ in truth]
    for sample, (_, values) in zip(given, truth, strict=True):
        assert np.array_equal([*sample.y, *sample.u], values, equal_nan=True)
        assert bool(sample.missing) is not bool(np.isfinite(values).all())
        known = rule != "none" and not sample.missing
        bridged = [known and is_bridged(c, sample.stamp_ns, 10 * MS) for c in columns[:-1]]
        assert bool(sample.filled) is any(bridged)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_operations_give_the_same_bits_one_by_one_as_all_at_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.array([stamp for stamp, _ in series(rng, 0.01, 300)])
    angles = np.angle(np.exp(1j * np.cumsum(rng.uniform(-1, 1, 300))))
    for text in (
        "",
        "|to(deg)",
        "|unwrap",
        "|unit(deg)|unwrap",
        "|unwrap|derivative(0.1 s)",
        "|derivative(0.07 s)|to(rpm)",
        "|unwrap|washout(0.3 s)|to(deg)",
    ):
        expression = Expression.parse(f"/odom:a.yaw{text}")
        whole = expression.apply(angles, stamps, "rad")
        running = expression.running("rad")
        single = [
            running.update(stamp, value)
            for stamp, value in zip(stamps.tolist(), angles.tolist(), strict=True)
        ]
        assert np.array_equal(whole, single, equal_nan=True)


def test_an_unwrapped_angle_is_the_angle_without_jumps() -> None:
    truth = np.linspace(0.0, -40.0, 500)
    wrapped = np.where(np.arange(500) % 7 > 3, np.nan, np.angle(np.exp(1j * truth)))
    found = Expression.parse("/odom:a.yaw|unwrap").apply(wrapped, np.arange(500), "rad")
    np.testing.assert_allclose(found, truth + 0.0 * wrapped, atol=1e-12)  # over what is missing too
    compass = np.rad2deg(truth) % 360.0 + np.where(np.arange(500) == 0, 359.9, 0.0)
    found = Expression.parse("/boat:heading|unit(deg)|unwrap").apply(compass, np.arange(500), "")
    np.testing.assert_allclose(found[0], -0.1, atol=1e-9)
    np.testing.assert_allclose(found[1:], np.rad2deg(truth)[1:], atol=1e-9)


def drive(path: Path, *, stamped: bool = True, count: int = 200) -> Path:
    """A turning robot: pose on /odom, a command on /cmd_vel from the 10th message on."""
    rng = np.random.default_rng(5)
    types = standard_types()
    plain = "geometry_msgs/msg/Twist"
    with BagWriter(path) as bag:
        for k in range(count):
            stamp = START_NS + k * 25 * MS + int(rng.integers(0, 3 * MS))
            log = stamp + int(rng.integers(1 * MS, 4 * MS))
            message: Any = types.deserialize_cdr(odometry(stamp, 0.1 * k), ODOM_TYPE)
            half = 0.5 * 4.0 * k * 0.025
            message.pose.pose.orientation.z = math.sin(half)
            message.pose.pose.orientation.w = math.cos(half)
            data = serialised(ODOM_TYPE, message)
            bag.write(ODOM, ODOM_TYPE, data, log_time_ns=log, publish_time_ns=stamp)
            if k < 10:
                continue
            kind = "geometry_msgs/msg/TwistStamped" if stamped else plain
            value = float(rng.standard_normal())
            data = command(stamp - MS, value) if stamped else serialised(plain, twist(value))
            bag.write(CMD, kind, data, log_time_ns=log - MS, publish_time_ns=stamp)
    return path


@pytest.mark.parametrize("resample", ["none", "last", "linear"])
@pytest.mark.parametrize("clock", ["header", "log"])
@pytest.mark.parametrize("turn", ["", "|unwrap|derivative(0.2 s)"])
def test_messages_give_the_same_bits_as_identification_reads(
    tmp_path: Path, resample: str, clock: str, turn: str
) -> None:
    bag = drive(tmp_path / "drive")
    yaw = f"{ODOM}:pose.pose.orientation.yaw{turn or '|unwrap'}"
    [trial] = read_bags(
        [bag],
        responses=[yaw, SPEED],
        excitations=[COMMAND],
        grid=Grid(0.05 if resample != "none" else 0.025, 0.1, clock, resample, hold=0.2),
    )
    given = replayed(bag, Sampler(trial.y_paths, trial.u_paths, period=trial.period))
    assert trial.y.tolist() == [list(sample.y) for sample in given]
    assert trial.u.tolist() == [list(sample.u) for sample in given]
    assert len(given) > 80
    if turn:
        assert np.abs(trial.y[:, 0] - 4.0).max() < 0.5  # rad/s, by stamps with 3 ms of jitter


def driven(values: Series, at: int, *, lag_ns: float, limit_ns: int) -> float:
    """A held, lagged command at `at`, step by step from the first value on."""
    came = [(stamp, value) for stamp, value in values if stamp <= at]
    if not came or at - came[-1][0] > limit_ns:
        return math.nan
    if not lag_ns:
        return came[-1][1]
    x = came[0][1]
    ends = [*(stamp for stamp, _ in came[1:]), at]
    for (stamp, value), end in zip(came, ends, strict=True):
        x = value + (x - value) * math.exp(-(end - stamp) / lag_ns)
    return x


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_products_of_lagged_signals_are_what_the_words_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = [series(rng, 0.01, 60) for _ in range(3)]
    drives = [f"{U}|lag(0.1 s)|hold(0.03 s)", f"{Z}|hold(0.02 s)"]
    sampler = Sampler([Y], [f"{drives[0]} * {drives[1]}", drives[1]], period=0.01)
    assert sampler.topics == ("/y", "/u", "/z")
    events = interleaved(rng, columns)
    again = [(k, stamp, value) for k, stamp, value in events if k == 2]
    given = fed(sampler, sorted([*events, *((3, *e[1:]) for e in again)], key=lambda e: e[1]))
    options = (
        {"lag_ns": 100.0 * MS, "limit_ns": 30 * MS},
        {"lag_ns": 0.0, "limit_ns": 20 * MS},
    )
    truth: list[list[float]] = []
    for at, y in columns[0]:
        u, z = (driven(c, at, **o) for c, o in zip(columns[1:], options, strict=True))  # type: ignore[arg-type]
        if truth or math.isfinite(u * z):
            truth.append([y, u * z, z])
    found = [[*sample.y, *sample.u] for sample in given]
    np.testing.assert_allclose(found, truth, rtol=1e-12)
    assert np.isfinite(found).any()


def test_a_lost_sample_has_the_commands_of_its_time_where_they_are_known() -> None:
    """Not those that no hold keeps, nor what is measured with the response."""
    measured = "/y:other|hold(1 s)"
    texts = [U, f"{U}|hold(1 s)", measured, f"{U}|hold(1 s) * {measured}"]
    sampler, times = Sampler([Y], texts, period=0.01), [0, 10, 20, 61, 400]
    for k in range(1, 6):
        sampler.feed(k, 0, 2.0)
    given = [sample for t in times for sample in sampler.feed(0, t * MS, 1.0)]
    for k in range(1, 6):
        given += sampler.feed(k, 5 * MS, 3.0)
    given += sampler.flush()
    lost = [sample for sample in given if sample.missing == LOST]
    assert [sample.stamp_ns / MS for sample in given[:6]] == [0, 10, 20, 30.25, 40.5, 50.75]
    assert len(lost) == 3 + 33
    assert all(math.isnan(sample.y[0]) for sample in lost)
    nan = math.nan
    np.testing.assert_array_equal([s.u for s in lost], [[nan, 3.0, nan, nan]] * len(lost))
    again = Sampler([Y], [U], period=0.01)
    for k, t in ((1, 0), (0, 0), (1, 8), (0, 30), (1, 30)):
        given = again.feed(k, t * MS, float(t))
    assert [(s.stamp_ns // MS, s.u) for s in given] == [(10, (8.0,)), (20, (8.0,)), (30, (30.0,))]
    far = Sampler([Y], [U], period=0.01)
    far.feed(1, 0, 1.0)
    for t in (0, 10, 10 + 10 * (MOST_LOST + 2), 10 + 10 * (2 * MOST_LOST + 3)):
        far.feed(0, t * MS, 1.0)
    assert [sample.missing for sample in far.flush()].count(LOST) == MOST_LOST


@pytest.mark.parametrize("resample", ["none", "linear"])
def test_signals_of_several_topics_and_products_give_the_same_bits(
    tmp_path: Path, resample: str
) -> None:
    """Responses on two topics, drives made of two, as identification reads and as replay does."""
    bag = drive(tmp_path / "drive")
    steering = f"{CMD}:twist.linear.x|lag(0.1 s)"
    yaw = f"{ODOM}:pose.pose.orientation.yaw|unwrap"
    [trial] = read_bags(
        [bag],
        responses=[SPEED] if resample == "none" else [SPEED, f"{CMD}:twist.linear.x"],
        excitations=[f"{steering} * {SPEED}", f"{yaw}|derivative(0.1 s)"],
        grid=Grid(0.025 if resample == "none" else 0.05, 0.1, resample=resample, hold=0.2),
    )
    assert trial.u_paths[0] == (
        f"{steering}|hold(0.2 s) * {SPEED}|hold(0.2 s)"
    )  # the model knows the whole rule
    given = replayed(bag, Sampler(trial.y_paths, trial.u_paths, period=trial.period))
    assert trial.y.tolist() == [list(sample.y) for sample in given]
    assert trial.u.tolist() == [list(sample.u) for sample in given]
    assert len(given) > 80


def replayed(bag: Path, sampler: Sampler) -> list[Sample]:
    """Complete samples of a bag's messages in the order of logging."""
    given: list[Sample] = []
    with Bag(bag) as source:
        for topic in sampler.topics:
            sampler.check(topic, *source.types_on(topic))
        for message in source.messages(sampler.topics):
            stamp = sampler.stamp(message.data, message.log_time_ns)
            given += sampler.take(stamp, sampler.numbers(message.topic, message.data))
    return [sample for sample in [*given, *sampler.flush()] if not sample.missing]


def test_commands_without_a_header_are_paired_by_log_time_when_that_is_said(tmp_path: Path) -> None:
    bag = drive(tmp_path / "drive", stamped=False)
    signals = {"responses": [SPEED], "excitations": [f"{CMD}:linear.x"]}
    with pytest.raises(BagError) as caught:
        read_bags([bag], **signals, grid=Grid(max_gap=0.1))  # type: ignore[arg-type]
    for part in (
        f"{SPEED} has a header stamp",
        f"{CMD}:linear.x has a log time",
        "set `clock: log`",
    ):
        assert part in str(caught.value)
    grid = Grid(0.025, 0.1, "log")
    [trial] = read_bags([bag], **signals, grid=grid)  # type: ignore[arg-type]
    assert trial.u_paths == (f"{CMD}:linear.x|clock(log)|hold(0.1 s)",)
    assert len(trial) == 190
    with pytest.raises(BagError, match=r"/cmd_vel .* has no header stamp; .*`clock: log`"):
        Sampler([SPEED], [f"{CMD}:linear.x"], period=0.025).check(
            CMD, "geometry_msgs/msg/Twist", standard_types()
        )


def turning_robot(path: Path, seed: int) -> Path:
    """Turns as the unstamped commands say, with a lag; its heading is measured, its rate is not."""
    rng = np.random.default_rng(seed)
    types = standard_types()
    heading, rate, wanted = 0.0, 0.0, 0.0
    with BagWriter(path) as bag:
        for k in range(400):
            stamp = START_NS + k * 25 * MS
            if k >= 6 and k % 4 == 2:  # commands at 10 Hz, the first after a few responses
                wanted = float(rng.uniform(-1.0, 1.0)) if k % 40 == 2 else wanted
                data = serialised("geometry_msgs/msg/Twist", twist(wanted))
                log = stamp + 2 * MS
                bag.write(
                    CMD, "geometry_msgs/msg/Twist", data, log_time_ns=log, publish_time_ns=log
                )
            rate += 0.2 * (wanted - rate)
            heading += 0.025 * rate
            message: Any = types.deserialize_cdr(odometry(stamp, 0.0), ODOM_TYPE)
            message.pose.pose.orientation.z = math.sin(heading / 2)
            message.pose.pose.orientation.w = math.cos(heading / 2)
            data = serialised(ODOM_TYPE, message)
            bag.write(ODOM, ODOM_TYPE, data, log_time_ns=stamp, publish_time_ns=stamp)
    return path


@pytest.mark.slow
def test_a_robot_with_unstamped_commands_and_a_measured_heading_is_monitored(
    tmp_path: Path,
) -> None:
    """The whole way, on the numbers that identification read."""
    bags = [turning_robot(tmp_path / f"run_{k}", k) for k in range(3)]
    data = read_bags(
        bags,
        responses=[f"{ODOM}:pose.pose.orientation.yaw|unwrap|derivative(0.1 s)"],
        excitations=[f"{CMD}:linear.x"],
        grid=Grid(0.025, 0.04, "log", hold=0.15),
    )
    fit = identify(data, Polynomial(4))
    model = replace(fit.model, training="sha256:0")
    made = design_output_tube(OutputTube(model, data, profile=[(0.0, 0.0), (9.7, 0.5)], inlet=0.1))
    design: AnyDesign = Design(made.model, made.policy, made.funnel)
    said = replay_messages(design, bags[0], centre=Centre.COMMAND)
    trial = data.trajectories[0]
    assert [list(entry.reading.measured) for entry in said] == trial.y.tolist()
    assert {entry.reading.status for entry in said[4:388]} == {Status.INSIDE}


@pytest.mark.parametrize(
    ("lost", "verdict"), [((50,), Status.INSIDE), (range(50, 120, 2), Status.UNKNOWN)]
)
def test_samples_that_nobody_measured_are_counted_and_not_judged(
    tmp_path: Path, lost: Sequence[int], verdict: Status
) -> None:
    """By identification and by the monitor alike; the rest of the run is judged as before."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1.0, 1.0, 40), 10)
    y = np.zeros_like(u)
    for k in range(len(u) - 1):
        y[k + 1] = 0.8 * y[k] + 0.2 * u[k] + 1e-3 * rng.standard_normal()
    whole, lossy = tmp_path / "whole", tmp_path / "lossy"
    speed_bag(whole, y, u)
    speed_bag(lossy, [None if k in lost else speed for k, speed in enumerate(y)], u)
    grid = Grid(max_gap=0.08, resample="linear")
    data, gappy = (
        read_bags([bag], responses=[SPEED], excitations=[COMMAND], grid=grid)
        for bag in (whole, lossy)
    )
    assert (filled_samples(data), filled_samples(gappy)) == (0, len(lost))
    model = replace(identify(data, Polynomial(1)).model, training="sha256:0")
    made = design_output_tube(OutputTube(model, data))
    design: AnyDesign = Design(made.model, made.policy, made.funnel)
    before, after = (replay_messages(design, bag) for bag in (whole, lossy))
    assert len(before) == len(after) == len(u)
    assert [entry.reading for entry in after[:50]] == [entry.reading for entry in before[:50]]
    unmeasured = {k for k, e in enumerate(after) if e.reading.reason.startswith("filled in: /odom")}
    assert unmeasured == set(lost)
    assert {after[k].reading.status for k in unmeasured} == {Status.UNKNOWN}
    judged = [e.reading.status for k, e in enumerate(after) if k > 0 and k not in unmeasured]
    assert set(judged) == {Status.INSIDE}
    readings = tuple(entry.reading for entry in after)
    replay = Replay("lossy", readings, "speed", "m/s", 1.0, period=0.025)
    assert (replay.filled, replay.verdict) == (len(lost), verdict.value)
    assert bool(replay.unjudged) is (verdict is Status.UNKNOWN)


def test_a_frame_is_read_by_its_name_from_the_messages_that_have_it(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "tf") as bag:
        for k in range(60):
            stamp = START_NS + k * 10 * MS
            names = ("camera",) if k % 3 == 2 else ("odom", "base")
            moved = {name: (np.array([0.1 * k, 0.0, len(name)]), 0.02 * k) for name in names}
            put(bag, stamp, "/tf", TRANSFORMS, transforms(stamp, moved))
    base = "/tf:transforms[child_frame_id=base].transform"
    signals = [f"{base}.translation.x", f"{base}.rotation.yaw", f"{base}.translation.z"]
    read = read_signals(tmp_path / "tf", signals)
    rows = [k for k in range(60) if k % 3 != 2]
    assert read[signals[0]].values.tolist() == [0.1 * k for k in rows]
    np.testing.assert_allclose(read[signals[1]].values, [0.02 * k for k in rows], atol=1e-15)
    assert read[signals[1]].stamp_ns.tolist() == [START_NS + k * 10 * MS for k in rows]
    with Bag(tmp_path / "tf") as source:
        listed = {entry.signal: entry for entry in bag_signals(source)}
        assert (listed[signals[2]].low, listed[signals[2]].high) == (4.0, 4.0)
        camera = "/tf:transforms[child_frame_id=camera].transform.rotation.yaw"
        assert listed[camera].unit == "rad"
        assert listed[camera].low == pytest.approx(0.04)
        sampler = Sampler([f"{signals[1]}|clock(log)"], [f"{signals[0]}|clock(log)"], period=0.01)
        sampler.check("/tf", *source.types_on("/tf"))
        given = [
            sample
            for message in source.messages(["/tf"])
            for sample in sampler.take(
                sampler.stamp(message.data, message.log_time_ns),
                sampler.numbers("/tf", message.data),
            )
        ]
    assert [sample.y[0] for sample in came(given)] == read[signals[1]].values.tolist()
    with pytest.raises(BagError, match="'frame' on 'tf2_msgs/msg/TFMessage' is not an array of"):
        read_signals(tmp_path / "tf", ["/tf:transforms[frame=base].transform.translation.x"])
    with pytest.raises(BagError, match=r"is nan in message 0 .*not finite"):
        read_signals(tmp_path / "tf", [signals[0].replace("base", "wheel")])


@pytest.mark.parametrize(
    ("responses", "drive", "reason"),
    [
        ([f"{Y} * {Z}"], U, "for what drives, not for a response"),
        ([f"{Y}|lag(1 s)"], U, "for what drives, not for a response"),
        ([Y], f"{U}|lag(1 s)|linear(1 s)", "leave out linear"),
        ([Y], " * ".join([U] * 5), "at most 4"),
        ([Y], f"{U}|clock(log)", "two clocks cannot be paired: /y:data by its header time"),
        ([f"{Y}|linear(1 s)", Z], U, r"/z:data is sampled as it comes, /y:data.* on a grid"),
        ([Y], f"{U}|hold(1 s)|linear(1 s)", "says twice when the signal is sampled"),
        ([Y], f"{U}|clock(log)|clock(log)", "says twice when the signal is sampled"),
        ([Y], f"{U}|clock(sun)", r"clock\(header\) or clock\(log\)"),
    ],
)
def test_signals_that_are_never_one_sample_are_refused(
    responses: list[str], drive: str, reason: str
) -> None:
    with pytest.raises(BagError, match=reason):
        Sampler(responses, [drive], period=0.1)


def test_a_missing_command_is_named_with_how_long_it_has_been_missing() -> None:
    sampler = Sampler([Y], [f"{U}|hold(0.1 s)"], period=0.05)
    sampler.feed(1, 0, 1.0)
    assert sampler.feed(0, 50 * MS, 2.0) == []
    assert sampler.flush(60 * MS) == [Sample(50 * MS, (2.0,), (1.0,))]
    *lost, late = [*sampler.feed(0, 200 * MS, 3.0), *sampler.flush(200 * MS)]
    assert [(sample.stamp_ns, sample.missing) for sample in lost] == [
        (100 * MS, LOST),
        (150 * MS, LOST),
    ]
    np.testing.assert_array_equal([sample.u for sample in lost], [[1.0], [np.nan]])
    assert late.missing == f"{U}|hold(0.1 s): nothing for 0.2 s; at most 0.1 s is held"
    assert math.isnan(late.u[0])
    sampler.feed(1, 150 * MS, 5.0)
    assert sampler.late == 1
    sampler.feed(0, 100 * MS, 5.0)
    sampler.feed(0, 200 * MS, 5.0)
    assert (sampler.late_responses, sampler.duplicate_responses) == (1, 1)


def test_a_command_that_is_unknown_is_not_mended_by_another_of_its_stamp() -> None:
    for at_once in ((math.nan, 1.0), (1.0, math.nan)):
        sampler = Sampler([Y], [f"{U}|hold(0.1 s)"], period=0.05)
        sampler.feed(1, 0, 3.0)
        sampler.feed(0, 0, 0.0)
        for value in at_once:
            sampler.feed(1, 50 * MS, value)
        [unknown] = sampler.feed(0, 50 * MS, 2.0)
        assert math.isnan(unknown.u[0])
        assert unknown.missing == f"{U}|hold(0.1 s): not a finite number"
        sampler.feed(1, 70 * MS, 4.0)
        assert sampler.feed(0, 70 * MS, 2.0) == [Sample(70 * MS, (2.0,), (4.0,))]


def test_a_configuration_is_written_into_the_paths_unless_they_say_otherwise() -> None:
    grid = Grid(clock="log", resample="last", hold=0.5, max_gap=0.1)
    assert grid.path(Y, response=True) == f"{Y}|clock(log)|hold(0.1 s)"
    assert grid.path(U, response=False) == f"{U}|clock(log)|hold(0.5 s)"
    own = f"{Y}|linear(0.3 s)|clock(header)"
    assert grid.path(own, response=True) == own
    assert Grid().path(f"{Y}|to( deg )", response=True) == f"{Y}|to( deg )"
